"""What to tell the robot so that the camera sees what is wanted (Eq. 19), and what it will see."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..calibration import Calibration
from ..cameras import Camera
from ..geometry import PoseLike, as_se3, xyzoat
from ..robots import Command, CommandLike, JointsLike, JointSolution, SerialArm, as_command
from .checks import Checks, Limits, check_views
from .reach import reach

TOGETHER = 500
"""Views predicted at once: what they need in between then stays in the processor's cache."""


class ViewCalibration(eqx.Module):
    """The calibration of viewpoints: what a program needs that uses the pictures alone.

    Attributes:
        camera: intrinsics and lens, the same for all.
        camera_from_world: extrinsics, `(*views)`.
    """

    camera: Camera
    camera_from_world: SE3


@eqx.filter_jit
def predict(calibration: Calibration, command: CommandLike) -> ViewCalibration:
    """The calibration of any viewpoints, from what the robot is told or reports, `(*views)`.

    No picture is needed: the paper's reason for calibrating the chain and not each viewpoint.
    """
    reported = as_command(command)
    views = reported.base_from_tool.get_batch_axes()

    def view(one: Command) -> Float[Array, "7"]:
        return calibration.camera_from_world(one).wxyz_xyz

    flat = jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), reported)
    poses = jax.lax.map(view, flat, batch_size=TOGETHER)
    return ViewCalibration(calibration.camera, SE3(poses.reshape(*views, 7)))


class ViewpointCommands(eqx.Module):
    """Commands for wanted viewpoints.

    Attributes:
        base_from_tool: what to tell the robot, its own error compensated, `(*views)`.
        xyzoat: the same as VAL has it, m and rad.
        joints: the same as joint readings, rad (m where a joint slides); None without an arm.
        predicted: the calibration that is to be expected there.
        checks: what is wrong with each.
    """

    base_from_tool: SE3
    xyzoat: Float[Array, "*views 6"]
    joints: Float[Array, "*views joints"] | None
    predicted: ViewCalibration
    checks: Checks

    @property
    def command(self) -> Command:
        """The commands, as `Calibration` takes them."""
        return Command(self.base_from_tool, self.joints)


def viewpoint_commands(
    calibration: Calibration,
    camera_from_world: PoseLike,
    points: Float[Array, "points 3"] | np.ndarray | None = None,
    arm: SerialArm | None = None,
    near: JointsLike | None = None,
    limits: Limits | None = None,
) -> ViewpointCommands:
    """Commands that put the camera where it is wanted, and what is wrong with them (Eq. 19).

    Nothing is refused here: a view that fails a check has its commands too, and says why.

    Args:
        calibration: with the robot's error, where one was fitted; it is compensated.
        camera_from_world: wanted, `(*views)`; `look_at` and `five_viewpoints` make such.
        points: of the target, m; they are to be in the picture and in focus.
        arm: as its controller believes it to be; with `near`, joint readings are found too.
        near: readings in whose neighbourhood to look, `(joints)` or `(*views, joints)`.
        limits: what the viewpoints have to keep; by default the picture's border alone.

    Raises:
        ValueError: an arm without `near`, or an arm's own errors were fitted and `near` is missing.
    """
    if arm is not None and near is None:
        raise ValueError("an arm reaches a pose in several ways: give near=joints to begin from")
    wanted = as_se3(camera_from_world)
    if near is not None:
        near = jnp.asarray(near, dtype=float)
        near = jnp.broadcast_to(near, (*wanted.get_batch_axes(), near.shape[-1]))
    command = _reported(calibration, wanted, near)
    solution = None
    if arm is not None and near is not None:
        # Outside jit, where an arm's numbers say whether it is solved in closed form.
        solution = reach(arm, command, near)
        command = Command(command.base_from_tool, solution.joints)
    target = None if points is None else jnp.asarray(points, dtype=float)
    return _predicted(calibration, command, target, solution, limits or Limits())


@eqx.filter_jit
def _reported(calibration: Calibration, wanted: SE3, near: Array | None) -> Command:
    return calibration.reported_for(wanted, near=near)


@eqx.filter_jit
def _predicted(
    calibration: Calibration,
    command: Command,
    points: Float[Array, "points 3"] | None,
    solution: JointSolution | None,
    limits: Limits,
) -> ViewpointCommands:
    predicted = predict(calibration, command)
    checks = check_views(
        calibration, command, predicted.camera_from_world, points, solution, limits
    )
    pose = command.base_from_tool
    return ViewpointCommands(pose, xyzoat(pose), command.joints, predicted, checks)
