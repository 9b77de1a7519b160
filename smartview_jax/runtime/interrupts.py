"""Make Ctrl-C end a command at once, also during a long call into compiled code.

Python handles an interrupt only between two of its own instructions, and a single call into a
library (the compiler, the circle detection) may take minutes. Therefore a second thread listens for
interrupts: if the main thread has not ended within `GRACE_PERIOD`, the second thread ends the
process, as soon as no file is being written.
"""

import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ..files import clean_up_before_exit

INTERRUPT_EXIT_CODE = 130
"""Exit code of an interrupted program, by the shells' convention: 128 + 2, the signal's number."""

INTERRUPT_MESSAGE = "interrupted; no file is left half-written"
"""Message on standard error after an interrupt."""

GRACE_PERIOD = 1.0
"""Time that the main thread has to end by itself after an interrupt, s."""

_WRITE_TIMEOUT = 0.5
"""Longest time to wait for files that are being written, s."""

_SHOW_CURSOR = "\x1b[?25h"
"""Terminal code that shows the cursor, which a progress line hides."""

_message_lock = threading.Lock()
_message_printed = threading.Event()


def print_message_once(write: Callable[[str], object]) -> None:
    """Print `INTERRUPT_MESSAGE` unless another thread has printed it.

    The other thread may be about to end the process, so it is printed before others can see that it
    was.

    Args:
        write: prints a line on standard error.
    """
    held = _message_lock.acquire(timeout=_WRITE_TIMEOUT)
    try:
        if not _message_printed.is_set():
            write(INTERRUPT_MESSAGE)
            _message_printed.set()
    finally:
        if held:
            _message_lock.release()


@contextmanager
def interrupt_listener() -> Iterator[None]:
    """Listen for interrupts while a command runs; do nothing outside the main thread."""
    is_default_handler = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    # A program that handles interrupts itself must not be ended here.
    if threading.current_thread() is not threading.main_thread() or not is_default_handler:
        yield
        return
    _message_printed.clear()
    # Python's low-level handler writes the signal's number to this pipe, even while the main thread
    # is inside a library. It may not block there, hence the non-blocking end.
    read_fd, write_fd = os.pipe()
    os.set_blocking(write_fd, False)
    previous_fd = signal.set_wakeup_fd(write_fd, warn_on_full_buffer=False)
    interrupted = threading.Event()
    threading.Thread(target=_listen, args=(read_fd, interrupted), daemon=True).start()
    previous_hook = sys.unraisablehook

    def report(unraisable: "sys.UnraisableHookArgs") -> None:
        """Report an error that Python cannot raise, except an interrupt."""
        # Python drops an interrupt that arrives in a destructor or in the callback of a weak
        # reference, and would print its traceback. The second thread ends the process then.
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            previous_hook(unraisable)

    sys.unraisablehook = report
    try:
        yield
    finally:
        sys.unraisablehook = previous_hook
        signal.set_wakeup_fd(previous_fd)
        # Closing the pipe ends the thread. After an interrupt it must stay alive, because the
        # interpreter's own shutdown may wait minutes for a running compiler.
        if not interrupted.is_set():
            os.close(write_fd)


def _listen(read_fd: int, interrupted: threading.Event) -> None:
    """End the process a moment after an interrupt, or at once after a second one."""
    while signal.SIGINT not in (received := os.read(read_fd, 64)):
        # An empty read means that the command has ended and closed the other end.
        if not received:
            os.close(read_fd)
            return
    interrupted.set()
    # Returns after GRACE_PERIOD, or earlier when a second interrupt arrives.
    select.select([read_fd], [], [], GRACE_PERIOD)
    clean_up_before_exit(_WRITE_TIMEOUT)
    if os.isatty(2):
        os.write(2, _SHOW_CURSOR.encode())
    print_message_once(lambda text: os.write(2, f"{text}\n".encode()))
    # `sys.exit` would end only this thread; `os._exit` ends the process without waiting for others.
    os._exit(INTERRUPT_EXIT_CODE)
