"""A page is served to this machine until the server is ended."""

import http.client
import queue
import threading
from urllib.parse import urlsplit

import pytest

from smartview_jax.editor import serve_page

pytest.importorskip("uvicorn", reason="the editor's server is not installed")


async def answer(scope, receive, send):
    """A page of one word."""
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"here"})


def test_a_server_ends_when_it_is_told_to_also_while_a_page_is_open():
    addresses, stop = queue.Queue(), threading.Event()
    words = (lambda token, port: answer, 0, addresses.put, stop)
    server = threading.Thread(target=serve_page, args=words, daemon=True)
    server.start()
    place = urlsplit(addresses.get(timeout=30.0))
    page = http.client.HTTPConnection(place.hostname, place.port)
    page.request("GET", "/")
    assert page.getresponse().read() == b"here"
    assert server.is_alive()
    stop.set()
    server.join(30.0)
    assert not server.is_alive()
    page.close()
    with pytest.raises(ConnectionRefusedError):
        http.client.HTTPConnection(place.hostname, place.port).request("GET", "/")
