"""What may stand in a file: typed schemas with units and ranges, and errors that name the entry.

The modules here import pydantic, which takes a tenth of a second: they are imported by the
functions that read files, when they read one.
"""
