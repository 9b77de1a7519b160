"""Differentiate the camera pose of every view by the parameters of the calibration.

Every parameter except the camera's acts on the pixels through `camera_from_world` of each view.
This file computes the derivatives of these poses by the hand-eye and target transforms, the
target's scale, the robot error field and the views' own corrections, once for all estimators;
`blocks.py` computes the effect of a twist of a view on its pixels.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float

from ..calibration import Calibration
from ..geometry import exp_jacobian
from ..robots import Command
from .parameters import Parameters, Step


class Chain(eqx.Module):
    """The pose of the camera in every view, and its derivatives as twists in the camera frame.

    Attributes:
        calibration: the calibration after the step.
        camera_from_world: pose of the world in each view's camera, batch shape `(views)`.
        by_shared: derivatives by the translation and rotation step of both transforms, by the
            target's scale, and by the coefficients of the robot error field.
        by_own: derivatives by each view's own correction; no views where there are no corrections.
    """

    calibration: Calibration
    camera_from_world: SE3
    by_shared: Float[Array, "views 6 chained"]
    by_own: Float[Array, "corrected 6 6"]


def linearise_chain(parameters: Parameters, step: Step, reported: Command) -> Chain:
    """Compute all camera poses and their derivatives at a step from the start; see `Chain`.

    Args:
        parameters: the start and the layout of its parameters.
        step: step from the start.
        reported: commands or poses that the robot reported, batch shape `(views)`.
    """
    calibration, corrections = parameters.moved(step)
    n = parameters.camera_size
    # A @ exp(d) @ B = exp(Ad_A d) @ A @ B: every derivative below is a twist at the transform that
    # the parameter changes, mapped to the camera frame by the adjoint of the transforms left of it.
    by_mount = _by_own_step(calibration.camera_from_mount, step.shared[n : n + 6])
    by_holder = _by_own_step(calibration.holder_from_world, step.shared[n + 6 : n + 12])
    eye_in_hand = calibration.mount == "eye_in_hand"

    error = calibration.robot_error
    pose = reported.base_from_tool if error is None else error.true_pose(reported)
    # camera_from_world = camera_from_mount @ before @ correction @ after @ holder_from_world
    identity = SE3(jnp.broadcast_to(SE3.identity().wxyz_xyz, pose.wxyz_xyz.shape))
    before, after = (identity, pose.inverse()) if eye_in_hand else (pose, identity)
    signed = corrections if eye_in_hand else -corrections
    camera_from_mount = SE3(calibration.camera_from_mount.wxyz_xyz[None])
    holder_from_world = SE3(calibration.holder_from_world.wxyz_xyz[None])
    camera_from_before = camera_from_mount @ before
    camera_from_after = camera_from_before
    if len(corrections):
        camera_from_after = camera_from_before @ SE3.exp(signed)
    camera_from_holder = camera_from_after @ after
    camera_from_world = camera_from_holder @ holder_from_world

    views = len(pose.wxyz_xyz)
    # p = scale R X + t, so dp/dscale = R X = (p - t) / scale. The part p / scale lies along the ray
    # and does not change the pixel; what remains is the translation -t / scale.
    nearer = -camera_from_world.translation() / calibration.target_scale
    by_scale = jnp.concatenate([nearer, jnp.zeros((views, 3))], axis=1)[..., None]
    columns = [
        jnp.broadcast_to(by_mount[None], (views, 6, 6)),
        camera_from_holder.adjoint() @ by_holder[None],
        by_scale,
    ]
    if error is not None:
        # true_pose(coefficients + d) = true_pose(coefficients) @ exp(twist @ d). On the hand the
        # chain has the inverse, exp(-twist d) @ pose^-1, with the correction to its left; for a
        # camera beside the arm the chain has pose @ exp(twist d), with the correction to its right.
        camera_from_tool = camera_from_after if eye_in_hand else camera_from_before
        twist = error.by_coefficients(reported)
        columns.append(camera_from_tool.adjoint() @ (-twist if eye_in_hand else twist))
    by_own = jnp.zeros((0, 6, 6))
    if len(corrections):
        # exp(c + dc) = exp(J_l(c) dc) @ exp(c); the sign is that of the correction in the chain.
        inner = jax.vmap(exp_jacobian)(signed)
        by_own = camera_from_before.adjoint() @ (inner if eye_in_hand else -inner)
    return Chain(calibration, camera_from_world, jnp.concatenate(columns, axis=2), by_own)


def _by_own_step(moved: SE3, step: Float[Array, "6"]) -> Float[Array, "6 6"]:
    """Compute the left twist of a transform per unit of its own step (see `Parameters.moved`).

    The upper three rows are the translation, the lower three the rotation.
    """
    # T = (exp(r) R0, t0 + d). A left twist (v, w) changes its translation by v + w x t, hence
    # w = J_l(r) dr and v = dd - w x t = dd + t x (J_l(r) dr).
    turn = exp_jacobian(step.at[:3].set(0.0))[3:, 3:]
    shift = jnp.cross(moved.translation()[None], turn.T).T
    return jnp.block([[jnp.eye(3), shift], [jnp.zeros((3, 3)), turn]])
