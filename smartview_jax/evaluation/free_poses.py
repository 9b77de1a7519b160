"""Compute the reprojection error that remains when every view has a free pose.

It is a lower bound: no chain through a robot can predict better with the same camera. The
difference from the chain's error is due to the robot's poses, the target's size and the two
constant transforms.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration
from ..cameras import Camera
from ..dataset import Dataset, Observations, require_same_set_up
from ..engine import linearise_views
from ..geometry import matrix_exponentials, moved_points, pose_matrices
from ..runtime.array_namespace import AnyArray
from ..runtime.compilation import compiled
from ..runtime.modules import with_fields
from ..runtime.padding import host_without_padding
from .measures import ReprojectionErrors, errors_of_predictions

MAX_STEPS = 50
"""The largest number of Levenberg-Marquardt steps; few suffice from the chain's poses."""

TOLERANCE = 1e-14
"""Decrease of a view's cost, relative to the cost, that a further step need not bring."""


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
    Float[AnyArray, "views points 2"],
    Bool[AnyArray, "views points"],
    Float[AnyArray, "views points"],
]:
    """Return pixels, their validity and depths (m) of all points under the fitted free poses.

    They are NumPy arrays.
    """
    require_same_set_up("the calibration", calibration, data)
    visible = np.asarray(data.visible)
    # Four points determine a pose; with fewer all residuals are zero, and the start stays.
    determined = visible.sum(axis=1, keepdims=True) >= 4
    # In the place of the robot's, the observations have the poses from which the fit begins.
    observations = with_fields(
        data.observations.of_shape(calibration.target_shape),
        pixels=np.where(visible[..., None], np.asarray(data.pixels), 0.0),
        visible=visible & determined,
        base_from_tool=calibration.camera_from_world(data.command),
        joints=None,
        depths=None,
        hands=None,
    ).padded()
    predictions = _fitted_predictions(calibration.camera, observations, calibration.target_scale)
    return host_without_padding(predictions, *visible.shape)


class _Fit(NamedTuple):
    """The fits of all views between two steps.

    Attributes:
        poses: the best poses so far.
        trial: the poses to try next.
        matrix, gradient, cost: normal equations of each view's twist at the best poses.
        damping: factor of the matrix's diagonal, by view.
        steps: number of poses tried.
        finished: whether each view's next step brings nothing more.
    """

    poses: Float[Array, "views 4 4"]
    trial: Float[Array, "views 4 4"]
    matrix: Float[Array, "views 6 6"]
    gradient: Float[Array, "views 6"]
    cost: Float[Array, "views"]
    damping: Float[Array, "views"]
    steps: Array
    finished: Bool[Array, "views"]


@compiled
def _fitted_predictions(
    camera: Camera, observations: Observations, target_scale: Float[Array, ""]
) -> tuple[
    Float[Array, "views points 2"], Bool[Array, "views points"], Float[Array, "views points"]
]:
    """Return pixels, validity and depths of all points at the poses with the smallest errors."""
    start, views = pose_matrices(observations.base_from_tool), len(observations.visible)

    def unfinished(fit: _Fit) -> Bool[Array, ""]:
        return (fit.steps < MAX_STEPS) & ~fit.finished.all()

    def improved(fit: _Fit) -> _Fit:
        """Try one step of every view, keep what is better, and propose the next (Marquardt)."""
        told = linearise_views(
            camera, fit.trial, observations, target_scale, jnp.ones(()), loss=None
        )
        better = told.cost <= fit.cost

        def chosen(new: Array, old: Array) -> Array:
            return jnp.where(better.reshape(-1, *(1,) * (new.ndim - 1)), new, old)

        poses = chosen(fit.trial, fit.poses)
        matrix = chosen(told.matrix[:, -6:, -6:], fit.matrix)
        gradient = chosen(told.gradient[:, -6:], fit.gradient)
        cost = chosen(told.cost, fit.cost)
        damping = fit.damping * jnp.where(better, 0.1, 10.0)
        # A view without points has zeros, which 1 makes solvable.
        diagonal = jnp.diagonal(matrix, axis1=1, axis2=2)
        added = jnp.where(diagonal > 0.0, damping[:, None] * diagonal, 1.0)
        damped = matrix + added[:, :, None] * jnp.eye(6)[None]
        twist = -jnp.linalg.solve(damped, gradient[..., None])[..., 0]
        decrease = -0.5 * jnp.sum(gradient * twist, axis=1)
        finished = decrease <= TOLERANCE * cost
        trial = matrix_exponentials(twist) @ poses
        return _Fit(poses, trial, matrix, gradient, cost, damping, fit.steps + 1, finished)

    first = _Fit(
        start,
        start,
        jnp.zeros((views, 6, 6)),
        jnp.zeros((views, 6)),
        jnp.full(views, jnp.inf),
        jnp.full(views, 1e-3),
        jnp.array(0),
        jnp.zeros(views, dtype=bool),
    )
    poses = jax.lax.while_loop(unfinished, improved, first).poses
    in_camera = moved_points(poses, target_scale * observations.points)
    return *camera.project(in_camera), in_camera[..., 2]
