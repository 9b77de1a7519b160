"""Compute robot commands for wanted camera poses (Eq. 19), and predict the view that results."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..calibration import Calibration
from ..cameras import Camera
from ..geometry import PoseLike, as_se3, xyzoat
from ..robots import (
    LIMIT_TOLERANCE,
    Command,
    CommandLike,
    JointsLike,
    JointSolution,
    SerialArm,
    SolutionStatus,
    as_command,
    joints_for_pose,
)
from ..runtime.array_namespace import as_float_array
from ..runtime.compilation import compiled, is_traced
from ..runtime.padding import padded_counts, repeat_last, without_padding
from .checks import Checks, Limits, check_views

PREDICTION_BATCH_SIZE = 500
"""Number of views predicted at once, so that intermediate results stay in the processor's cache."""


class ViewCalibration(eqx.Module):
    """The calibration of viewpoints, reduced to what a program needs that only uses pictures.

    Attributes:
        camera: intrinsics and lens, common to all views.
        camera_from_world: extrinsics, `(*views)`.
    """

    camera: Camera
    camera_from_world: SE3


@compiled
def predict(calibration: Calibration, command: CommandLike) -> ViewCalibration:
    """Return the calibration of any viewpoints, from robot commands or reports, `(*views)`.

    It needs no picture: this is the paper's reason for calibrating the chain of transforms instead
    of each viewpoint.
    """
    reported = as_command(command)
    views = reported.base_from_tool.get_batch_axes()

    def camera_pose(view_command: Command) -> Float[Array, "7"]:
        return calibration.camera_from_world(view_command).wxyz_xyz

    # In batches, because the arrays of all views at once would not fit the cache.
    flat = jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), reported)
    poses = jax.lax.map(camera_pose, flat, batch_size=PREDICTION_BATCH_SIZE)
    return ViewCalibration(calibration.camera, SE3(poses.reshape(*views, 7)))


class ViewpointCommands(eqx.Module):
    """The robot commands for wanted viewpoints, with the expected view and the checks.

    Attributes:
        base_from_tool: poses to command, with the robot error compensated, `(*views)`.
        xyzoat: the same in VAL's form, m and rad.
        joints: the same as joint readings, rad (m for a prismatic joint); None without an arm.
        predicted_views: expected calibration of the viewpoints.
        checks: results of the checks.
    """

    base_from_tool: SE3
    xyzoat: Float[Array, "*views 6"]
    joints: Float[Array, "*views joints"] | None
    predicted_views: ViewCalibration
    checks: Checks

    @property
    def command(self) -> Command:
        """The commands, in the form that `Calibration` takes."""
        return Command(self.base_from_tool, self.joints)

    def with_arrays(
        self, function: Callable[..., Any], *others: "ViewpointCommands"
    ) -> "ViewpointCommands":
        """Return commands whose arrays are computed from the arrays of these and other commands.

        Args:
            function: takes a pytree for each of the commands, with all their arrays whose first
                axes are the views, and returns such a pytree. The camera stays.
            others: the other commands.
        """
        trees = [
            (c.base_from_tool, c.xyzoat, c.joints, c.predicted_views.camera_from_world, c.checks)
            for c in (self, *others)
        ]
        pose, numbers, joints, poses, checks = function(*trees)
        views = ViewCalibration(self.predicted_views.camera, poses)
        return ViewpointCommands(pose, numbers, joints, views, checks)


