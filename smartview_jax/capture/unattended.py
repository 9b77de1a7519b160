"""Capture without a person: move, settle, take, until the expected error is small enough."""

import math
import threading
import time
from contextlib import suppress
from typing import NamedTuple

from .session import CaptureSession, NotTakenError
from .sources import MoveRefusedError, SourceLostError

SETTLE_ATTEMPTS = 10
"""Attempts to take a view at which everything should stand still, before the next one is tried."""

SETTLE_SECONDS = 0.2
"""Time between two attempts, s."""

MAX_FAILURES = 20
"""Largest number of proposed views in a row that could not be taken.

A robot that reaches but a third of the proposals fails so often by chance once in 3000 times.
"""

FIT_PATIENCE = 600.0
"""Longest time to wait for a fit, s: a machine that compiles for the first time takes a minute."""


class CaptureOutcome(NamedTuple):
    """The outcome of an unattended capture.

    Attributes:
        is_reached: whether the expected error is as small as wanted.
        views: number of views in the folder.
        error: expected error, m; infinite if unknown.
        reason: why it ended, in a sentence.
    """

    is_reached: bool
    views: int
    error: float
    reason: str


def capture_unattended(
    session: CaptureSession,
    max_views: int = 40,
    patience: float = 60.0,
    closing: threading.Event | None = None,
) -> CaptureOutcome:
    """Take views until the goal is reached, and return how it ended.

    Where the robot may be moved, it is moved to the proposed views. Otherwise a view is taken
    whenever a robot that another program moves stands still at a new place.

    Args:
        patience: longest time without a camera, a robot or a view that can be taken, s.
        closing: set by another thread to end.
    """
    moves = session.options.motion is not None
    closing = closing or threading.Event()
    trouble, failures = "no view could be taken", 0
    if moves:
        session.plan_first()
    # From here on: a plan or a fit that is compiled for the first time may take a minute.
    last_success = time.monotonic()
    while not closing.is_set():
        if moves and session.is_stopped:
            return _outcome(session, "stopped")
        if session.is_reached:
            # The newest views may not be fitted yet: the outcome states the error of all.
            session.wait_for_fit(FIT_PATIENCE)
            if session.is_reached:
                return _outcome(session, _reached_words(session))
        if session.view_count >= max_views:
            session.wait_for_fit(FIT_PATIENCE)
            return _outcome(session, _limit_words(session))
        if time.monotonic() - last_success > patience:
            return _outcome(session, f"nothing for {patience:g} s: {trouble}")
        try:
            before = session.view_count
            if _next_view(session, moves):
                last_success = time.monotonic()
            if session.view_count > before:
                failures = 0
        except (SourceLostError, NotTakenError, MoveRefusedError) as error:
            trouble = str(error)
            failures += not isinstance(error, SourceLostError)
            if moves and failures >= MAX_FAILURES:
                return _outcome(session, f"{failures} proposed views failed, the last: {trouble}")
            # What is lost is opened again after some time.
            closing.wait(SETTLE_SECONDS)
        except StopIteration:  # there is no view to move to
            return _outcome(session, f"no more views can be proposed; {trouble}")
    return _outcome(session, "ended")


def _next_view(session: CaptureSession, moves: bool) -> bool:
    """Take one view, and return whether one was taken or a fit was waited for.

    Raises:
        StopIteration: there is no view to move to.
        SourceLostError, NotTakenError, MoveRefusedError: it was not taken.
    """
    if not moves:
        if not session.is_new_place():
            time.sleep(SETTLE_SECONDS)
            return False
        session.take()
        return True
    proposal = session.proposal
    if proposal is None:
        # Nothing is known from which to plan, unless a fit is about to be ready.
        if session.is_fitting:
            return session.wait_for_fit(FIT_PATIENCE)
        # Where the first views failed, there are others according to the drawing.
        with suppress(ValueError):
            session.plan_first()
        if session.proposal is None:
            raise StopIteration
        return False
    try:
        session.move_to(proposal)
        _take_when_settled(session)
    except (MoveRefusedError, NotTakenError):
        # Where a person stopped the robot, it can go later.
        if not session.is_stopped:
            session.skip(proposal, failed=True)
        raise
    session.skip(proposal)
    return True


def _take_when_settled(session: CaptureSession) -> None:
    """Take a view as soon as everything stands still."""
    for attempt in range(SETTLE_ATTEMPTS):
        try:
            session.take()
            return
        except NotTakenError:
            test = session.last_settle_test
            # A target that is not in the picture does not come by waiting.
            is_moving = test is not None and test.motion == test.motion
            if not is_moving or attempt + 1 == SETTLE_ATTEMPTS:
                raise
            time.sleep(SETTLE_SECONDS)


def _reached_words(session: CaptureSession) -> str:
    """Return the sentence that says that the goal is reached."""
    return f"stop: {1e3 * session.options.goal:g} mm reached"


def _limit_words(session: CaptureSession) -> str:
    """Return how a run ends that may take no more views: the goal is reached, or why it is not."""
    if session.is_reached:
        return _reached_words(session)
    taken, last = f"{session.view_count} views were taken", session.last_estimate
    if last is None:
        return f"{taken}, but none is fitted yet: a fit needs {session.options.first_fit}"
    if not math.isfinite(last.error):
        return "; ".join([f"{taken}, but the error is not known yet", *last.warnings[:1]])
    goal, error = session.options.goal, f"{1e3 * last.error:.2g} mm"
    missing = last.missing_views(goal)
    more = f"{missing} more {'view' if missing == 1 else 'views'}"
    if last.error <= goal:
        return f"{taken}: {error} reached, but an error is believed only with {more}"
    words = f"{taken}: {error} reached instead of {1e3 * goal:g} mm"
    return words if missing is None else f"{words}; that needs about {more}"


def _outcome(session: CaptureSession, reason: str) -> CaptureOutcome:
    """Return how the capture ended."""
    last = session.last_estimate
    error = float("inf") if last is None else last.error
    return CaptureOutcome(session.is_reached, session.view_count, error, reason)
