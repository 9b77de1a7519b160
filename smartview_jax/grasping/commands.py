"""Compute the robot's commands for wanted poses of the gripper (Eq. 20)."""

import numpy as np
from jaxtyping import Float

from ..geometry import host_matrices, host_transforms
from ..robots import Gripper
from ..viewpoints import ViewpointCommands, viewpoint_commands
from .scene import GraspScene

MOTION_CHECKS = ("reach", "tool_distance", "singular")
"""Checks of `viewpoint_commands` that a pose of the gripper has to pass.

The others are about what the camera sees. That a robot error is not known so far out
(`known_region`) shows in the probability of success, whose covariance grows there.
"""

PADDED_POSES = 36
"""Numbers of poses are padded to a multiple of this one, so that one program serves them all.

It is that of the later phases of `GRASPS_AT_ONCE` grasps: compiling for a second, smaller number
takes longer than computing some poses in vain.
"""


def gripper_commands(
    scene: GraspScene,
    gripper: Gripper,
    world_from_gripper: Float[np.ndarray, "n 4 4"],
    near: Float[np.ndarray, "n joints"] | None = None,
) -> ViewpointCommands:
    """Return the commands that bring the gripper to poses, padded to `PADDED_POSES`.

    The pose of the tool is that of the paper's

        base_from_tool = base_from_world @ world_from_object @ object_from_tool        (Eq. 20)

    with world_from_object @ object_from_tool = world_from_gripper @ gripper_from_tool. It is
    commanded as the pose of the camera that goes with it (Eq. 19), so that a fitted robot error is
    compensated in the one place that does so.

    Args:
        scene: with the calibration, and the arm if it is known.
        gripper: whose frame is to be at the poses.
        world_from_gripper: wanted poses, m.
        near: joint readings near which to solve; by default those of the scene.
    """
    # The robot moves its tool, not the gripper's frame.
    world_from_tool = world_from_gripper @ np.linalg.inv(gripper.tool_from_gripper)
    camera_from_world = host_matrices(scene.calibration.camera_from_tool) @ np.linalg.inv(
        world_from_tool
    )
    # The last pose is repeated: every program can compute with it.
    extra = -len(camera_from_world) % PADDED_POSES
    wanted = np.concatenate([camera_from_world, np.repeat(camera_from_world[-1:], extra, axis=0)])
    if scene.arm is not None:
        near = np.asarray(scene.near) if near is None else near
        # Every pose has joints of its own to be solved near.
        near = np.broadcast_to(near, (len(camera_from_world), near.shape[-1]))
        near = np.concatenate([near, np.repeat(near[-1:], extra, axis=0)])
    return viewpoint_commands(scene.calibration, host_transforms(wanted), arm=scene.arm, near=near)
