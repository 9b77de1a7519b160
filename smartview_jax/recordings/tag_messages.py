"""Read the pose of a tag from the messages of tag detectors.

Detectors state poses in several ways: one pose (`geometry_msgs/PoseStamped`), a list of detections
with an id each (apriltag_ros, aruco_msgs, fiducials), or two lists (ros2_aruco).
"""

from collections.abc import Iterator
from typing import Any

from .transform_tree import pose_numbers, transform_numbers

POSE_KINDS = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
"""Types of messages with one pose and a header."""

_LISTS = {"detections": "id", "markers": "id", "transforms": "fiducial_id"}
"""Name of the id in the entries of a list, by the list's name."""


def tag_poses(message: Any) -> Iterator[tuple[int | None, tuple[float, ...]]]:
    """Yield the id (None without one) and the pose (seven numbers) of every tag in a message."""
    if hasattr(message, "marker_ids") and hasattr(message, "poses"):
        for number, pose in zip(message.marker_ids, message.poses, strict=True):
            yield int(number), pose_numbers(pose)
        return
    for name, identity in _LISTS.items():
        if hasattr(message, name):
            for entry in getattr(message, name):
                yield _single_id(getattr(entry, identity, None)), pose_of(entry)
            return
    yield None, pose_of(message)


def pose_of(message: Any) -> tuple[float, ...]:
    """Return the pose in a message, or in an entry of a list, as seven numbers."""
    if hasattr(message, "transform"):
        return transform_numbers(message.transform)
    # A pose with a covariance, with a header, or with both is one or two levels further in.
    pose = message
    while hasattr(pose, "pose"):
        pose = pose.pose
    if not hasattr(pose, "position"):
        raise ValueError(
            "its messages have no poses; if the detector publishes the tag's pose in tf, name the "
            "tag's frame instead"
        )
    return pose_numbers(pose)


def _single_id(identity: Any) -> int | None:
    """Return an id that is a number, or the first of a list as in apriltag_ros; None without."""
    if identity is None:
        return None
    return int(identity if not hasattr(identity, "__len__") else identity[0])
