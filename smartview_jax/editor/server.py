"""Serve the editor's page on this machine: `smartview model`, and the tests' browser.

The server listens on 127.0.0.1 only. The address that it prints has a token, without which neither
pictures nor the model are given; requests that come from another page, or under another name than
this machine's, are refused.
"""

import asyncio
import contextlib
import secrets
import threading
from collections.abc import Callable
from http.cookies import SimpleCookie
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..extras import import_extra
from .conversation import SLOW_COMMANDS, Conversation
from .session import ModelSession

HOST = "127.0.0.1"
"""The only address that the server listens on."""

JPEG_QUALITY = 93
"""The quality of the pictures sent to the page; clicks snap to the features of the originals."""

PAGE = Path(__file__).parent / "page"
"""The folder of the page's files."""


def editor_app(session: ModelSession, token: str, port: int) -> Any:
    """Return the ASGI application that shows a session.

    Args:
        session: to be edited.
        token: that the first request must have.
        port: that the server listens on; part of the origin that is accepted.

    Raises:
        ImportError: starlette is not installed.
    """
    import_extra("starlette", "editor", "the editor's page")
    from starlette.applications import Starlette
    from starlette.middleware import Middleware
    from starlette.middleware.trustedhost import TrustedHostMiddleware
    from starlette.routing import Mount, Route, WebSocketRoute
    from starlette.staticfiles import StaticFiles

    # A browser calls this machine by either name.
    origins = {f"http://{name}:{port}" for name in (HOST, "localhost")}
    # Cookies are shared by all ports of a machine: without it, two editors would exchange tokens.
    editor = _Editor(session, token, origins, cookie=f"smartview_editor_{port}")
    return Starlette(
        routes=[
            Route("/", editor.page),
            Route("/picture/{view}", editor.picture),
            WebSocketRoute("/socket", editor.socket),
            Mount("/", StaticFiles(directory=PAGE)),
        ],
        # Another name that is made to lead here would be another page's way in (DNS rebinding).
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=[HOST, "localhost"])],
    )


class _Editor:
    """The session that all requests of one server share, and who may ask for it."""

    def __init__(self, session: ModelSession, token: str, origins: set[str], cookie: str):
        self._session, self._token, self._origins = session, token, origins
        # It has the token for the requests that the page makes by itself.
        self._cookie = cookie
        self._pages: dict[Any, Conversation] = {}
        # Answers are computed in a thread, so that pictures load meanwhile; one after another,
        # because they change the session.
        self._turn = asyncio.Lock()
        self._pictures: dict[str, bytes] = {}

    async def page(self, request: Any) -> Any:
        """Give the page to whoever has the token, and let it keep that as a cookie."""
        from starlette.responses import FileResponse, PlainTextResponse

        if not self._has_token(request.query_params.get("token", "")):
            return PlainTextResponse(
                "This address is not complete: open the one that smartview printed.", 403
            )
        response = FileResponse(PAGE / "index.html")
        # Pictures and the socket are asked for without the address's token.
        response.set_cookie(self._cookie, self._token, httponly=True, samesite="strict")
        return response

    async def picture(self, request: Any) -> Any:
        """Give the picture of a view."""
        from starlette.responses import PlainTextResponse, Response

        view = request.path_params["view"]
        # The pictures are the user's; the page's own files are public.
        if not self._has_token(request.cookies.get(self._cookie, "")):
            return PlainTextResponse("no token", 403)
        if view not in self._session.pictures:
            return PlainTextResponse(f"there is no view {view!r}", 404)
        if view not in self._pictures:
            # Encoding 12 megapixels takes a tenth of a second; the page may be opened again.
            self._pictures[view] = await asyncio.to_thread(
                encoded_picture, self._session.pictures[view]
            )
        return Response(self._pictures[view], media_type="image/jpeg")

    async def socket(self, socket: Any) -> None:
        """Answer the messages of one page, and tell it what other pages have changed."""
        from starlette.websockets import WebSocketDisconnect

        cookie = SimpleCookie(socket.headers.get("cookie", ""))
        token = cookie[self._cookie].value if self._cookie in cookie else ""
        # A browser lets any page open a socket here; it always says which page it was.
        if socket.headers.get("origin") not in self._origins or not self._has_token(token):
            await socket.close(1008)
            return
        await socket.accept()
        conversation = self._pages[socket] = Conversation(self._session)
        slow: set[asyncio.Task[None]] = set()
        try:
            while True:
                message = await socket.receive_json()
                if isinstance(message, dict) and message.get("do") in SLOW_COMMANDS:
                    # Features of large pictures take seconds, in which clicks are answered.
                    task = asyncio.create_task(self._answer_later(socket, conversation, message))
                    slow.add(task)
                    task.add_done_callback(slow.discard)
                    continue
                document = self._session.document
                async with self._turn:
                    answer = await asyncio.to_thread(conversation.answer, message)
                # Others are told of a change even if the page that made it has left.
                await _send(socket, answer)
                if self._session.document is not document:
                    await self._tell_others(socket)
        except (WebSocketDisconnect, RuntimeError, ValueError, TypeError):
            # The page has left (starlette raises a RuntimeError where a send noticed it first), or
            # a message is no mapping in JSON and so not from the page: this socket ends here.
            pass
        finally:
            for task in slow:
                task.cancel()
            del self._pages[socket]

    async def _answer_later(self, socket: Any, conversation: Conversation, message: Any) -> None:
        """Answer a message that changes nothing and may take long."""
        answer = await asyncio.to_thread(conversation.answer, message)
        if socket in self._pages:
            await _send(socket, answer)

    async def _tell_others(self, changer: Any) -> None:
        """Send what has changed to all pages but the one that changed it."""
        for socket, conversation in list(self._pages.items()):
            # Others may have left while this one's update was computed.
            if socket is not changer and socket in self._pages:
                async with self._turn:
                    update = await asyncio.to_thread(conversation.update)
                await _send(socket, update)

    def _has_token(self, given: str) -> bool:
        """Return whether a token is the right one, in a time that does not tell how nearly."""
        return secrets.compare_digest(given.encode(), self._token.encode())


