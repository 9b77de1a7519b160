"""Compute the robot's commands for wanted poses of the gripper (Eq. 20)."""

import numpy as np
from jaxtyping import Float

from ..robots import Gripper
from ..viewpoints import ViewpointCommands
from .scene import GraspScene
from .tool_commands import padded_tool_commands

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


def gripper_commands(
    scene: GraspScene,
    gripper: Gripper,
    world_from_gripper: Float[np.ndarray, "n 4 4"],
    near: Float[np.ndarray, "n joints"] | None = None,
) -> ViewpointCommands:
    """Return the commands that bring the gripper to poses, padded to `PADDED_POSES`.

    The pose of the tool follows the paper's

        base_from_tool = base_from_world @ world_from_object @ object_from_tool        (Eq. 20)

    with world_from_object @ object_from_tool = world_from_gripper @ gripper_from_tool; see
    `tool_commands`.

    Args:
        scene: with the calibration, and the arm if it is known.
        gripper: the gripper whose frame is brought to the poses.
        world_from_gripper: wanted poses, m.
        near: joint readings near which to solve; by default the scene's.
    """
    # The robot moves its tool, not the gripper's frame.
    world_from_tool = world_from_gripper @ np.linalg.inv(gripper.tool_from_gripper)
    if scene.arm is not None:
        near = np.asarray(scene.near) if near is None else near
        # Each pose is solved near its own joint readings.
        near = np.broadcast_to(near, (len(world_from_tool), near.shape[-1]))
    return padded_tool_commands(scene.calibration, world_from_tool, scene.arm, near, PADDED_POSES)
