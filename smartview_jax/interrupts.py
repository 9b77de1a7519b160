"""Make Ctrl-C end a command at once, also during a long call into compiled code.

Python handles an interrupt only between two of its own instructions, and a single call into a
library (the compiler, the circle detection) may take minutes. Therefore a second thread listens for
interrupts: if the main thread has not ended within `GRACE`, it ends the process, as soon as no file
is being written.
"""

import os
import select
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from .files import leave_nothing_half_written

EXIT_CODE = 130
"""Exit code of an interrupted program, by the shells' convention: 128 + 2, the signal's number."""

WORDS = "interrupted; no file is left half-written"
"""Message on standard error after an interrupt."""

GRACE = 1.0
"""Time that the main thread has to end by itself after an interrupt, s."""

_PATIENCE = 0.5
"""Longest time to wait for files that are being written, s."""

_SHOW_CURSOR = "\x1b[?25h"
"""Terminal code that shows the cursor, which a progress line hides."""

told = threading.Event()
"""Event that is set once `WORDS` was printed, so that only one thread prints it."""


@contextmanager
def heard_at_once() -> Iterator[None]:
    """Listen for interrupts while a command runs; do nothing outside the main thread."""
    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if threading.current_thread() is not threading.main_thread() or not ours:
        yield
        return
    told.clear()
    # Python's low-level handler writes the signal's number to this pipe, even while the main thread
    # is inside a library. It may not block there, hence the non-blocking end.
    heard, bell = os.pipe()
    os.set_blocking(bell, False)
    before = signal.set_wakeup_fd(bell, warn_on_full_buffer=False)
    asked = threading.Event()
    threading.Thread(target=_listen, args=(heard, asked), daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        # Closing the pipe ends the thread. After an interrupt it must stay alive, because the
        # interpreter's own shutdown may wait minutes for a running compiler.
        if not asked.is_set():
            os.close(bell)


def _listen(heard: int, asked: threading.Event) -> None:
    """End the process a moment after an interrupt, or at once after a second one."""
    while signal.SIGINT not in (rung := os.read(heard, 64)):
        if not rung:
            os.close(heard)
            return
    asked.set()
    # Returns after GRACE, or earlier when a second interrupt arrives.
    select.select([heard], [], [], GRACE)
    leave_nothing_half_written(_PATIENCE)
    if os.isatty(2):
        os.write(2, _SHOW_CURSOR.encode())
    if not told.is_set():
        # Set before the write, during which the main thread may run and print the same message.
        told.set()
        os.write(2, f"{WORDS}\n".encode())
    # `sys.exit` would end only this thread; `os._exit` ends the process without waiting for others.
    os._exit(EXIT_CODE)
