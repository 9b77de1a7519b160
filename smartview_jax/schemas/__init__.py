"""Define the contents of files by typed schemas with units and ranges; errors name the entry.

The modules in this folder import pydantic, which takes a tenth of a second. Therefore functions
that read files import these modules only when they are called.
"""
