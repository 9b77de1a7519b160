"""Compute the chain of transforms from the target to the camera (Eq. 10), and name its frames.

The camera is on the hand, or on the base next to the arm; or on the hand of one arm while another
arm's hand carries the target.
"""

import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..argument_checks import require_one_of
from ..geometry import host_matrices, host_transforms, inverse_matrices, pose_matrices
from ..robot_errors import RobotError
from ..robots import Command
from ..runtime.compilation import compiled

_FRAMES: dict[str, tuple[str, str]] = {
    "eye_in_hand": ("tool", "base"),
    "eye_to_hand": ("base", "tool"),
    "hand_to_hand": ("tool", "other_tool"),
}
"""Frames of the camera's mount and of the target's holder, by mount."""

BASES = "base_from_other_base"
"""Name of the transform between the bases of two arms, of a camera on one hand and the target on
the other."""


ONE_ARM_MOUNTS = ("eye_in_hand", "eye_to_hand")
"""The mounts of a camera and a target that one arm moves against each other."""


def mount_frames(mount: str) -> tuple[str, str]:
    """Return the frame of the camera's mount and the frame of the target's holder.

    Raises:
        ValueError: `mount` is not `"eye_in_hand"`, `"eye_to_hand"` or `"hand_to_hand"`.
    """
    require_one_of("mount", mount, _FRAMES)
    return _FRAMES[mount]


def transform_names(mount: str) -> tuple[str, str]:
    """Return the names of `camera_from_mount` and `holder_from_world` for a mount.

    Raises:
        ValueError: `mount` is not `"eye_in_hand"`, `"eye_to_hand"` or `"hand_to_hand"`.
    """
    mount_frame, holder_frame = mount_frames(mount)
    return f"camera_from_{mount_frame}", f"{holder_frame}_from_world"


def chain_transform_names(mount: str) -> tuple[str, ...]:
    """Return the names of all transforms of a chain: of two arms, the one between the bases too.

    Raises:
        ValueError: an unknown mount.
    """
    return (*transform_names(mount), *(() if mount in ONE_ARM_MOUNTS else (BASES,)))


def mount_from_holder(mount: str, base_from_tool: SE3) -> SE3:
    """Return the robot's part of the chain, from the target's holder to the camera's mount.

    The function is its own inverse: applied to its result it returns `base_from_tool`.
    """
    # Eye-in-hand: tool_from_base, the inverse of the reported pose. Eye-to-hand: the camera is
    # on the base and the target on the tool, so the reported pose itself is the link between them.
    # Hand-to-hand: as eye-in-hand, with the other hand in the place of the base.
    return base_from_tool.inverse() if mount_frames(mount)[0] == "tool" else base_from_tool


def host_mount_from_holder(mount: str, base_from_tool: SE3) -> SE3:
    """Return what `mount_from_holder` returns, computed with NumPy."""
    if mount_frames(mount)[0] != "tool":
        return base_from_tool
    return host_transforms(mount_from_holder_matrices(mount, host_matrices(base_from_tool)))


def mount_from_holder_matrices(
    mount: str, base_from_tool: Float[np.ndarray, "*views 4 4"]
) -> Float[np.ndarray, "*views 4 4"]:
    """Return what `mount_from_holder` returns, of matrices."""
    return np.linalg.inv(base_from_tool) if mount_frames(mount)[0] == "tool" else base_from_tool


@compiled
def chain_of_transforms(
    camera_from_mount: SE3,
    holder_from_world: SE3,
    mount: str,
    error: RobotError | None,
    reported: Command,
) -> SE3:
    """Return the extrinsics at the given robot poses by the chain of Eq. 10."""
    # The command may carry joint angles, on which an arm's own errors depend; a pose alone does
    # not determine them.
    pose = reported.base_from_tool if error is None else error.actual_pose(reported)
    # Eq. 10: camera_from_world = camera_from_tool @ tool_from_base @ base_from_world.
    return camera_from_mount @ mount_from_holder(mount, pose) @ holder_from_world


@compiled
def chain_matrices(
    camera_from_mount: SE3,
    holder_from_world: SE3,
    mount: str,
    error: RobotError | None,
    reported: Command,
) -> Float[Array, "views 4 4"]:
    """Return the extrinsics as matrices; one program for all cameras."""
    pose = reported.base_from_tool if error is None else error.actual_pose(reported)
    return chain_of_matrices(camera_from_mount, holder_from_world, mount, pose_matrices(pose))


def chain_of_matrices(
    camera_from_mount: SE3,
    holder_from_world: SE3,
    mount: str,
    base_from_tool: Float[Array, "*views 4 4"],
) -> Float[Array, "*views 4 4"]:
    """Return the extrinsics at actual poses, which have the robot's error, as matrices."""
    tool_moves_camera = mount_frames(mount)[0] == "tool"
    mount_from_holder = inverse_matrices(base_from_tool) if tool_moves_camera else base_from_tool
    return pose_matrices(camera_from_mount) @ mount_from_holder @ pose_matrices(holder_from_world)
