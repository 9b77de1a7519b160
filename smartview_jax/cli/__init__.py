"""Define the `smartview` command, with one file for each of its subcommands.

The library is imported inside the subcommands: importing JAX takes seconds, which `--help` and a
misspelt option should not cost.
"""

from .main import app as app
