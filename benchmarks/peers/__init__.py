"""The same joint fit by several libraries, each run as a process of its own by `engine.py`."""