async def _send(socket: Any, message: dict[str, Any]) -> None:
    """Send a message to a page that may have left; its own loop sees that it did, and ends."""
    from starlette.websockets import WebSocketDisconnect

    # The error of one page's socket must not end the loop of another page. Starlette raises a
    # RuntimeError for a socket that was closed by this side.
    with contextlib.suppress(WebSocketDisconnect, RuntimeError, OSError):
        await socket.send_json(message)


def encoded_picture(picture: np.ndarray) -> bytes:
    """Return a picture as JPEG, for the page."""
    # JPEG: a lossless picture of 12 megapixels takes seconds to decode in the browser.
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data.tobytes()


def serve(
    session: ModelSession,
    port: int = 0,
    announce: Callable[[str], None] = lambda address: None,
) -> None:
    """Serve a session until the process is interrupted.

    Args:
        session: to be edited.
        port: to listen on; 0 takes a free one.
        announce: called with the page's address, token included, when the server listens.

    Raises:
        ImportError: starlette or uvicorn is not installed.
        OSError: the port is in use.
    """
    uvicorn = import_extra("uvicorn", "editor", "the editor's page")
    import socket as sockets

    listener = sockets.socket(sockets.AF_INET, sockets.SOCK_STREAM)
    # So that an editor can be started again on the same port at once.
    listener.setsockopt(sockets.SOL_SOCKET, sockets.SO_REUSEADDR, 1)
    with listener:
        try:
            listener.bind((HOST, port))
        except OSError as error:
            raise OSError(f"port {port} of {HOST}: {error.strerror}") from error
        listener.listen()
        taken, token = listener.getsockname()[1], secrets.token_urlsafe(24)
        app = editor_app(session, token, taken)
        # The session is opened and closed by the caller, so the server needs no lifespan events.
        config = uvicorn.Config(app, log_level="warning", lifespan="off", ws="websockets-sansio")
        # Whoever opens the page looks at the pictures first; meanwhile the first click is prepared.
        stop = threading.Event()
        preparing = threading.Thread(target=session.prepare, args=(stop,), daemon=True)
        preparing.start()
        try:
            announce(f"http://{HOST}:{taken}/?token={token}")
            uvicorn.Server(config).run([listener])
        finally:
            # A thread that still computes when Python ends aborts the process.
            stop.set()
            preparing.join()
