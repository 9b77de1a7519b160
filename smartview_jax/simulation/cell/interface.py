"""Define the small interface of a robot cell, simulated or real."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from ...robots import Command, CommandLike, JointsLike


class CellError(RuntimeError):
    """The error that a cell did not execute a command; its text says what and why."""


@runtime_checkable
class Cell(Protocol):
    """An arm with a camera and a gripper on its hand.

    Code that drives a cell only through these four methods also drives a real robot. All lengths
    are in metres and all angles in radians; `DriverCell` is an example for a robot with other
    units.
    """

    def move(self, target: CommandLike | JointsLike | Sequence[float]) -> Command:
        """Move the tool in a straight line, wait until it stands, and return where it is.

        Args:
            target: `base_from_tool` as a 4x4 matrix or a transform, or joint readings, or a
                `Command` with both; joints take precedence, unless the robot takes only poses.

        Raises:
            CellError: the arm does not reach the target, or this is not finite; with the reason.
        """
        ...

    def picture(self) -> UInt8[np.ndarray, "rows columns"]:
        """Return a grey picture from the camera's current pose."""
        ...

    def set_gripper(self, width: float) -> float:
        """Move the fingers to a distance from each other, and return the distance reached, m.

        They stop when they meet something: zero closes the gripper on an object.

        Raises:
            ValueError: the width is negative, not finite, or more than the gripper opens, if that
                is known.
        """
        ...

    def where(self) -> Command:
        """Return the robot's report: its tool's pose and, if it has them, its joints."""
        ...
