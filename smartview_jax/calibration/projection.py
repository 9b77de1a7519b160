"""Project target points by a calibrated chain, and find the robot pose for a camera pose (Eq. 19).

One compiled program serves all numbers of views and points up to a size: they are padded.
"""

import math
from typing import TYPE_CHECKING

import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..geometry import PoseLike, as_se3, host_matrices, transform_points
from ..robots import Command
from ..runtime.compilation import compiled, is_traced
from ..runtime.padding import padded_counts, repeat_last, without_padding
from .chain import mount_from_holder, mount_from_holder_matrices

if TYPE_CHECKING:
    from .calibration import Calibration

_MIN_PROJECTED = 16, 128
"""Smallest numbers of views and of points of the programs that project; any fewer share one."""


def projected_points(
    calibration: "Calibration",
    reported: Command,
    points: Float[Array, "*points 3"],
    corrected: bool,
) -> tuple[Float[Array, "*pixels 2"], Bool[Array, "*pixels"]]:
    """Return the pixels of target points, and their validity; see `Calibration.project`."""
    if is_traced(calibration, reported, points) or points.ndim < 2:
        return _project(calibration, reported, points, corrected)
    shape, count = reported.base_from_tool.wxyz_xyz.shape[:-1], points.shape[-2]
    padded_views, padded_points = padded_counts(
        max(math.prod(shape), _MIN_PROJECTED[0]), max(count, _MIN_PROJECTED[1])
    )
    padded = repeat_last(points, padded_points, axis=-2)
    if len(shape) == 1:
        reported = repeat_last(reported, padded_views)
        padded = repeat_last(padded, padded_views) if points.shape[:-2] == shape else padded
    projected = _project(calibration, reported, padded, corrected)
    return without_padding(projected, *np.broadcast_shapes(shape, points.shape[:-2]), count)


@compiled
def _project(
    calibration: "Calibration",
    reported: Command,
    points: Float[Array, "*points 3"],
    corrected: bool,
) -> tuple[Float[Array, "*pixels 2"], Bool[Array, "*pixels"]]:
    """Return the pixels of target points, and their validity, compiled."""
    return calibration.camera.project(points_in_camera(calibration, reported, points, corrected))


@compiled
def points_in_camera(
    calibration: "Calibration",
    reported: Command,
    points: Float[Array, "*points 3"],
    corrected: bool,
) -> Float[Array, "*transformed 3"]:
    """Return target points in the camera frame by Eq. 1, compiled."""
    # Eq. 1: x_camera = R x_world + t, with R and t of camera_from_world. The scale acts on the
    # target about its own origin, so it is applied before any transform.
    camera_from_world = calibration.camera_from_world(reported, corrected=corrected)
    return transform_points(camera_from_world, calibration.true_points(points))


def base_from_tool_for(calibration: "Calibration", camera_from_world: PoseLike) -> SE3:
    """Return the true `base_from_tool` for a wanted camera pose, without robot error.

    Eq. 19, `base_from_tool = base_from_world @ world_from_camera @ camera_from_tool`, is Eq. 10
    solved for the robot's part.
    """
    # The inverse of Eq. 19: tool_from_base = tool_from_camera @ camera_from_world
    # @ world_from_base; with mount and holder it holds for both mounts.
    pose = as_se3(camera_from_world)
    ends = calibration.camera_from_mount, calibration.holder_from_world
    if not is_traced(pose, ends):
        # A product of matrices: nothing to compile for every number of views.
        mount_from_camera, world_from_holder = map(np.linalg.inv, map(host_matrices, ends))
        robot = mount_from_camera @ host_matrices(pose) @ world_from_holder
        return as_se3(mount_from_holder_matrices(calibration.mount, robot))
    robot = ends[0].inverse() @ pose @ ends[1].inverse()
    return mount_from_holder(calibration.mount, robot)
