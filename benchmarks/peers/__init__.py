"""What other libraries make of the same data: joint fits, each run as a process of its own by
`engine.py`; and whole hand-eye calibrations, which the caller runs.
"""
