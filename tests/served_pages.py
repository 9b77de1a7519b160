"""A page that is served by this process, in the background, until the tests end."""

import atexit
import threading
import time

PATIENCE = 30.0
"""Longest wait for a server to begin or to end, s."""


def serve_in_thread(serve, *arguments):
    """The address of a page that a function serves, given these arguments.

    The server is ended with the process: a thread that went on in compiled code would abort it.
    """
    import uvicorn

    addresses, servers, original = [], [], uvicorn.Server

    def kept(config):
        servers.append(original(config))
        return servers[0]

    uvicorn.Server = kept
    try:
        thread = threading.Thread(target=serve, args=(*arguments, addresses.append), daemon=True)
        thread.start()
        deadline = time.monotonic() + PATIENCE
        while not servers:
            assert time.monotonic() < deadline
            time.sleep(0.01)
    finally:
        uvicorn.Server = original
    atexit.register(end, servers[0], thread)
    return addresses[0]


def end(server, thread):
    """End a server, also while pages are open, and its thread."""
    server.should_exit = server.force_exit = True
    thread.join(PATIENCE)
