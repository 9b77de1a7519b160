"""State the version of the installed package."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("smartview-jax")
except PackageNotFoundError:  # a checkout that was never installed has no metadata
    __version__ = "0+unknown"
