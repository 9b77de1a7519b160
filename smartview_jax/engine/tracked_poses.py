"""Linearise the poses that a tracker measured, in the form of `view_normal_equations.py`."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..dataset import PoseObservations
from ..geometry import se3_left_jacobian, transforms_of
from .view_normal_equations import ViewNormalEquations


def linearise_tracked_poses(
    camera_from_world: Float[Array, "views 4 4"],
    observations: PoseObservations,
    target_scale: Float[Array, ""],
    sigma: Float[Array, ""],
    camera_parameters: int,
) -> ViewNormalEquations:
    """Compute the normal equations of every view from the measured pose of the target.

    Args:
        camera_from_world: predicted poses, as matrices.
        observations: measured poses.
        target_scale: ratio of the target's true size to the size that the tracker assumes.
        sigma: the tracker's noise in the observations' units.
        camera_parameters: number of the camera's parameters, which have no effect.
    """
    # Predicted are t / s and R. The twist (v, w) of the camera's pose changes them by
    # (v + w x t) / s and w. With r = log(R_measured R^T) the residual's change is -J_r(r)^-1 w,
    # where J_r(r) = J_l(-r).
    predicted = transforms_of(camera_from_world)
    residuals = observations.residuals(predicted, target_scale).reshape(-1, 6) / sigma
    seen = observations.visible[:, :1, None]
    whitening = jnp.where(seen, observations.whitening / sigma, 0.0)
    views = len(whitening)
    rotation = observations.differences(predicted, target_scale)[:, 3:]
    tangent = jnp.concatenate([jnp.zeros_like(rotation), -rotation], axis=1)
    by_turn = jnp.linalg.inv(se3_left_jacobian(tangent)[:, 3:, 3:])
    translation = camera_from_world[:, :3, 3] / target_scale
    axes = jnp.broadcast_to(jnp.eye(3)[None], (views, 3, 3))
    # Column k is e_k x t.
    levers = jnp.swapaxes(jnp.cross(axes, translation[:, None]), 1, 2)
    upper = jnp.concatenate([axes / target_scale, levers], axis=2)
    lower = jnp.concatenate([jnp.zeros_like(axes), by_turn], axis=2)
    columns = whitening @ jnp.concatenate([upper, lower], axis=1)
    columns = jnp.pad(columns, ((0, 0), (0, 0), (camera_parameters, 0)))
    transposed = jnp.swapaxes(columns, 1, 2)
    return ViewNormalEquations(
        transposed @ columns,
        -(transposed @ residuals[..., None])[..., 0],
        0.5 * jnp.sum(residuals**2, axis=1),
    )
