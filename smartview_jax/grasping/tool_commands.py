"""Compute the commands that bring the tool or the gripper to wanted poses (Eq. 20)."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration import Calibration
from ..evaluation import CalibrationEstimate
from ..geometry import host_matrices, host_transforms
from ..robots import Gripper, JointsLike, SerialArm
from ..runtime.padding import repeat_last
from ..viewpoints import ViewpointCommands, viewpoint_commands
from .scene import GraspScene
from .uncertainty import gripper_errors

if TYPE_CHECKING:
    from ..joint import RigEstimate, RigFit

TOOL_CHECKS = ("reach", "tool_distance", "tool_side")
"""The checks that a pose of the tool must pass to be commanded, unless a person overrides them.

The other checks concern the view of the camera.
"""

MOTION_CHECKS = ("reach", "tool_distance", "singular")
"""Checks of `viewpoint_commands` that a pose of the gripper has to pass.

The other checks concern the view of the camera. Where the robot error is extrapolated
(`known_region`), its covariance grows and lowers the probability of success.
"""

PADDED_POSES = 36
"""Numbers of poses are padded to a multiple of this one, so that one program serves them all.

It is the number of later phases of `GRASPS_AT_ONCE` grasps: compiling a second, smaller program
takes longer than computing some padded poses.
"""


class ToolCommands(NamedTuple):
    """The commands that bring the tool to wanted poses.

    Attributes:
        world_from_tool: the wanted poses.
        commands: the commands, with the robot's error compensated, and their checks.
        error_factor: derivatives of the tool's error by independent errors of one standard
            deviation each, m and rad: `exp(factor @ errors)` times the wanted tool_from_world is
            the actual one. The errors are common to all poses. None if the calibration was taken as
            exact.
        parameter_names: names of the calibration's uncertain parameters.
        parameter_factor: derivatives of these parameters' errors by the first of the same errors;
            the others do not concern the calibration.
    """

    world_from_tool: Float[np.ndarray, "n 4 4"]
    commands: ViewpointCommands
    error_factor: Float[np.ndarray, "n 6 errors"] | None = None
    parameter_names: tuple[str, ...] = ()
    parameter_factor: Float[np.ndarray, "parameters calibration_errors"] | None = None

    @property
    def covariance(self) -> Float[np.ndarray, "n 6 6"] | None:
        """The covariance of the tool's error at each pose, translation first, in the tool's axes.

        None if the calibration was taken as exact.
        """
        factor = self.error_factor
        # P = F F^T, since the errors are independent and have unit variance.
        return None if factor is None else factor @ factor.swapaxes(1, 2)

    def refusals(self) -> tuple[str, ...]:
        """Return the reason against commanding each pose, by the `TOOL_CHECKS`; empty if none."""
        return self.commands.checks.reasons(TOOL_CHECKS)


def tool_commands(
    calibration: Calibration,
    world_from_tool: Float[np.ndarray, "n 4 4"],
    *,
    estimate: "CalibrationEstimate | RigFit | RigEstimate | None" = None,
    arm: SerialArm | None = None,
    near: JointsLike | None = None,
) -> ToolCommands:
    """Return the robot's commands that bring the tool to poses in the world.

    For a grasp on an object the pose is `world_from_object @ object_from_tool`, so that the command
    is the paper's

        base_from_tool = base_from_world @ world_from_object @ object_from_tool        (Eq. 20)

    It is computed from the corresponding pose of the camera (Eq. 19), so that a fitted robot error
    is compensated in only one place. No pose is refused: one that fails a check has a command too,
    with the reason in its checks.

    Args:
        calibration: of a camera on the hand, whose world is fixed in the base's frame.
        world_from_tool: wanted poses, m.
        estimate: fit with the calibration's covariance, of a rig the fit of all cameras; None
            takes the calibration as exact.
        arm: the nominal arm, for joint readings.
        near: joint readings near which to solve, rad (m for a prismatic joint).

    Raises:
        ValueError: the camera is not on the hand, an arm without `near`, or an estimate that leaves
            something undetermined.

    For example:

        >>> world_from_tool = np.diag([1.0, -1.0, -1.0, 1.0])
        >>> world_from_tool[2, 3] = 0.11  # 110 mm above the world's origin, pointing down
        >>> tool = sv.tool_commands(truth, world_from_tool[None])
        >>> print(np.round(1e3 * tool.commands.xyzoat[0, :3]), tool.refusals())
        [ 448. -121.  160.] ('',)
    """
    # The scene rejects invalid input: an arm without a start, a camera that is not on the hand.
    scene = GraspScene(calibration, arm=arm, near=near, estimate=estimate)
    commands = _commands(calibration, world_from_tool, arm, near)
    if estimate is None:
        return ToolCommands(world_from_tool, commands)
    # The tool takes the place of the gripper, because the tool's errors are wanted.
    errors = gripper_errors(scene, Gripper(tool_from_gripper=np.eye(4)), commands.command)
    # One column for each direction of the calibration's own uncertainty.
    shared = np.stack([pose_errors.shared for pose_errors in errors])
    count, noises = len(errors), errors[0].by_noise.shape[1]
    # The robot's own noise is independent at every pose.
    noise_factor = np.zeros((count, 6, count * noises))
    for k, pose_errors in enumerate(errors):
        noise_factor[k, :, k * noises : (k + 1) * noises] = pose_errors.by_noise
    factor = np.concatenate([shared, noise_factor], axis=2)
    return ToolCommands(world_from_tool, commands, factor, errors[0].names, errors[0].root)


def gripper_commands(
    scene: GraspScene,
    gripper: Gripper,
    world_from_gripper: Float[np.ndarray, "n 4 4"],
    near: Float[np.ndarray, "n joints"] | None = None,
) -> ViewpointCommands:
    """Return the commands that bring the gripper to poses, padded to `PADDED_POSES`.

    In the paper's Eq. 20, world_from_object @ object_from_tool is here
    world_from_gripper @ gripper_from_tool; see `tool_commands`.

    Args:
        scene: with the calibration, and the arm if it is known.
        world_from_gripper: wanted poses, m.
        near: joint readings near which to solve; by default the scene's.
    """
    # The robot moves its tool, not the gripper's frame.
    world_from_tool = world_from_gripper @ np.linalg.inv(gripper.tool_from_gripper)
    if scene.arm is not None:
        near = np.asarray(scene.near) if near is None else near
        # Each pose is solved near its own joint readings.
        near = np.broadcast_to(near, (len(world_from_tool), near.shape[-1]))
    # -n mod k poses are missing to the next multiple of k.
    count = len(world_from_tool) + -len(world_from_tool) % PADDED_POSES
    world_from_tool, near = repeat_last((world_from_tool, near), count)
    return _commands(scene.calibration, world_from_tool, scene.arm, near)


def _commands(
    calibration: Calibration,
    world_from_tool: Float[np.ndarray, "n 4 4"],
    arm: SerialArm | None,
    near: JointsLike | None,
) -> ViewpointCommands:
    """Return the commands of the camera poses that correspond to poses of the tool."""
    camera_from_world = host_matrices(calibration.camera_from_tool) @ np.linalg.inv(world_from_tool)
    return viewpoint_commands(calibration, host_transforms(camera_from_world), arm=arm, near=near)
