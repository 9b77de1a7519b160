"""Compute the chain of transforms from the target to the camera (Eq. 10), compiled."""

from jaxlie import SE3
from jaxtyping import Array, Float

from ..robot_errors import RobotError
from ..robots import Command
from ..runtime.compilation import compiled
from .mount import mount_from_holder


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
    return chain_of_transforms(
        camera_from_mount, holder_from_world, mount, error, reported
    ).as_matrix()
