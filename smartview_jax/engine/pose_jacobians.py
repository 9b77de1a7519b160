"""Differentiate the camera pose of every view by the parameters of the calibration.

Every parameter except the camera's acts on the pixels through `camera_from_world` of each view.
This file computes the derivatives of these poses by the hand-eye and target transforms, the
target's scale, the robot error field and the views' own corrections, once for all estimators;
`view_normal_equations.py` computes the effect of a twist of a view on its pixels.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..calibration import Calibration, mount_frames
from ..geometry import (
    adjoint_matrices,
    inverse_matrices,
    matrix_exponentials,
    pose_matrices,
    se3_left_jacobian,
    shift_matrices,
)
from ..robots import Command
from .parameters import DEPTH_BIAS_NAMES, ParameterLayout, Parameters, Step
from .prepared_poses import PreparedPoses


class PoseJacobians(eqx.Module):
    """The pose of the camera in every view, and its derivatives as twists in the camera frame.

    Attributes:
        calibration: the calibration after the step.
        camera_from_world: pose of the world in each view's camera, as a matrix.
        shared_jacobian: derivatives by the translation and rotation step of both transforms, by the
            logarithm of the target's scale, by the coefficients of the robot error field, zeros by
            the bias of depths, and by the step of the transform between the bases of two arms.
        per_view_jacobian: derivatives by each view's own correction; empty without corrections.
    """

    calibration: Calibration
    camera_from_world: Float[Array, "views 4 4"]
    shared_jacobian: Float[Array, "views 6 chained"]
    per_view_jacobian: Float[Array, "corrected 6 6"]


def linearise_poses(
    parameters: Parameters,
    step: Step,
    command: Command,
    prepared_poses: PreparedPoses | None,
    on_devices: bool = False,
) -> PoseJacobians:
    """Compute all camera poses and their derivatives at a step from the start.

    Args:
        parameters: the start and the layout of its parameters.
        step: step from the start.
        command: what the robot reported, batch shape `(views)`.
        prepared_poses: precomputed quantities of the robot error field; None without a field.
        on_devices: whether the views are distributed over several devices.
    """
    calibration, corrections = parameters.retract(step)
    hands, bases = command.hands, calibration.base_from_other_base
    eye_in_hand = mount_frames(calibration.mount)[0] == "tool"
    signed_corrections = corrections if eye_in_hand else -corrections
    chain = _camera_chain(calibration, command, signed_corrections, prepared_poses)
    by_turns, left_jacobian = _left_jacobians(
        parameters.layout, step, signed_corrections, bases is not None, on_devices
    )
    # A @ exp(d) @ B = exp(Ad_A d) @ A @ B: every derivative below is a twist at the transform that
    # the parameter changes, mapped to the camera frame by the adjoint of the transforms left of it.
    views = len(chain.camera_from_world)
    by_mount = _step_jacobian(chain.camera_from_mount, by_turns[0])
    by_holder = adjoint_matrices(chain.camera_from_holder)
    # p = scale R X + t, so dp/dlog(scale) = scale R X = p - t. The part p lies along the ray and
    # does not change the pixel; what remains is the translation -t.
    by_scale = jnp.pad(-chain.camera_from_world[:, :3, 3:], ((0, 0), (0, 3), (0, 0)))
    columns = [
        jnp.broadcast_to(by_mount, (views, 6, 6)),
        by_holder @ _step_jacobian(chain.holder_from_world, by_turns[1]),
        by_scale,
    ]
    error = calibration.robot_error
    if error is not None and prepared_poses is not None:
        # actual_pose(coefficients + d) = actual_pose(coefficients) @ exp(F d), F = field_jacobian.
        # With the camera on the hand the chain has the inverse, exp(-F d) @ actual_pose^-1; with a
        # fixed camera it has actual_pose @ exp(F d).
        field_jacobian = prepared_poses.jacobian(error.field, error.coefficients)
        columns.append(
            -adjoint_matrices(chain.camera_from_mount) @ field_jacobian
            if eye_in_hand
            else by_holder @ field_jacobian
        )
    if calibration.depth_bias is not None:
        columns.append(jnp.zeros((views, 6, len(DEPTH_BIAS_NAMES))))
    if bases is not None:
        # after = tool_from_base @ base_from_other_base @ other_base_from_other_tool
        by_bases = jnp.zeros((views, 6, 6))
        if hands is not None:
            tool_from_base = inverse_matrices(pose_matrices(hands.base_from_tool))
            camera_from_base = chain.camera_from_after @ tool_from_base
            by_bases = adjoint_matrices(camera_from_base) @ _step_jacobian(
                pose_matrices(bases), by_turns[2]
            )
        columns.append(by_bases)
    per_view_jacobian = jnp.zeros((0, 6, 6))
    if len(corrections):
        camera_from_before = chain.camera_from_before
        # The sign is as for the correction in the chain.
        if hands is not None:
            camera_from_before = camera_from_before @ shift_matrices(between_hands(command))
        per_view_jacobian = adjoint_matrices(camera_from_before) @ (
            left_jacobian if eye_in_hand else -left_jacobian
        )
    return PoseJacobians(
        calibration, chain.camera_from_world, jnp.concatenate(columns, axis=2), per_view_jacobian
    )


class _CameraChain(NamedTuple):
    """The transforms between camera and target in every view.

    `camera_from_world` is `camera_from_mount @ before @ correction @ after @ holder_from_world`.
    The product up to `before` is `camera_from_before`, with the correction `camera_from_after`, and
    with `after` `camera_from_holder`.
    """

    camera_from_mount: Float[Array, "4 4"]
    camera_from_before: Float[Array, "views 4 4"]
    camera_from_after: Float[Array, "views 4 4"]
    camera_from_holder: Float[Array, "views 4 4"]
    holder_from_world: Float[Array, "4 4"]
    camera_from_world: Float[Array, "views 4 4"]


def _camera_chain(
    calibration: Calibration,
    command: Command,
    signed_corrections: Float[Array, "corrected 6"],
    prepared_poses: PreparedPoses | None,
) -> _CameraChain:
    """Return the camera poses of all views with the transforms in between.

    Args:
        calibration: after the step.
        command: what the robot reported.
        signed_corrections: of the views, negative for a fixed camera.
        prepared_poses: of the robot error field, if there is one.
    """
    reported = pose_matrices(calibration.with_bases(command).base_from_tool)
    camera_from_mount = pose_matrices(calibration.camera_from_mount)
    holder_from_world = pose_matrices(calibration.holder_from_world)
    # actual pose = reported @ exp(-correction) @ tool_error
    error = calibration.robot_error
    tool_error = jnp.broadcast_to(jnp.asarray(np.eye(4)), reported.shape)
    if error is not None and prepared_poses is not None:
        tool_error = prepared_poses.error(error.field, error.coefficients)
    before, after = (
        (inverse_matrices(tool_error), inverse_matrices(reported))
        if mount_frames(calibration.mount)[0] == "tool"
        else (reported, tool_error)
    )
    camera_from_before = camera_from_mount @ before
    camera_from_after = camera_from_before
    if len(signed_corrections):
        camera_from_after = camera_from_before @ corrections_at_tool(command, signed_corrections)
    camera_from_holder = camera_from_after @ after
    return _CameraChain(
        camera_from_mount,
        camera_from_before,
        camera_from_after,
        camera_from_holder,
        holder_from_world,
        camera_from_holder @ holder_from_world,
    )


def _left_jacobians(
    layout: ParameterLayout,
    step: Step,
    signed_corrections: Float[Array, "corrected 6"],
    two_arms: bool,
    on_devices: bool,
) -> tuple[Float[Array, "transforms 3 3"], Float[Array, "corrected 6 6"]]:
    """Return left Jacobians of the transforms' rotation steps and of the views' corrections.

    exp(c + dc) = exp(J_l(c) dc) @ exp(c)
    """
    # One call for all of them makes a smaller program than two, but it would exchange the views'
    # corrections between devices.
    places = (layout.mount, layout.holder, *((layout.bases,) if two_arms else ()))
    turns = jnp.pad(jnp.stack([step.shared[place][3:] for place in places]), ((0, 0), (3, 0)))
    if on_devices:
        by_turns, left_jacobian = map(se3_left_jacobian, (turns, signed_corrections))
    else:
        of_all = se3_left_jacobian(jnp.concatenate([turns, signed_corrections]))
        by_turns, left_jacobian = of_all[: len(places)], of_all[len(places) :]
    return by_turns[:, 3:, 3:], left_jacobian


def corrections_at_tool(
    command: Command, corrections: Float[Array, "views 6"]
) -> Float[Array, "views 4 4"]:
    """Return the motion of the tool by each view's correction.

    The correction of one arm is a motion of its tool. The correction of two arms, which is of one
    hand relative to the other, is a motion about the point midway between the hands: if both arms
    err alike and independently, rotation and translation there are independent as well.
    """
    motions = matrix_exponentials(corrections)
    if command.hands is None:
        return motions
    middle = between_hands(command)
    return shift_matrices(middle) @ motions @ shift_matrices(-middle)


def between_hands(command: Command) -> Float[Array, "views 3"]:
    """Return the point midway between both hands of each view, in the frame of the camera's hand.

    It is taken where the bases were when the data set was made, and does not move in a fit.
    """
    return 0.5 * inverse_matrices(pose_matrices(command.base_from_tool))[:, :3, 3]


def _step_jacobian(
    transform: Float[Array, "4 4"], rotation_jacobian: Float[Array, "3 3"]
) -> Float[Array, "1 6 6"]:
    """Compute the left twist of a transform per unit of its own step (see `Parameters.retract`).

    The upper three rows are the translation, the lower three the rotation.

    Args:
        transform: the transform after the step.
        rotation_jacobian: left Jacobian of the rotation's step.
    """
    # T = (exp(r) R0, t0 + d). A left twist (v, w) changes its translation by v + w x t, hence
    # w = J_l(r) dr and v = dd - w x t = dd + t x (J_l(r) dr).
    coupling = jnp.cross(transform[:3, 3:], rotation_jacobian, axis=0)
    right = jnp.concatenate([coupling, rotation_jacobian])
    return jnp.concatenate([jnp.asarray(np.eye(6, 3)), right], axis=1)[None]
