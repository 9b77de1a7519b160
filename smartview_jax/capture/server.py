"""Serve the page of a capture on this machine; `editor.local_page` checks who may open it."""

import asyncio
import contextlib
import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..editor import PageAccess, serve_page
from ..extras import import_extra
from ..geometry import host_transforms
from .session import CaptureSession, NotTakenError
from .sources import MoveRefusedError, SourceLostError
from .unattended import CaptureOutcome, capture_unattended

PAGE = Path(__file__).parent / "page"
"""The folder of the page's files."""

JPEG_QUALITY = 80
"""JPEG quality of the live picture; views are stored without loss."""

MAX_SHOWN_WIDTH = 1280
"""Largest width of the live picture, px."""

LOOK_SECONDS = 0.2
"""Time between two live pictures, s."""

WATCHED_SECONDS = 3.0
"""Time after the last request of a page for which pictures are still taken, s."""

MAX_LINES = 8
"""Number of lines of the log that the page shows."""

MAX_BODY = 10_000
"""Largest request of the page, bytes."""

_LOGGER = logging.getLogger(__name__)


class CapturePage:
    """A session as the page shows it, with the threads that look and move."""

    def __init__(self, session: CaptureSession, max_views: int = 40):
        """Store the session and the largest number of views of an automatic run."""
        self._session, self._max_views = session, max_views
        session.listener = self.note
        self._closing = threading.Event()
        self._watched = 0.0
        self._lines: list[str] = []
        self._end_run = threading.Event()
        self._run: threading.Thread | None = None
        # One command of the page at a time; a stop does not wait for it.
        self._turn = threading.Lock()
        self._looking = threading.Thread(target=self._look_until_closed, daemon=True)
        self._planning = threading.Thread(target=self._plan_first, daemon=True)

    def __enter__(self) -> "CapturePage":
        """Begin to look and to plan."""
        self._looking.start()
        self._planning.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the robot and end all threads."""
        self._closing.set()
        self.stop()
        for thread in (self._looking, self._planning, self._run):
            if thread is not None:
                thread.join()

    def note(self, text: str) -> None:
        """Add a line to the log on the page."""
        self._lines = [*self._lines[1 - MAX_LINES :], f"{time.strftime('%H:%M:%S')} {text}"]

    def status(self) -> dict[str, Any]:
        """Return what the page shows, as plain numbers and texts."""
        self._watched = time.monotonic()
        session = self._session
        look, last, settle = session.last_look, session.last_estimate, session.last_settle_test
        covered = session.coverage()
        width, height = session.folder.description.image_size
        target = None
        if look is not None:
            detection = look.detection
            rows, columns = look.picture.shape[:2]
            target = {
                "count": int(detection.visible.sum()),
                "of": len(detection.visible),
                "reason": detection.reason,
                "points": np.round(detection.pixels[detection.visible], 1).tolist(),
                "size": [columns, rows],
                "time": look.time,
            }
        return {
            "folder": session.folder.folder.name,
            "views": session.view_count,
            "size": [width, height],
            "goal_mm": 1e3 * session.options.goal,
            "error_mm": None if last is None or not np.isfinite(last.error) else 1e3 * last.error,
            "fitted_views": 0 if last is None else last.views,
            "reliable": last is not None and last.is_reliable,
            "fitting": session.is_fitting,
            "reached": session.is_reached,
            "warnings": [] if last is None else list(last.warnings[:2]),
            "troubles": list(session.troubles),
            "target": target,
            "settle": None if settle is None else {"ok": settle.is_settled, "text": settle.reason},
            "cells": covered.cells.astype(int).tolist(),
            "rotations_deg": np.rad2deg(covered.rotations).round(1).tolist(),
            "proposal": self._proposal(),
            "robot": self._pose_text(None if look is None else look.pose),
            "pose_units": self._pose_units(),
            "typed": session.is_typed,
            "may_move": session.options.motion is not None,
            "moving": session.is_moving,
            "stopped": session.is_stopped,
            "running": self._run is not None and self._run.is_alive(),
            "lines": self._lines,
        }

    def _proposal(self) -> dict[str, Any] | None:
        """Return the next view: its pose as the robot writes it, and whether it is rough."""
        proposal = self._session.proposal
        if proposal is None:
            return None
        return {
            "text": self._pose_text(proposal.base_from_tool),
            "rough": proposal.is_rough,
        }

    def _pose_text(self, pose: np.ndarray | None) -> str:
        """Return a pose with the names of its numbers, in the robot's format and units."""
        if pose is None:
            return ""
        codec = self._session.folder.pose_format.codec
        row = np.asarray(codec.encode(host_transforms(pose), *codec.units))
        lengths = set(codec.length_columns)
        digits = [
            (4 if codec.units[0] == "m" else 2) if k in lengths else 3 for k in range(len(row))
        ]
        # A space that does not break: a number stays with its name.
        return "  ".join(
            f"{name}\N{NO-BREAK SPACE}{number:.{digit}f}"
            for name, number, digit in zip(codec.columns, row, digits, strict=True)
        )

    def _pose_units(self) -> str:
        """Return the units in which poses are shown, such as `mm, deg`."""
        codec = self._session.folder.pose_format.codec
        return ", ".join(codec.units if codec.angle_columns else codec.units[:1])

    def picture(self) -> bytes | None:
        """Return the live picture as JPEG; None before the first."""
        look = self._session.last_look
        if look is None:
            return None
        picture = look.picture
        if picture.shape[1] > MAX_SHOWN_WIDTH:
            factor = MAX_SHOWN_WIDTH / picture.shape[1]
            picture = cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        return data.tobytes()

    def do(self, message: Any) -> dict[str, Any]:
        """Execute a command of the page, and return whether it went well and what to say.

        The message has `do`: take, move, skip, run, stop or pose (with `text`).
        """
        command = message.get("do") if isinstance(message, dict) else None
        # At once, whatever else is done.
        if command == "stop":
            self.stop()
            return self._answer(True, "stopped")
        with self._turn:
            try:
                text = self._done(command, message)
            except (NotTakenError, MoveRefusedError, OSError, ValueError) as error:
                return self._answer(False, str(error))
        # The session itself notes a view that it took.
        return {"ok": True, "text": text} if command == "take" else self._answer(True, text)

    def stop(self) -> None:
        """Stop the robot and an automatic run."""
        # In this order: a run that has just ended a motion must not begin another one.
        self._end_run.set()
        self._session.stop()

    def _done(self, command: Any, message: dict[str, Any]) -> str:
        """Execute a command, and return what to say."""
        session = self._session
        if command == "pose":
            session.type_pose(str(message.get("text", ""))[:1000])
            return "pose read"
        if self._run is not None and self._run.is_alive():
            raise ValueError("an automatic run is going on: stop it first")
        if command == "take":
            return f"view {session.take()} taken"
        if command == "skip":
            proposal = session.proposal
            if proposal is not None:
                session.skip(proposal)
            return "skipped"
        if command == "move":
            proposal = session.proposal
            if proposal is None:
                raise ValueError("no view is proposed yet")
            session.allow_motion()
            session.move_to(proposal)
            return "moved to the proposed view"
        if command == "run":
            session.allow_motion()
            self._end_run.clear()
            self._run = threading.Thread(target=self._run_unattended, daemon=True)
            self._run.start()
            return "automatic run"
        raise ValueError(f"no such command: {command!r}"[:100])

    def _answer(self, ok: bool, text: str) -> dict[str, Any]:
        """Return the answer to a command, and note it."""
        self.note(text)
        return {"ok": ok, "text": text}

    def _run_unattended(self) -> None:
        """Take views without a person until the goal is reached."""
        outcome: CaptureOutcome
        try:
            outcome = capture_unattended(self._session, self._max_views, closing=self._end_run)
        # Shown on the page, which a thread that ended silently would leave waiting.
        except Exception as error:
            _LOGGER.exception("an automatic run failed")
            self.note(f"the automatic run failed: {error}")
            return
        self.note(f"automatic run: {outcome.reason}")

    def _look_until_closed(self) -> None:
        """Look at the live picture as long as a page is open."""
        while not self._closing.wait(LOOK_SECONDS):
            is_watched = time.monotonic() - self._watched < WATCHED_SECONDS
            if not is_watched or self._session.is_moving:
                continue
            # Lost sources are in the session's troubles, and are tried again.
            with contextlib.suppress(SourceLostError, ValueError):
                self._session.look()

    def _plan_first(self) -> None:
        """Plan the first views, which takes some seconds."""
        try:
            self._session.plan_first()
        except ValueError as error:
            self.note(f"no first views: {error}")


