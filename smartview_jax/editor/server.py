"""Serve the editor's page on this machine: `smartview model`, and the tests' browser.

`local_page` checks who may open it.
"""

import asyncio
import contextlib
import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from ..extras import import_extra
from .conversation import SLOW_COMMANDS, Conversation
from .local_page import HOST as HOST
from .local_page import PageAccess, serve_page
from .session import ModelSession

JPEG_QUALITY = 93
"""JPEG quality of the pictures sent to the page; features are found in the originals."""

PAGE = Path(__file__).parent / "page"
"""The folder of the page's files."""

SLOW_AT_ONCE = 2
"""Number of slow commands that run at the same time.

`asyncio` has at least five threads on any machine, so that a click never waits for them.
"""

MAX_SLOW = 1000
"""Largest number of waiting slow commands of a page, which asks once for each view's features."""

INTERNAL_ERROR = 1011
"""The code of a socket that is closed after an error of the server; the page connects again."""

_LOGGER = logging.getLogger(__name__)


def editor_app(session: ModelSession, token: str, port: int) -> Any:
    """Return the ASGI application that shows a session; the first request must have the token."""
    import_extra("starlette", "editor", "the editor's page")
    from starlette.applications import Starlette
    from starlette.routing import Mount, Route, WebSocketRoute
    from starlette.staticfiles import StaticFiles

    access = PageAccess(token, port, "editor")
    editor = _Editor(session, access)
    return Starlette(
        routes=[
            Route("/", editor.page),
            # A view may be named after a file in a folder.
            Route("/picture/{view:path}", editor.picture),
            WebSocketRoute("/socket", editor.socket),
            Mount("/", StaticFiles(directory=PAGE)),
        ],
        middleware=access.middleware(),
    )


class _Page(NamedTuple):
    """A page that is shown.

    Attributes:
        conversation: the conversation with the page.
        behind: set when another page has made a change that this page does not show yet.
    """

    conversation: Conversation
    behind: asyncio.Event


class _Editor:
    """The session that all requests of a server share, with access control."""

    def __init__(self, session: ModelSession, access: PageAccess):
        self._session, self._access = session, access
        self._pages: dict[Any, _Page] = {}
        # Answers are computed in a thread, so that pictures load meanwhile; one after another,
        # because they change the session.
        self._turn = asyncio.Lock()
        self._slow_turn = asyncio.Semaphore(SLOW_AT_ONCE)
        self._pictures: dict[str, bytes] = {}

    async def page(self, request: Any) -> Any:
        """Serve the page if the token is right, and set the token as a cookie."""
        return self._access.page_response(request, PAGE / "index.html")

    async def picture(self, request: Any) -> Any:
        """Serve the picture of a view."""
        from starlette.responses import PlainTextResponse, Response

        view = request.path_params["view"]
        # The user's pictures need the token; the page's files do not.
        if not self._access.allows(request):
            return PlainTextResponse("no token", 403)
        if view not in self._session.pictures:
            return PlainTextResponse(f"no view {view!r}", 404)
        if view not in self._pictures:
            # Kept, because encoding 12 megapixels takes a tenth of a second.
            self._pictures[view] = await asyncio.to_thread(
                encoded_picture, self._session.pictures[view]
            )
        return Response(self._pictures[view], media_type="image/jpeg")

    async def socket(self, socket: Any) -> None:
        """Answer the messages of one page, and send it the changes of other pages."""
        from starlette.websockets import WebSocketDisconnect

        if not self._access.allows_socket(socket):
            await socket.close(1008)
            return
        await socket.accept()
        page = self._pages[socket] = _Page(Conversation(self._session), asyncio.Event())
        conversation = page.conversation
        # The page is told of others' changes by a task of its own: an update that fails, or a page
        # that does not read, is no other page's concern.
        telling = asyncio.create_task(self._tell(socket, page))
        slow: set[asyncio.Task[None]] = set()
        try:
            while True:
                message = await socket.receive_json()
                if isinstance(message, dict) and message.get("do") in SLOW_COMMANDS:
                    if len(slow) >= MAX_SLOW:
                        break
                    # Features of large pictures take seconds, in which clicks are answered.
                    task = asyncio.create_task(self._answer_later(socket, conversation, message))
                    slow.add(task)
                    task.add_done_callback(slow.discard)
                    continue
                document = self._session.document
                async with self._turn:
                    answer = await asyncio.to_thread(conversation.answer, message)
                # Others are told of a change even if the page that made it has left.
                if self._session.document is not document:
                    self._note_change(socket)
                await _send(socket, answer)
        except (WebSocketDisconnect, RuntimeError, LookupError, ValueError, TypeError):
            # The page has left (starlette raises a RuntimeError where a send noticed it first), or
            # a message is no mapping in JSON and so not from the page: this socket ends here.
            pass
        finally:
            for task in (telling, *slow):
                task.cancel()
            del self._pages[socket]

    async def _answer_later(self, socket: Any, conversation: Conversation, message: Any) -> None:
        """Answer a message that changes nothing and may take long."""
        async with self._slow_turn:
            answer = await asyncio.to_thread(conversation.answer, message)
        if socket in self._pages:
            await _send(socket, answer)

    def _note_change(self, changer: Any) -> None:
        """Notify every page of a change, except for the page that made it."""
        for socket, page in self._pages.items():
            if socket is not changer:
                page.behind.set()

    async def _tell(self, socket: Any, page: _Page) -> None:
        """Send a page the changes of other pages as they are made.

        Changes that are made while the page is still reading become one update.
        """
        while True:
            await page.behind.wait()
            page.behind.clear()
            try:
                async with self._turn:
                    update = await asyncio.to_thread(page.conversation.update)
                await _send(socket, update)
            # An update computes what the page shows, and anything may fail in it. The page connects
            # again after its socket was closed, and is then told the error or everything.
            except Exception:
                _LOGGER.exception("a page could not be told of a change: its socket is closed")
                with contextlib.suppress(Exception):
                    await socket.close(INTERNAL_ERROR)
                return


async def _send(socket: Any, message: dict[str, Any]) -> None:
    """Send a message to a page that may have been closed, which its own loop notices."""
    from starlette.websockets import WebSocketDisconnect

    # An error of one page's socket must not end another page's loop. Starlette raises a
    # RuntimeError for a socket that this side closed.
    with contextlib.suppress(WebSocketDisconnect, RuntimeError, OSError):
        await socket.send_json(message)


def encoded_picture(picture: np.ndarray) -> bytes:
    """Return a picture as JPEG, for the page."""
    # A lossless picture of 12 megapixels takes seconds to decode in the browser.
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data.tobytes()


def serve(
    session: ModelSession,
    port: int = 0,
    announce: Callable[[str], None] = lambda address: None,
    stop: threading.Event | None = None,
) -> None:
    """Serve a session until the process is interrupted, or until an event is set.

    Args:
        port: port to listen on; 0 takes a free one.
        announce: called with the page's address, including the token, when the server listens.
        stop: ends the server when it is set, by another thread; None for never.

    Raises:
        ImportError: starlette or uvicorn is not installed.
        OSError: the port is in use.
    """
    # The first click is prepared while the user looks at the pictures.
    ended = threading.Event()
    preparing = threading.Thread(target=session.prepare, args=(ended,), daemon=True)

    def make_app(token: str, bound_port: int) -> Any:
        preparing.start()
        return editor_app(session, token, bound_port)

    try:
        serve_page(make_app, port, announce, stop)
    finally:
        # A thread that still runs when Python exits would abort the process.
        ended.set()
        if preparing.ident is not None:
            preparing.join()
