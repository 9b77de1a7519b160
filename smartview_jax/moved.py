"""Names that moved to another room: found where they were for one more release, with a warning.

The place is a text, which a room's `__getattr__` imports when somebody asks for the name, and never
before. So a room may point to one above it, which else would be a circle; nothing in the package
asks for an old name (`tests/test_moved.py`).
"""

import importlib
import warnings
from collections.abc import Callable, Mapping
from typing import Any


def moved(room: str, places: Mapping[str, str]) -> Callable[[str], Any]:
    """The `__getattr__` of a room whose names moved.

    Args:
        room: its full name, as in `__name__`.
        places: full name of the module that has it, by name.
    """

    def find(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {room!r} has no attribute {name!r}")
        warnings.warn(
            f"{room}.{name} is now {places[name]}.{name}; the next release drops the old name",
            DeprecationWarning,
            stacklevel=2,
        )
        return getattr(importlib.import_module(places[name]), name)

    return find
