"""From views to parameters: how far each number turns and shifts each view's camera.

Every parameter but the camera's acts on the pixels through `camera_from_world` of each view. Here
is the derivative of those poses by the transforms, the target's scale and the views' own
corrections, once for all estimators; `blocks.py` has what a twist of a view does to its pixels.
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
    """Poses of the camera in every view, and their derivatives as twists in the camera frame.

    Attributes:
        calibration: the step away from the start.
        camera_from_world: `(views)`.
        by_shared: by both transforms' translation and rotation step, the target's scale, and the
            coefficients of the robot's error.
        by_own: by each view's own correction; no views where there are none.
    """

    calibration: Calibration
    camera_from_world: SE3
    by_shared: Float[Array, "views 6 chained"]
    by_own: Float[Array, "corrected 6 6"]


def linearise_chain(parameters: Parameters, step: Step, reported: Command) -> Chain:
    """The chain a step away from the start; see `Chain`."""
    calibration, corrections = parameters.moved(step)
    n = parameters.camera_size
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
    # Pixels do not change where all distances from the camera do: a larger target seen from where
    # it is looks as the same target, nearer by the same factor.
    nearer = -camera_from_world.translation() / calibration.target_scale
    by_scale = jnp.concatenate([nearer, jnp.zeros((views, 3))], axis=1)[..., None]
    columns = [
        jnp.broadcast_to(by_mount[None], (views, 6, 6)),
        camera_from_holder.adjoint() @ by_holder[None],
        by_scale,
    ]
    if error is not None:
        # The pose and its twist at the tool stand left of the correction, or, inverted, right.
        camera_from_tool = camera_from_after if eye_in_hand else camera_from_before
        twist = error.by_coefficients(reported)
        columns.append(camera_from_tool.adjoint() @ (-twist if eye_in_hand else twist))
    by_own = jnp.zeros((0, 6, 6))
    if len(corrections):
        inner = jax.vmap(exp_jacobian)(signed)
        by_own = camera_from_before.adjoint() @ (inner if eye_in_hand else -inner)
    return Chain(calibration, camera_from_world, jnp.concatenate(columns, axis=2), by_own)


def _by_own_step(moved: SE3, step: Float[Array, "6"]) -> Float[Array, "6 6"]:
    """Left twist of a transform by the step that moved it (see `Parameters.moved`)."""
    turn = exp_jacobian(step.at[:3].set(0.0))[3:, 3:]
    shift = jnp.cross(moved.translation()[None], turn.T).T
    return jnp.block([[jnp.eye(3), shift], [jnp.zeros((3, 3)), turn]])
