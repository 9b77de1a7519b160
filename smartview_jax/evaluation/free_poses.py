"""What the camera alone would allow: every view with a pose of its own.

No chain through a robot can predict better than this with the same camera, so the gap between the
two is what the robot's poses, the target's size and the two fixed transforms cost.
"""

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration
from ..cameras import Camera
from ..compilation import compiled
from ..dataset import Dataset
from ..geometry import transform_points
from .measures import Deviations, measured

STEPS = 50
"""Of Levenberg-Marquardt; the chain's poses are close, and a handful is enough."""


def free_pose_deviations(calibration: Calibration, data: Dataset) -> Deviations:
    """Deviations left when every view's pose is fitted to its own pixels, the camera held.

    Args:
        calibration: its camera and target scale are kept; its chain is where each pose starts.
        data: views with at least four visible points are fitted, others keep the chain's pose.
    """
    return measured(calibration.camera, data, *free_pose_predictions(calibration, data))


def free_pose_predictions(
    calibration: Calibration, data: Dataset
) -> tuple[
    Float[Array, "views points 2"], Bool[Array, "views points"], Float[Array, "views points"]
]:
    """Pixels, where they are valid, and depths (m), of which `free_pose_deviations` are made."""
    started = calibration.camera_from_world(data.command)
    points = calibration.target_scale * data.points
    enough = data.visible.sum(axis=1, keepdims=True) >= 4
    pixels = jnp.where(data.visible[..., None], data.pixels, 0.0)
    poses = _fit_poses(calibration.camera, started, points, pixels, data.visible & enough)
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
    solver = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-10)

    def fit(pose: Array, points: Array, pixels: Array, used: Array) -> Float[Array, "7"]:
        def residuals(twist: Float[Array, "6"], _: None) -> Float[Array, "points 2"]:
            predicted, valid = camera.project((SE3.exp(twist) @ SE3(pose)) @ points)
            return jnp.where((used & valid)[:, None], pixels - predicted, 0.0)

        fitted = optx.least_squares(residuals, solver, jnp.zeros(6), max_steps=STEPS, throw=False)
        return (SE3.exp(fitted.value) @ SE3(pose)).wxyz_xyz

    return SE3(jax.vmap(fit)(start.wxyz_xyz, points, pixels, used))
