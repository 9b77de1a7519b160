"""Simulate a robot cell with real physics, and define the interface of simulated and real cells."""
