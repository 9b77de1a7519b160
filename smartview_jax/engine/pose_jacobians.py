"""Differentiate the camera pose of every view by the parameters of the calibration.

Every parameter except the camera's acts on the pixels through `camera_from_world` of each view.
This file computes the derivatives of these poses by the hand-eye and target transforms, the
target's scale, the robot error field and the views' own corrections, once for all estimators;
`view_normal_equations.py` computes the effect of a twist of a view on its pixels.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

from ..calibration import Calibration, mount_frames
from ..geometry import se3_left_jacobian
from ..robots import Command
from .parameters import DEPTH_BIAS_NAMES, Parameters, Step
from .prepared_poses import PreparedPoses


class PoseJacobians(eqx.Module):
    """The pose of the camera in every view, and its derivatives as twists in the camera frame.

    Attributes:
        calibration: the calibration after the step.
        camera_from_world: pose of the world in each view's camera, batch shape `(views)`.
        shared_jacobian: derivatives by the translation and rotation step of both transforms, by the
            logarithm of the target's scale, by the coefficients of the robot error field, zeros by
            the bias of depths, and by the step of the transform between the bases of two arms.
        per_view_jacobian: derivatives by each view's own correction; empty without corrections.
    """

    calibration: Calibration
    camera_from_world: SE3
    shared_jacobian: Float[Array, "views 6 chained"]
    per_view_jacobian: Float[Array, "corrected 6 6"]


def linearise_poses(
    parameters: Parameters, step: Step, command: Command, prepared_poses: PreparedPoses | None
) -> PoseJacobians:
    """Compute all camera poses and their derivatives at a step from the start.

    Args:
        parameters: the start and the layout of its parameters.
        step: step from the start.
        command: what the robot reported, batch shape `(views)`.
        prepared_poses: precomputed quantities of the robot error field; None without a field.
    """
    calibration, corrections = parameters.retract(step)
    layout = parameters.layout
    reported = calibration.with_bases(command).base_from_tool
    # A @ exp(d) @ B = exp(Ad_A d) @ A @ B: every derivative below is a twist at the transform that
    # the parameter changes, mapped to the camera frame by the adjoint of the transforms left of it.
    mount_jacobian = _step_jacobian(calibration.camera_from_mount, step.shared[layout.mount])
    holder_jacobian = _step_jacobian(calibration.holder_from_world, step.shared[layout.holder])
    eye_in_hand = mount_frames(calibration.mount)[0] == "tool"

    error = calibration.robot_error
    tool_error = SE3(jnp.broadcast_to(SE3.identity().wxyz_xyz, reported.wxyz_xyz.shape))
    if error is not None and prepared_poses is not None:
        tool_error = prepared_poses.error(error.field, error.coefficients)
    # actual pose = reported @ exp(-correction) @ tool_error
    # camera_from_world = camera_from_mount @ before @ correction @ after @ holder_from_world
    before, after = (
        (tool_error.inverse(), reported.inverse()) if eye_in_hand else (reported, tool_error)
    )
    signed_corrections = corrections if eye_in_hand else -corrections
    camera_from_mount = SE3(calibration.camera_from_mount.wxyz_xyz[None])
    holder_from_world = SE3(calibration.holder_from_world.wxyz_xyz[None])
    camera_from_before = camera_from_mount @ before
    camera_from_after = camera_from_before
    if len(corrections):
        at_tool = corrections_at_tool(command, signed_corrections)
        camera_from_after = camera_from_before @ at_tool
    camera_from_holder = camera_from_after @ after
    camera_from_world = camera_from_holder @ holder_from_world

    views = len(reported.wxyz_xyz)
    # p = scale R X + t, so dp/dlog(scale) = scale R X = p - t. The part p lies along the ray and
    # does not change the pixel; what remains is the translation -t.
    translation_by_scale = -camera_from_world.translation()
    scale_twist = jnp.concatenate([translation_by_scale, jnp.zeros((views, 3))], axis=1)
    scale_jacobian = scale_twist[..., None]
    columns = [
        jnp.broadcast_to(mount_jacobian[None], (views, 6, 6)),
        camera_from_holder.adjoint() @ holder_jacobian[None],
        scale_jacobian,
    ]
    if error is not None and prepared_poses is not None:
        # actual_pose(coefficients + d) = actual_pose(coefficients) @ exp(F d), F = field_jacobian.
        # With the camera on the hand the chain has the inverse, exp(-F d) @ actual_pose^-1; with a
        # fixed camera it has actual_pose @ exp(F d).
        camera_from_tool = camera_from_mount if eye_in_hand else camera_from_holder
        field_jacobian = prepared_poses.jacobian(error.field, error.coefficients)
        columns.append(
            camera_from_tool.adjoint() @ (-field_jacobian if eye_in_hand else field_jacobian)
        )
    if calibration.depth_bias is not None:
        columns.append(jnp.zeros((views, 6, len(DEPTH_BIAS_NAMES))))
    bases, hands = calibration.base_from_other_base, command.hands
    if bases is not None:
        # after = tool_from_base @ base_from_other_base @ other_base_from_other_tool
        by_bases = jnp.zeros((views, 6, 6))
        if hands is not None:
            camera_from_base = camera_from_after @ hands.base_from_tool.inverse()
            step_jacobian = _step_jacobian(bases, step.shared[layout.bases])
            by_bases = camera_from_base.adjoint() @ step_jacobian[None]
        columns.append(by_bases)
    per_view_jacobian = jnp.zeros((0, 6, 6))
    if len(corrections):
        # exp(c + dc) = exp(J_l(c) dc) @ exp(c); the sign is as for the correction in the chain.
        left_jacobian = se3_left_jacobian(signed_corrections)
        if command.hands is not None:
            camera_from_before = camera_from_before @ _shifts(between_hands(command))
        per_view_jacobian = camera_from_before.adjoint() @ (
            left_jacobian if eye_in_hand else -left_jacobian
        )
    return PoseJacobians(
        calibration, camera_from_world, jnp.concatenate(columns, axis=2), per_view_jacobian
    )


def corrections_at_tool(command: Command, corrections: Float[Array, "views 6"]) -> SE3:
    """Return the motion of the tool by each view's correction.

    The correction of one arm is a motion of its tool. The correction of two arms, which is of one
    hand relative to the other, is a motion about the point midway between the hands: if both arms
    err alike and independently, rotation and translation there are independent as well.
    """
    if command.hands is None:
        return SE3.exp(corrections)
    middle = between_hands(command)
    return _shifts(middle) @ SE3.exp(corrections) @ _shifts(-middle)


def between_hands(command: Command) -> Float[Array, "views 3"]:
    """Return the point midway between both hands of each view, in the frame of the camera's hand.

    It is taken where the bases were when the data set was made, and does not move in a fit.
    """
    return 0.5 * command.base_from_tool.inverse().translation()


def _shifts(points: Float[Array, "views 3"]) -> SE3:
    """Return the translations to some points."""
    return SE3.from_rotation_and_translation(SO3.identity(points.shape[:-1]), points)


def _step_jacobian(transform: SE3, step: Float[Array, "6"]) -> Float[Array, "6 6"]:
    """Compute the left twist of a transform per unit of its own step (see `Parameters.retract`).

    The upper three rows are the translation, the lower three the rotation.
    """
    # T = (exp(r) R0, t0 + d). A left twist (v, w) changes its translation by v + w x t, hence
    # w = J_l(r) dr and v = dd - w x t = dd + t x (J_l(r) dr).
    rotation_jacobian = se3_left_jacobian(step.at[:3].set(0.0))[3:, 3:]
    translation_coupling = jnp.cross(transform.translation()[None], rotation_jacobian.T).T
    return jnp.block([[jnp.eye(3), translation_coupling], [jnp.zeros((3, 3)), rotation_jacobian]])
