"""Deprecated import paths that keep working, with a warning, for one more release.

The new location is stored as text and imported only when somebody asks for the old name. A package
can therefore refer to a package above it without a circular import; nothing in the library itself
uses an old name (`tests/test_moved.py`).
"""

import importlib
import warnings
from collections.abc import Callable, Mapping
from typing import Any


def moved(room: str, places: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the module-level `__getattr__` of a package whose names have a new location.

    Args:
        room: full name of the package, as in `__name__`.
        places: full name of the module that now defines each name, keyed by that name.
    """

    def find(name: str) -> Any:
        """Import a name from its new location, with a deprecation warning."""
        if name not in places:
            raise AttributeError(f"module {room!r} has no attribute {name!r}")
        warnings.warn(
            f"{room}.{name} is now {places[name]}.{name}; the next release drops the old name",
            DeprecationWarning,
            stacklevel=2,
        )
        return getattr(importlib.import_module(places[name]), name)

    return find
