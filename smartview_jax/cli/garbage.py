"""Run Python's garbage collector rarely while a command runs.

Tracing and compiling create about a hundred thousand objects that live as long as the process.
Scanning them again and again takes a tenth of a calibration's time and frees almost nothing.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager

OBJECTS_BETWEEN_COLLECTIONS = 100_000
"""Number of new objects after which the youngest generation is collected; Python's own is 700."""


@contextmanager
def rare_collections() -> Iterator[None]:
    """Collect garbage rarely, then restore the settings of the calling program."""
    young, *older = gc.get_threshold()
    # A program that turned collection off (zero), or made it rarer still, keeps its setting.
    gc.set_threshold(max(young, OBJECTS_BETWEEN_COLLECTIONS) if young else 0, *older)
    try:
        yield
    finally:
        gc.set_threshold(young, *older)
