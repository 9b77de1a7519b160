"""Recognise pictures that a program turned by right angles, or mirrored, before they were used.

Such a picture shows the target at another pose. Turned by right angles, it is as if the camera had
been turned about its optical axis. A mirrored view of a flat target is a view of it from behind.
"""

from typing import NamedTuple

import numpy as np

from ..geometry import host_rotation_vectors
from .closure import Poses
from .transform_fit import Matrix, TransformFit

MAX_TURN_ERROR, MAX_TURN_SHIFT = float(np.deg2rad(2.0)), 0.05
"""Differences (rotation, rad, and translation over the distance to the target) of a change from a
turn about the optical axis, up to which it is one: the lens is not in the picture's very middle."""


class PictureTurn(NamedTuple):
    """A turn or a mirror of pictures.

    Attributes:
        quarter_turns: 1, 2 or 3 for pictures that were turned by so many right angles; 0 for
            mirrored ones, whose turns the numbering of a symmetric target hides.
        is_mirrored: whether they were mirrored.
    """

    quarter_turns: int = 0
    is_mirrored: bool = False

    @property
    def text(self) -> str:
        """The change of a picture, as a participle."""
        if self.is_mirrored:
            return "mirrored (left and right, or top and bottom, swapped)"
        return f"turned by {90 * self.quarter_turns} degrees"

    @property
    def clause(self) -> str:
        """The change of several pictures, as a clause."""
        return f"the pictures had been {self.text}"

    @property
    def remedy(self) -> str:
        """The remedy for one picture."""
        return "mirror it back" if self.is_mirrored else "turn it back"

    @property
    def advice(self) -> str:
        """A question about several pictures, and the remedy, in sentences."""
        what = "mirror" if self.is_mirrored else "turn"
        return f"Did a program {what} some pictures? {what.capitalize()} them back"


MIRRORED = PictureTurn(is_mirrored=True)


def turn_of_change(
    camera_from_mount: Matrix, change: Matrix, distance: float
) -> PictureTurn | None:
    """Return by how many right angles a change turns the camera about its axis; None if by none.

    Args:
        camera_from_mount: the hand-eye transform.
        change: of the mount's frame.
        distance: median distance of the target, m.
    """
    turns = _quarter_turns(camera_from_mount @ change @ np.linalg.inv(camera_from_mount), distance)
    return PictureTurn(turns) if turns else None


def turn_of_picture(
    fit: TransformFit, robot: Matrix, camera: Matrix, distance: float
) -> PictureTurn | None:
    """Return how the picture of a view was turned or mirrored, so that it contradicts the others.

    Args:
        fit: of the other views.
        robot: `mount_from_holder` of the view.
        camera: `camera_from_world` of the view.
        distance: of its target, m.

    Returns:
        None if the view does not fit turned or mirrored either.
    """
    seen = np.stack([camera, mirrored_poses(camera)])
    hand_eye = fit.camera_from_mount
    as_given, as_mirrored = hand_eye @ fit.closure_of(robot[None], seen) @ np.linalg.inv(hand_eye)
    if turns := _quarter_turns(as_given, distance):
        return PictureTurn(turns)
    return None if _quarter_turns(as_mirrored, distance) is None else MIRRORED


_QUARTER_BACK = np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])

_TURNS_BACK = np.stack([np.linalg.matrix_power(_QUARTER_BACK, turns) for turns in range(4)])
"""Turns about the optical axis by 0 to 3 right angles, backwards."""


def _quarter_turns(of_camera: Matrix, distance: float) -> int | None:
    """Return the right angles, 0 to 3, by which a motion turns the camera; None for another one."""
    remaining = _TURNS_BACK @ of_camera
    angles = np.linalg.norm(host_rotation_vectors(remaining), axis=1)
    shift = float(np.linalg.norm(of_camera[:3, 3]))
    turns = int(np.argmin(angles))
    return turns if angles[turns] < MAX_TURN_ERROR and shift < MAX_TURN_SHIFT * distance else None


def mirrored_poses(camera_from_world: Poses) -> Poses:
    """Return the camera poses of a flat target with every picture mirrored left to right.

    A mirrored view of a plane is a view of it from behind: `F R diag(1, 1, -1)` and `F t`, with F
    the mirror. Top and bottom swapped is the same with the camera rotated by 180 degrees about its
    optical axis, which the hand-eye transform absorbs.
    """
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    return mirror @ camera_from_world @ np.diag([1.0, 1.0, -1.0, 1.0])
