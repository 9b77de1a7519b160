"""Compute the reprojection error that remains when every view has a free pose.

It is a lower bound: no chain through a robot can predict better with the same camera. The
difference from the chain's error is due to the robot's poses, the target's size and the two
constant transforms.
"""

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration
from ..cameras import Camera
from ..dataset import Dataset
from ..geometry import transform_points
from ..runtime.compilation import compiled
from .measures import ReprojectionErrors, errors_of_predictions

MAX_STEPS = 50
"""The largest number of Levenberg-Marquardt steps; few suffice from the chain's poses."""


def free_pose_errors(calibration: Calibration, data: Dataset) -> ReprojectionErrors:
    """Return reprojection errors with every view's pose fitted to its own pixels, the camera held.

    Args:
        calibration: its camera and target scale are held; its chain gives the initial poses.
        data: views; a view with fewer than four visible points keeps the chain's pose.
    """
    return errors_of_predictions(
        calibration.camera, data, *free_pose_predictions(calibration, data)
    )


def free_pose_predictions(
    calibration: Calibration, data: Dataset
) -> tuple[
    Float[Array, "views points 2"], Bool[Array, "views points"], Float[Array, "views points"]
]:
    """Return pixels, their validity and depths (m) of all points under the fitted free poses."""
    initial_poses = calibration.camera_from_world(data.command)
    points = calibration.true_points(data.points)
    # Four points determine a pose; with fewer all residuals are zero, and the start stays.
    determined = data.visible.sum(axis=1, keepdims=True) >= 4
    # NaN of unseen pixels would propagate through the derivatives of the masked residuals.
    pixels = jnp.where(data.visible[..., None], data.pixels, 0.0)
    poses = _fit_poses(calibration.camera, initial_poses, points, pixels, data.visible & determined)
    in_camera = transform_points(poses, points)
    return *calibration.camera.project(in_camera), in_camera[..., 2]


@compiled
def _fit_poses(
    camera: Camera,
    start: SE3,
    points: Float[Array, "views points 3"],
    pixels: Float[Array, "views points 2"],
    used: Bool[Array, "views points"],
) -> SE3:
    """Return every view's `camera_from_world` that minimises its reprojection error."""
    solver = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-10)

    def fit(pose: Array, points: Array, pixels: Array, used: Array) -> Float[Array, "7"]:
        # r(xi) = pixel - project(exp(xi) T p), zero where a point is not used. From zero, each step
        # solves (J^T J + lambda I) xi = -J^T r.
        def residuals(twist: Float[Array, "6"], _: None) -> Float[Array, "points 2"]:
            predicted, valid = camera.project((SE3.exp(twist) @ SE3(pose)) @ points)
            return jnp.where((used & valid)[:, None], pixels - predicted, 0.0)

        fitted = optx.least_squares(
            residuals, solver, jnp.zeros(6), max_steps=MAX_STEPS, throw=False
        )
        return (SE3.exp(fitted.value) @ SE3(pose)).wxyz_xyz

    return SE3(jax.vmap(fit)(start.wxyz_xyz, points, pixels, used))
