"""Describe an object: its faces, symmetry, dimensions and grasps."""
