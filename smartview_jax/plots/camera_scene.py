"""Place cameras and target in the target's frame, for all drawings of them in space."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..calibration import Calibration
from ..cameras import Camera
from ..dataset import Dataset

FRUSTUM_DEPTH = 0.18
"""Depth of a drawn camera, over the cameras' median distance from the target."""


class CameraScene(NamedTuple):
    """Cameras as pyramids and the target's points, in the target's frame, m.

    Attributes:
        centres: centre of each camera.
        corners: corners of each picture, projected into space, in order around it.
        used: whether a view has any point that was not rejected.
        target: every visible point of the target, once.
        axis_length: length at which to draw the axes of the frame.
    """

    view_ids: tuple[str, ...]
    centres: Float[np.ndarray, "views 3"]
    corners: Float[np.ndarray, "views 4 3"]
    used: Bool[np.ndarray, "views"]
    target: Float[np.ndarray, "points 3"]
    axis_length: float

    @property
    def camera_side_is_below(self) -> bool:
        """Whether the cameras are on the side of negative z, where the target's z points away."""
        return bool(self.centres[:, 2].mean() < 0.0)


def camera_scene(data: Dataset, calibration: Calibration) -> CameraScene:
    """Return the poses of the cameras by a calibration; a ValueError if no view shows a point."""
    visible = np.asarray(data.visible)
    if not visible.any():
        raise ValueError("data: no view shows any point, so there is nothing to draw")
    world_from_camera = np.linalg.inv(calibration.camera_from_world_matrices(data.command))
    centres, rotations = world_from_camera[:, :3, 3], world_from_camera[:, :3, :3]
    target = np.asarray(data.points)[visible]
    # Every target point once, although most views show it; points equal to a micrometre are the
    # same.
    target = target[np.unique(np.round(target, 6), axis=0, return_index=True)[1]]
    length = FRUSTUM_DEPTH * float(np.median(np.linalg.norm(centres - target.mean(axis=0), axis=1)))
    corners = picture_corners(calibration.camera)
    # p_world = centre + depth * R_world_from_camera * ray
    in_world = centres[:, None] + length * np.einsum("kj,vij->vki", corners, rotations)
    return CameraScene(
        data.view_ids, centres, in_world, np.asarray(visible.any(axis=1)), target, length
    )


def picture_corners(camera: Camera) -> Float[np.ndarray, "4 3"]:
    """Return the corners of a camera's picture at depth 1 in its frame, without distortion."""
    # ((u - u0) / alpha_u, (v - v0) / alpha_v, 1)
    width, height = camera.image_size
    x = (np.array([0.0, width, width, 0.0]) - float(camera.u0)) / float(camera.alpha_u)
    y = (np.array([0.0, 0.0, height, height]) - float(camera.v0)) / float(camera.alpha_v)
    return np.stack([x, y, np.ones(4)], axis=1)
