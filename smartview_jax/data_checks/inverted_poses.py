"""Say whether inverted poses would explain the pictures as well as the poses that were given.

Two screw motions have a common perpendicular, and half a turn about it takes each of them into its
inverse. The two motions between three views therefore belong to a camera on the hand and to one
next to the arm equally well, with mounts far from each other. So do the motions between any
number of views that share a perpendicular, as on a sphere about the target without a turn about the
line of sight.

If a tracker's poses are inverted as well as the robot's, no motion tells it: in the chain C = X H W
with the target's pose C, the mount X and the target's place W exchange their parts, because
C^-1 = W^-1 H^-1 X^-1. Only their distances tell it: what is on a hand is near the tool, compared
with the arm's reach, and what stands in the cell is mostly farther from the base. Some files of
samples have the robot's poses inverted for a camera next to the arm; read for the wrong mount, they
give the same motions, with base and tool exchanged.
"""

import numpy as np
from jaxtyping import Bool

from .closure import Poses, closure_error, relative_motions
from .transform_fit import Matrix, fit_transforms

MAX_HAND_SHARE = 0.5
"""Largest distance between the tool and a camera or target that it carries, relative to the reach.

The reach is the median distance of the tool from the base. An arm does not carry a thing half as
far from its flange as the arm itself reaches. A camera or a target close to the base alone says
nothing: many base frames are set at the table, even at the target.
"""

MAX_DISTANCE_RATIO = 2.0
"""Largest ratio of two distances, if the poses are not inverted.

They are between the tool and the camera or target that it carries, and between the base and the one
that stands in the cell. A target on a long tool may be as far from the tool as a camera that stands
close to the arm is from the base.
"""


def inverted_poses_doubt(
    robot: Poses,
    camera: Poses,
    used: Bool[np.ndarray, "views"],
    in_hand: bool,
    largest_score: float,
) -> str:
    """Return a sentence if the views cannot tell poses as given from inverted ones, else nothing.

    Args:
        robot: the robot's poses as given.
        camera: the camera's poses.
        used: mask of the views to use.
        in_hand: whether the camera is stated to be on the hand.
        largest_score: closure score up to which inverted poses explain the views as well.
    """
    inverted = np.linalg.inv(robot)
    stated, other = (inverted, robot) if in_hand else (robot, inverted)
    if closure_error(relative_motions(other[used], camera[used])).score > largest_score:
        return ""
    distances = [
        1e3 * float(np.linalg.norm(fit_transforms(poses, camera, used).camera_from_mount[:3, 3]))
        for poses in (stated, other)
    ]
    mount, place = ("tool", "next to the arm") if in_hand else ("base", "on the hand")
    return (
        "robot and camera move alike as given, and as well with every pose inverted "
        f"(tool_from_base for base_from_tool, or a camera {place}): as given the camera is "
        f"{distances[0]:.0f} mm from the {mount}, else {distances[1]:.0f} mm from tool or base. "
        "Check the mount and the direction of the poses, or add a view turned about another axis"
    )


def both_inverted_doubt(
    mount_from_camera: Matrix, holder_from_world: Matrix, tool_distance: float, in_hand: bool
) -> str:
    """Return a sentence if robot and tracked poses are likely both inverted, else nothing.

    Args:
        mount_from_camera: the camera's place on the tool; in the base if it is next to the arm.
        holder_from_world: the target's place in the base; on the tool if the camera is next to the
            arm.
        tool_distance: median distance of the tool from the base, m; inverted poses do not change
            it.
        in_hand: whether the camera is stated to be on the hand.
    """
    camera, target = (
        float(np.linalg.norm(pose[:3, 3])) for pose in (mount_from_camera, holder_from_world)
    )
    from_tool, from_base = (camera, target) if in_hand else (target, camera)
    if from_tool <= max(MAX_DISTANCE_RATIO * from_base, MAX_HAND_SHARE * tool_distance):
        return ""
    mount, holder, relation, other_mount = (
        ("tool", "base", "farther", "eye_to_hand")
        if in_hand
        else ("base", "tool", "nearer", "eye_in_hand")
    )
    return (
        f"the camera is {1e3 * camera:.0f} mm from the robot's {mount}, {relation} than the target "
        f"from its {holder} ({1e3 * target:.0f} mm): is the mount {other_mount}, or are both the "
        "robot's and the tracked poses inverted (tool_from_base and target_from_camera)? No motion "
        "tells it, only these distances: check them"
    )
