"""Read the robot's reported pose, joint readings, or both, for every view of a data-set folder."""

from collections.abc import Sequence
from pathlib import Path

from .folder_description import DescribedFolder
from .joints import read_joints
from .pose_log import read_pose_log
from .poses import RobotReadings, read_poses


def read_robot_readings(described: DescribedFolder, bad_views: str) -> RobotReadings:
    """Read the tables that the entries `poses` and `joints` of a description name."""
    readings = _read_tables(described, bad_views)
    suffix = suffix_in_names(described, readings.view_ids)
    if not suffix:
        return readings
    note = f"{described.view_table.name}: the views' names end in {suffix}, which is ignored"
    masked = readings.masked_views.items()
    return readings._replace(
        view_ids=[view.removesuffix(suffix) for view in readings.view_ids],
        masked_views={view.removesuffix(suffix): reason for view, reason in masked},
        notes=(*readings.notes, note),
        name_suffix=suffix,
    )


def read_sound_readings(described: DescribedFolder) -> RobotReadings:
    """Read the tables of a description, all of whose views must have a valid pose."""
    readings = read_robot_readings(described, "raise")
    for view, reason in readings.masked_views.items():
        raise ValueError(f"{described.view_table}: view {view}: {reason}: remove this view")
    return readings


def suffix_in_names(described: DescribedFolder, view_ids: Sequence[str]) -> str:
    """Return the picture suffix that all view names end in although the pattern adds it too.

    It is empty if the names do not have it, or if pictures of the full names exist.
    """
    pattern = (described.content.get("pictures") or {}).get("pattern", "")
    suffix = Path(pattern).suffix
    if not suffix or not view_ids or not all(view.endswith(suffix) for view in view_ids):
        return ""
    try:
        as_named = [described.folder / pattern.format(view=view, height=0) for view in view_ids]
    except (KeyError, IndexError, ValueError):
        return ""
    stripped = {view.removesuffix(suffix) for view in view_ids}
    unambiguous = len(stripped) == len(view_ids) and "" not in stripped
    return suffix if unambiguous and not any(path.exists() for path in as_named) else ""


def _read_tables(described: DescribedFolder, bad_views: str) -> RobotReadings:
    """Read the tables with the view names as written."""
    folder, content = described.folder, described.content
    poses: RobotReadings | None = None
    if "poses" in content:
        is_log = content["poses"].get("picture_times") is not None
        poses = (
            read_pose_log(folder, content["poses"]).read_poses()
            if is_log
            else read_poses(folder, content["poses"], bad_views)
        )
        if "joints" not in content:
            return poses
    joints = read_joints(described, None if poses is None else poses.view_ids)
    if poses is None:
        # The arm's forward kinematics gives the poses.
        computed = joints.arm.base_from_tool(joints.readings)
        poses = RobotReadings(list(joints.view_ids), computed, {}, joints.table)
    notes = (*poses.notes, *joints.notes)
    return poses._replace(notes=notes, joints=joints.readings, arm=joints.arm)
