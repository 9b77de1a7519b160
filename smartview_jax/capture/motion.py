"""Move a robot within a stated box, in small straight steps that can be stopped."""

import threading
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..geometry import host_exponentials, host_logarithms, host_poses
from .sources import MoveRefusedError

STEP_LENGTH, STEP_ANGLE = 0.01, float(np.deg2rad(3.0))
"""Largest step of a motion, m and rad. A stop takes effect after the step that has begun, so at
0.1 m/s after a tenth of a second."""


class MotionLimits(NamedTuple):
    """The limits of motions that a person has stated.

    Attributes:
        lowest, highest: opposite corners of a box in the base frame that the tool's origin never
            leaves, m.
        speed: largest speed of the tool, m/s.
    """

    lowest: tuple[float, float, float]
    highest: tuple[float, float, float]
    speed: float = 0.1

    def require_inside(self, base_from_tool: Float[np.ndarray, "4 4"]) -> None:
        """Raise a MoveRefusedError for a pose that is not in the box."""
        position = base_from_tool[:3, 3]
        # NaN is not inside either.
        inside = (position >= self.lowest) & (position <= self.highest)
        if not inside.all():
            axis = "xyz"[int(np.argmin(inside))]
            value = position["xyz".index(axis)]
            low, high = self.lowest["xyz".index(axis)], self.highest["xyz".index(axis)]
            raise MoveRefusedError(
                f"the tool would be at {axis} = {value:.3f} m, outside the box ({low:g} to "
                f"{high:g} m)"
            )

    def is_inside(self, base_from_tool: Float[np.ndarray, "4 4"]) -> bool:
        """Return whether a pose is in the box."""
        try:
            self.require_inside(base_from_tool)
        except MoveRefusedError:
            return False
        return True


def straight_steps(
    start: Float[np.ndarray, "4 4"],
    end: Float[np.ndarray, "4 4"],
    max_length: float = STEP_LENGTH,
    max_angle: float = STEP_ANGLE,
) -> Float[np.ndarray, "steps 4 4"]:
    """Return poses on the straight line between two poses, without the first and with the last.

    The orientation turns evenly about one axis.

    Args:
        start, end: the two poses.
        max_length, max_angle: largest step, m and rad.
    """
    turn = host_logarithms(np.linalg.inv(start) @ end)[3:]
    shift = end[:3, 3] - start[:3, 3]
    length, angle = float(np.linalg.norm(shift)), float(np.linalg.norm(turn))
    count = max(1, int(np.ceil(max(length / max_length, angle / max_angle))))
    fractions = np.arange(1, count + 1)[:, None] / count
    # Only the rotation: the translation of an exponential would follow a screw.
    rotations = host_exponentials(np.hstack([np.zeros((count, 3)), fractions * turn]))[:, :3, :3]
    steps = host_poses(start[:3, :3] @ rotations, start[:3, 3] + fractions * shift)
    steps[-1] = end
    return steps


def refuse_if_stopped(stop: threading.Event) -> None:
    """Raise a MoveRefusedError if a motion was stopped."""
    if stop.is_set():
        raise MoveRefusedError("stopped")
