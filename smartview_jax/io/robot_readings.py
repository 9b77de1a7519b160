"""Read the robot's reported pose, joint readings, or both, for every view of a data-set folder."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..dataset import Dataset
from ..geometry import host_matrices, host_transforms
from ..robots import Command, SerialArm
from ..runtime.array_namespace import to_device
from .csv_tables import Table
from .joints import read_joints
from .pose_log import read_pose_log
from .poses import ReadPoses, read_poses


class RobotReadings(NamedTuple):
    """The robot's reported poses by view, with joint readings if the folder has them.

    Attributes:
        view_ids: view ids.
        poses: reported `base_from_tool`, `(views)`.
        masked_views: reason by view id, for the views whose row is not a valid pose.
        joints: joint readings, rad (m for a prismatic joint); None where the folder has none.
        arm: the arm that the readings belong to; None where there are no readings.
        notes: sentences on what was recognised or repaired in the tables.
        name_suffix: suffix of the view names in the tables that `view_ids` do not have.
        table: the table that has a row for each view; None if the poses are in a file in JSON.
        pose_format: name of the format of the reported poses; None if it is not known.
    """

    view_ids: Sequence[str]
    poses: SE3
    masked_views: dict[str, str]
    joints: Float[np.ndarray, "views joints"] | None = None
    arm: SerialArm | None = None
    notes: tuple[str, ...] = ()
    name_suffix: str = ""
    table: Table | None = None
    pose_format: str | None = None

    @property
    def command(self) -> Command:
        """The reported poses, with joint readings if they are known."""
        return Command(self.poses, None if self.joints is None else to_device(self.joints))

    def refuse_masked(self, path: Path) -> None:
        """Raise a ValueError that names the first view without a valid pose, if there is any."""
        for view, reason in self.masked_views.items():
            raise ValueError(f"{path}: view {view}: {reason}: remove this view")

    def of_views(self, views: Sequence[str]) -> "RobotReadings":
        """Return the readings of some of the views, by id."""
        place = {view: k for k, view in enumerate(self.view_ids)}
        index = np.array([place[view] for view in views], dtype=int)
        return self._replace(
            view_ids=list(views),
            poses=host_transforms(host_matrices(self.poses)[index]),
            masked_views={v: text for v, text in self.masked_views.items() if v in set(views)},
            joints=None if self.joints is None else np.asarray(self.joints)[index],
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
        ValueError: a wrong entry or view; the message names it and the file.
        FileNotFoundError: a table is missing.
    """
    readings = _read_tables(folder, content, description_path, bad_views)
    suffix = suffix_in_names(folder, content, readings.view_ids)
    notes = list(readings.notes)
    if suffix:
        table = table_of_views(folder, content).name
        notes.append(f"{table}: the views' names end in {suffix}, which is ignored")
    masked_views = {
        view.removesuffix(suffix): reason for view, reason in readings.masked_views.items()
    }
    return readings._replace(
        view_ids=[view.removesuffix(suffix) for view in readings.view_ids],
        masked_views=masked_views,
        notes=tuple(notes),
        name_suffix=suffix,
    )


def suffix_in_names(folder: Path, content: Mapping[str, Any], view_ids: Sequence[str]) -> str:
    """Return the picture suffix that all view names end in although the pattern adds it too.

    Args:
        folder: of the data set.
        content: content of its description.
        view_ids: names of the views as the table has them.

    Returns:
        A suffix such as `".png"`; empty if the names do not have it, or if the pattern with the
        full names gives existing pictures.
    """
    pattern = (content.get("pictures") or {}).get("pattern", "")
    suffix = Path(pattern).suffix
    if not suffix or not view_ids or not all(view.endswith(suffix) for view in view_ids):
        return ""
    try:
        as_named = [folder / pattern.format(view=view, height=0) for view in view_ids]
    except (KeyError, IndexError, ValueError):
        return ""
    stripped = {view.removesuffix(suffix) for view in view_ids}
    unambiguous = len(stripped) == len(view_ids) and "" not in stripped
    return suffix if unambiguous and not any(path.exists() for path in as_named) else ""


def _read_tables(
    folder: Path, content: dict[str, Any], description_path: Path, bad_views: str
) -> RobotReadings:
    """Read the tables with the view names as written."""
    poses: ReadPoses | None = None
    notes: tuple[str, ...] = ()
    if "poses" in content:
        if content["poses"].get("picture_times") is not None:
            log = read_pose_log(folder, content["poses"])
            poses = ReadPoses(
                list(log.view_ids),
                log.poses(),
                log.views_in_gaps(),
                log.table,
                content["poses"].get("codec"),
            )
            notes = log.notes
        else:
            poses = read_poses(folder, content["poses"], bad_views)
            notes = () if poses.table is None else poses.table.notes
        if "joints" not in content:
            return RobotReadings(
                poses.view_ids,
                poses.poses,
                poses.masked_views,
                notes=notes,
                table=poses.table,
                pose_format=poses.pose_format,
            )
    # Without reported poses the arm's forward kinematics gives them.
    joints = read_joints(
        folder, content["joints"], description_path, None if poses is None else poses.view_ids
    )
    return RobotReadings(
        joints.view_ids,
        joints.arm.base_from_tool(joints.readings) if poses is None else poses.poses,
        {} if poses is None else poses.masked_views,
        joints.readings,
        joints.arm,
        (*notes, *joints.notes),
        table=joints.table if poses is None else poses.table,
        pose_format=None if poses is None else poses.pose_format,
    )
