"""State the small interface that a robot cell has, simulated or real."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from ...robots import Command, CommandLike, JointsLike


class CellError(RuntimeError):
    """The error that a cell did not do what it was told; its text says what and why."""


@runtime_checkable
class Cell(Protocol):
    """An arm with a camera and a gripper on its hand.

    Whatever drives a cell through these four methods alone drives a real robot by the same code.
    All lengths are in metres and all angles in radians; `DriverCell` is an example for a robot that
    counts in other units.
    """

    def move(self, target: CommandLike | JointsLike | Sequence[float]) -> Command:
        """Move the tool in a straight line, wait until it stands, and return where it is.

        Args:
            target: `base_from_tool` as a 4x4 matrix or a transform, or joint readings, or a
                `Command` with both; where there are joints, these count, unless the robot takes
                poses only.

        Raises:
            CellError: the arm does not get there, or the target is not finite; with the reason.
        """
        ...

    def picture(self) -> UInt8[np.ndarray, "rows columns"]:
        """Return a grey picture of what the camera sees from where the arm stands."""
        ...

    def set_gripper(self, width: float) -> float:
        """Move the fingers to a distance from each other, and return the distance reached, m.

        They stop where they meet something: zero closes the gripper on an object.

        Raises:
            ValueError: the width is negative, not finite, or more than the gripper opens, if that
                is known.
        """
        ...

    def where(self) -> Command:
        """Return what the robot reports: its tool's pose and, where it has them, its joints."""
        ...
