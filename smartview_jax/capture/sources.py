"""Define what capture needs of a camera and of a robot, and open lost ones again."""

import contextlib
import threading
import time
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

RETRY_SECONDS = 1.0
"""Time between two attempts to open a lost camera or robot, s."""


class SourceLostError(OSError):
    """The error that a camera or a robot does not answer any more; it may come back."""


class MoveRefusedError(RuntimeError):
    """The error that the robot does not move to a pose, or was stopped on the way."""


@runtime_checkable
class Camera(Protocol):
    """A source of pictures.

    Attributes:
        is_continuous: whether two calls give pictures of two moments; False where every picture is
            triggered by hand.
    """

    is_continuous: bool

    def read(self) -> UInt8[np.ndarray, "..."]:
        """Return a picture exposed after the call, grey or BGR, or raise a SourceLostError."""
        ...

    def close(self) -> None:
        """Release the camera; a second call does nothing."""
        ...


@runtime_checkable
class Robot(Protocol):
    """A source of poses."""

    def pose(self) -> Float[np.ndarray, "4 4"]:
        """Return `base_from_tool` that the controller reports, m, or raise a SourceLostError."""
        ...

    def close(self) -> None:
        """End the connection; a second call does nothing. The robot stays where it is."""
        ...


@runtime_checkable
class MovingRobot(Robot, Protocol):
    """A robot that moves on request."""

    def move(
        self, base_from_tool: Float[np.ndarray, "4 4"], speed: float, stop: threading.Event
    ) -> None:
        """Move the tool in a straight line to a pose, and return when it stands.

        Args:
            base_from_tool: the pose to reach, m.
            speed: largest speed of the tool, m/s.
            stop: set by another thread to stop on the way.

        Raises:
            SourceLostError: the controller does not answer.
            MoveRefusedError: the pose is not reached, or the motion was stopped.
        """
        ...


SourceT = TypeVar("SourceT", Camera, Robot)


class Reopened(Generic[SourceT]):
    """A camera or robot that is opened when it is needed, and again after it was lost.

    Attributes:
        trouble: why there is none at the moment; empty if there is one, or if none was opened yet.
    """

    def __init__(self, open_source: Callable[[], SourceT], retry_seconds: float = RETRY_SECONDS):
        """Store the function that opens the source.

        Args:
            open_source: opens it, or raises an OSError.
            retry_seconds: time between two attempts to open it, s.
        """
        self._open, self._retry = open_source, retry_seconds
        self._source: SourceT | None = None
        self._next_attempt = 0.0
        self._lock = threading.RLock()
        self.trouble: str = ""

    @property
    def current(self) -> SourceT | None:
        """The open source; None if there is none, which this does not change."""
        return self._source

    def get(self) -> SourceT:
        """Return the open source; a SourceLostError if it cannot be opened, or was just lost."""
        with self._lock:
            if self._source is not None:
                return self._source
            if time.monotonic() < self._next_attempt:
                raise SourceLostError(self.trouble)
            try:
                self._source = self._open()
            except OSError as error:
                self.lose(error)
                raise SourceLostError(self.trouble) from error
            self.trouble = ""
            return self._source

    def lose(self, error: BaseException) -> None:
        """Close the source after an error, so that it is opened again later."""
        with self._lock:
            self.trouble = str(error) or type(error).__name__
            self._next_attempt = time.monotonic() + self._retry
            self.close()

    def close(self) -> None:
        """Close the source, if it is open."""
        with self._lock:
            source, self._source = self._source, None
            if source is not None:
                # The connection that is closed may be the broken one.
                with contextlib.suppress(OSError):
                    source.close()
