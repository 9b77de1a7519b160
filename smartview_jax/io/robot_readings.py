"""Read the robot's reported pose, joint readings, or both, for every view of a data-set folder."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..array_namespace import to_device
from ..dataset import Dataset
from ..robots import Command, SerialArm
from .joints import read_joints
from .poses import read_poses


class RobotReadings(NamedTuple):
    """The robot's reported poses by view, with the joint readings where the folder has them.

    Attributes:
        view_ids: view ids.
        poses: reported `base_from_tool`, `(views)`.
        masked_views: reason by view id, for the views whose row is not a valid pose.
        joints: joint readings, rad (m for a prismatic joint); None where the folder has none.
        arm: the arm that the readings belong to; None where there are no readings.
    """

    view_ids: Sequence[str]
    poses: SE3
    masked_views: dict[str, str]
    joints: Float[np.ndarray, "views joints"] | None = None
    arm: SerialArm | None = None

    @property
    def command(self) -> Command:
        """The reported poses with the joint readings, where they are known."""
        return Command(self.poses, None if self.joints is None else to_device(self.joints))

    def without_suffix(self, suffix: str) -> "RobotReadings":
        """Return the readings with names of views that do not end in a suffix."""
        return self._replace(
            view_ids=[view.removesuffix(suffix) for view in self.view_ids],
            masked_views={
                view.removesuffix(suffix): reason for view, reason in self.masked_views.items()
            },
        )

    def with_joints(self, data: Dataset) -> Dataset:
        """Return the data set with the joint readings added, if there are any."""
        return data if self.arm is None else data.with_joints(self.joints, self.arm)


def table_of_views(folder: Path, content: dict[str, Any]) -> Path:
    """Return the table of a description that has a row for each view: poses, joints or times."""
    if "poses" not in content:
        return folder / content["joints"]["file"]
    poses = content["poses"]
    return folder / (poses.get("picture_times") or poses["file"])


def read_robot_readings(
    folder: Path, content: dict[str, Any], description_path: Path, bad_views: str
) -> RobotReadings:
    """Read the tables that the entries `poses` and `joints` of a description name.

    Raises:
        ValueError: naming the file and the entry or view that is wrong.
        FileNotFoundError: a table is missing.
    """
    view_ids = poses = None
    masked_views: dict[str, str] = {}
    if "poses" in content:
        view_ids, poses, masked_views = read_poses(folder, content["poses"], bad_views)
        if "joints" not in content:
            return RobotReadings(view_ids, poses, masked_views)
    # Reported poses have precedence; without them the arm's forward kinematics gives them.
    view_ids, joints, arm = read_joints(folder, content["joints"], description_path, view_ids)
    return RobotReadings(
        view_ids, arm.base_from_tool(joints) if poses is None else poses, masked_views, joints, arm
    )
