"""Look for garbage rarely while a command runs.

Tracing and compiling make some hundred thousand objects that live as long as the process. Python's
collector would look through all of them again and again: a tenth of a calibration's time, in which
next to nothing is found.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager

OBJECTS_BETWEEN_COLLECTIONS = 100_000
"""Number of new objects after which the youngest are looked through; Python's own is 700."""


@contextmanager
def rare_collections() -> Iterator[None]:
    """Collect garbage rarely, and leave the collector of a program that calls it as it was."""
    young, *older = gc.get_threshold()
    # A program that turned collection off, by zero, or made it rarer still, keeps that.
    gc.set_threshold(max(young, OBJECTS_BETWEEN_COLLECTIONS) if young else 0, *older)
    try:
        yield
    finally:
        gc.set_threshold(young, *older)
