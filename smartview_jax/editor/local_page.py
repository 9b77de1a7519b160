"""Serve a page to this machine only: address, token and origin of every request are checked.

The server listens on 127.0.0.1. What belongs to the user is served only with the token in the
printed address; requests from other pages, or under another host name, are refused.
"""

import secrets
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..extras import import_extra

HOST = "127.0.0.1"
"""The only address that a server listens on."""


class PageAccess:
    """The token of a page and the origins from which its requests may come."""

    def __init__(self, token: str, port: int, name: str):
        """Store the token.

        Args:
            token: the token that the first request must have.
            port: port of the server, part of the accepted origins.
        """
        self._token = token
        self._origins = {f"http://{host}:{port}" for host in (HOST, "localhost")}
        # The cookie carries the token in the page's own requests. Cookies are shared by all ports
        # of a machine, so the name includes the port: otherwise two pages would overwrite each
        # other's token.
        self._cookie = f"smartview_{name}_{port}"

    def middleware(self) -> list[Any]:
        """Return the middleware that refuses other host names."""
        from starlette.middleware import Middleware
        from starlette.middleware.trustedhost import TrustedHostMiddleware

        # Against DNS rebinding, by which another page could reach this server under its own name.
        return [Middleware(TrustedHostMiddleware, allowed_hosts=[HOST, "localhost"])]

    def page_response(self, request: Any, file: Path) -> Any:
        """Return the page if the token is right, with the token as a cookie."""
        from starlette.responses import FileResponse, PlainTextResponse

        if not self._has_token(request.query_params.get("token", "")):
            return PlainTextResponse(
                "This address has no valid token: open the address that smartview printed.", 403
            )
        response = FileResponse(file)
        response.set_cookie(self._cookie, self._token, httponly=True, samesite="strict")
        return response

    def allows(self, request: Any) -> bool:
        """Return whether a request has the cookie."""
        # Other programs on this machine leave cookies, too, which may be malformed.
        return self._has_token(request.cookies.get(self._cookie, ""))

    def allows_socket(self, socket: Any) -> bool:
        """Return whether a socket is opened by the page itself."""
        # A browser lets any page open a socket here; it always says which page it was.
        return socket.headers.get("origin") in self._origins and self.allows(socket)

    def _has_token(self, given: str) -> bool:
        """Return whether a token is right, in constant time against timing attacks."""
        return secrets.compare_digest(given.encode(), self._token.encode())


def serve_page(
    make_app: Callable[[str, int], Any],
    port: int = 0,
    announce: Callable[[str], None] = lambda address: None,
    stop: threading.Event | None = None,
) -> None:
    """Serve a page until the process is interrupted, or until an event is set.

    Args:
        make_app: returns the ASGI application, given the token and the port.
        port: port to listen on; 0 takes a free one.
        announce: called with the page's address, including the token, when the server listens.
        stop: ends the server when it is set, by another thread; None for never.

    Raises:
        ImportError: starlette or uvicorn is not installed.
        OSError: the port is in use.
    """
    uvicorn = import_extra("uvicorn", "editor", "the page")
    import socket as sockets

    listener = sockets.socket(sockets.AF_INET, sockets.SOCK_STREAM)
    # Allows a restart on the same port at once.
    listener.setsockopt(sockets.SOL_SOCKET, sockets.SO_REUSEADDR, 1)
    with listener:
        try:
            listener.bind((HOST, port))
        except OSError as error:
            raise OSError(f"port {port} of {HOST}: {error.strerror}") from error
        listener.listen()
        bound_port, token = listener.getsockname()[1], secrets.token_urlsafe(24)
        app = make_app(token, bound_port)
        # What is served is opened and closed by the caller, so no lifespan events are needed.
        config = uvicorn.Config(app, log_level="warning", lifespan="off", ws="websockets-sansio")
        announce(f"http://{HOST}:{bound_port}/?token={token}")
        server = uvicorn.Server(config)
        if stop is not None:
            threading.Thread(target=_end_when_set, args=(stop, server), daemon=True).start()
        server.run([listener])


def _end_when_set(stop: threading.Event, server: Any) -> None:
    """Wait for an event, then end a server, whose pages may still be open."""
    stop.wait()
    server.should_exit = server.force_exit = True
