"""Ctrl-C answers at once, also while a compiler or a search for circles runs.

Python hears an interrupt only between two of its own steps, and one call into a library may take
minutes. So a thread listens besides: what the main thread has not ended by itself after a moment,
it ends, once no file is half-way into its place.
"""

import os
import select
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from .files import leave_nothing_half_written

EXIT_CODE = 130
"""A shell's own for a program that was interrupted: 128 and the signal's number."""

WORDS = "interrupted; no file is left half-written"

GRACE = 1.0
"""Time that the main thread has for an end of its own, s."""

_PATIENCE = 0.5
"""Longest wait for files to be in their place, s."""

_SHOW_CURSOR = "\x1b[?25h"

told = threading.Event()
"""Set by who has said so already."""


@contextmanager
def heard_at_once() -> Iterator[None]:
    """Listen for interrupts while a command runs; elsewhere than in a main thread do nothing."""
    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if threading.current_thread() is not threading.main_thread() or not ours:
        yield
        return
    told.clear()
    heard, bell = os.pipe()
    os.set_blocking(bell, False)
    before = signal.set_wakeup_fd(bell, warn_on_full_buffer=False)
    asked = threading.Event()
    threading.Thread(target=_listen, args=(heard, asked), daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        # After an interrupt the thread stays: the interpreter's own end may wait for a compiler.
        if not asked.is_set():
            os.close(bell)


def _listen(heard: int, asked: threading.Event) -> None:
    """End the process a moment after an interrupt, or at once after a second one."""
    while signal.SIGINT not in (rung := os.read(heard, 64)):
        if not rung:
            os.close(heard)
            return
    asked.set()
    select.select([heard], [], [], GRACE)
    leave_nothing_half_written(_PATIENCE)
    if os.isatty(2):
        os.write(2, _SHOW_CURSOR.encode())
    if not told.is_set():
        # First, because writing lets the main thread go on.
        told.set()
        os.write(2, f"{WORDS}\n".encode())
    os._exit(EXIT_CODE)
