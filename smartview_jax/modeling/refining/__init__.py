"""Refine points and lines of an object together, under constraints."""