def capture_app(page: CapturePage, token: str, port: int) -> Any:
    """Return the ASGI application of a capture; the first request must have the token."""
    import_extra("starlette", "editor", "the page of smartview capture")
    from starlette.applications import Starlette
    from starlette.responses import JSONResponse, PlainTextResponse, Response
    from starlette.routing import Mount, Route
    from starlette.staticfiles import StaticFiles

    access = PageAccess(token, port, "capture")

    async def index(request: Any) -> Any:
        return access.page_response(request, PAGE / "index.html")

    async def status(request: Any) -> Any:
        if not access.allows(request):
            return PlainTextResponse("no token", 403)
        return JSONResponse(await asyncio.to_thread(page.status))

    async def picture(request: Any) -> Any:
        if not access.allows(request):
            return PlainTextResponse("no token", 403)
        data = await asyncio.to_thread(page.picture)
        if data is None:
            return PlainTextResponse("no picture yet", 404)
        return Response(data, media_type="image/jpeg", headers={"cache-control": "no-store"})

    async def do(request: Any) -> Any:
        # A command may move a robot: it needs the token, and the page itself as its origin.
        if not access.allows_socket(request):
            return PlainTextResponse("not from this page", 403)
        body = bytearray()
        async for part in request.stream():
            body += part
            if len(body) > MAX_BODY:
                return PlainTextResponse("too long", 413)
        import json

        try:
            message = json.loads(body)
        except ValueError:
            return PlainTextResponse("expected JSON", 400)
        return JSONResponse(await asyncio.to_thread(page.do, message))

    return Starlette(
        routes=[
            Route("/", index),
            Route("/status", status),
            Route("/picture", picture),
            Route("/do", do, methods=["POST"]),
            Mount("/", StaticFiles(directory=PAGE)),
        ],
        middleware=access.middleware(),
    )


def serve_capture(
    session: CaptureSession,
    port: int = 0,
    announce: Callable[[str], None] = lambda address: None,
    max_views: int = 40,
    stop: threading.Event | None = None,
) -> None:
    """Serve the page of a session until the process is interrupted, or until an event is set.

    Args:
        port: port to listen on; 0 takes a free one.
        announce: called with the page's address, including the token, when the server listens.
        max_views: largest number of views of an automatic run.
        stop: ends the server when it is set, by another thread; None for never.

    Raises:
        ImportError: starlette or uvicorn is not installed.
        OSError: the port is in use.
    """
    with CapturePage(session, max_views) as page:
        serve_page(lambda token, bound: capture_app(page, token, bound), port, announce, stop)
