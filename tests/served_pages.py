"""A page that is served by this process, in the background, until the tests end."""

import atexit
import queue
import threading

PATIENCE = 30.0
"""Longest wait for a server to begin or to end, s."""


def serve_in_thread(serve, *arguments):
    """The address of a page that a function serves, given these arguments.

    The server is ended with the process: a thread that went on in compiled code would abort it.
    """
    addresses, stop = queue.Queue(), threading.Event()
    thread = threading.Thread(
        target=serve, args=(*arguments, addresses.put), kwargs={"stop": stop}, daemon=True
    )
    thread.start()
    address = addresses.get(timeout=PATIENCE)
    atexit.register(end, stop, thread)
    return address


def end(stop, thread):
    """End a server, also while pages are open, and its thread."""
    stop.set()
    thread.join(PATIENCE)