def viewpoint_commands(
    calibration: Calibration,
    camera_from_world: PoseLike,
    points: Float[Array, "points 3"] | np.ndarray | None = None,
    arm: SerialArm | None = None,
    near: JointsLike | None = None,
    limits: Limits | None = None,
) -> ViewpointCommands:
    """Return robot commands that put the camera at wanted poses, and their checks (Eq. 19).

    No view is refused: a view that fails a check has a command too, with the reason in its checks.

    Args:
        calibration: calibration, whose fitted robot error is compensated.
        camera_from_world: wanted poses, `(*views)`, as from `look_at` and `five_viewpoints`.
        points: target points, m, which have to be in the picture and in focus.
        arm: the nominal arm; with `near`, joint readings are computed too.
        near: joint readings near which to solve, `(joints)` or `(*views, joints)`.
        limits: limits of the viewpoints; by default the picture's border only.

    Raises:
        ValueError: an arm without `near`, or arm errors were fitted and `near` is missing.

    For example:

        >>> wanted = sv.five_viewpoints(points.mean(axis=0), distance=0.2)
        >>> commands = sv.viewpoint_commands(fit.calibration, wanted, points)
        >>> print(np.round(1e3 * commands.xyzoat[0, :3]), commands.checks.passed["in_picture"])
        [ 451. -175.  340.] [ True  True  True  True  True]
    """
    if arm is not None and near is None:
        raise ValueError("an arm reaches a pose in several ways: give near=joints to begin from")
    target_poses, limits = as_se3(camera_from_world), limits or Limits()
    views = target_poses.wxyz_xyz.shape[:-1]
    if near is not None:
        shape = (*views, np.shape(near)[-1])
        near = (
            jnp.broadcast_to(jnp.asarray(near, dtype=float), shape)
            if is_traced(near)
            else as_float_array(np.broadcast_to(near, shape))
        )
    # Another number of views then needs no other programs.
    is_padded = len(views) == 1 and not is_traced(calibration, target_poses, points, near, limits)
    if is_padded:
        target_poses, near = repeat_last((target_poses, near), padded_counts(views[0])[0])
    if calibration.robot_error is None:
        command = calibration.robot_command_for(target_poses)
        expected_pose = command.base_from_tool
    else:
        # Where the robot's error is unknown, half a correction is better than a wrong one.
        actual_pose = calibration.command_for(target_poses, corrected=False)
        command, expected_pose = calibration.robot_error.expected_command(actual_pose, near)
    solution = None
    if arm is not None and near is not None:
        # Outside jit, where the arm's parameters can be inspected for a closed form.
        solution = solve_joints(arm, command, near)
        command = Command(command.base_from_tool, solution.joints)
    points = None if points is None else as_float_array(points)
    commands = _commands_with_checks(calibration, command, expected_pose, points, solution, limits)
    if not is_padded:
        return commands
    return commands.with_arrays(lambda by_view: without_padding(by_view, views[0]))


@compiled
def _commands_with_checks(
    calibration: Calibration,
    command: Command,
    expected_pose: SE3,
    points: Float[Array, "points 3"] | None,
    solution: JointSolution | None,
    limits: Limits,
) -> ViewpointCommands:
    """Return commands with the predicted views and checks."""
    # Far from its data the correction fades, in the prediction as in the command.
    predicted_views = predict(calibration.uncorrected, Command(expected_pose))
    checks = check_views(
        calibration, command, predicted_views.camera_from_world, points, solution, limits
    )
    pose = command.base_from_tool
    return ViewpointCommands(pose, xyzoat(pose), command.joints, predicted_views, checks)


def solve_joints(arm: SerialArm, command: Command, near: JointsLike) -> JointSolution:
    """Return joint readings of the nominal arm for commands, near given ones, with their status.

    Readings in the command are kept, NaN where there are none.
    """
    joints = command.joints
    if joints is None:
        return joints_for_pose(arm, command.base_from_tool, near)
    # The command has joints already, for example because arm errors were compensated. They are only
    # checked, since another solution would undo the compensation.
    out_of_limits = arm.violated_limits(joints, LIMIT_TOLERANCE)
    has_joints = jnp.all(jnp.isfinite(joints), axis=-1)
    status = jnp.where(has_joints, 0, int(SolutionStatus.OUT_OF_REACH))
    status = status | jnp.where(out_of_limits.any(axis=-1), int(SolutionStatus.OUT_OF_LIMITS), 0)
    return JointSolution(joints, status, out_of_limits)
