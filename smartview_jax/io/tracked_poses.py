"""Read a data-set folder whose tracker measured the target's poses: pairs of poses, no pictures.

    smartview_dataset: 1
    mount: eye_in_hand
    poses: {file: poses.csv, codec: quaternion_xyzw, length_unit: m, angle_unit: rad,
            direction: base_from_tool}
    tracked_poses: {file: tracker.csv, codec: quaternion_xyzw, length_unit: m, angle_unit: rad,
                    direction: camera_from_world}

Both tables have a column `view`, by whose names they are matched; a view that the tracker's table
does not have was not seen. Covariances of the poses are described in `tracked_covariances.py`. The
world is the target's frame. The robot's poses may be joint readings
or the log of a moving robot, as in `dataset_folder`.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from ..argument_checks import errors_at
from ..dataset import PoseDataset
from ..geometry import as_se3, host_matrices
from .poses import poses_entry, read_poses, write_poses
from .robot_readings import read_robot_readings
from .tracked_covariances import with_read_covariances, write_covariances

TRACKED_POSES_FILE = "tracker.csv"
"""The name of the file that `write_tracked_poses` writes."""

_DIRECTIONS = {"camera_from_world": "base_from_tool", "world_from_camera": "tool_from_base"}
"""Directions of the tracker's table by the direction that the robot's table would have."""


def read_tracked_folder(
    folder: Path, content: dict[str, Any], description_path: Path, bad_views: str
) -> PoseDataset:
    """Read the pairs of poses of a folder.

    Args:
        folder: of the data set.
        content: content of its description, with an entry `tracked_poses`.
        description_path: path of the description, for error messages.
        bad_views: `"raise"` an error for a pose that is not rigid, or `"mask"` its view.

    Raises:
        ValueError: a wrong entry or view; the message names it and the file.
        FileNotFoundError: a table is missing.
    """
    readings = read_robot_readings(folder, content, description_path, bad_views)
    entry = content["tracked_poses"]
    stated = {**entry, "direction": _DIRECTIONS[entry["direction"]]}
    tracked = read_poses(folder, stated, bad_views, "tracked_poses")
    table = folder / entry["file"]
    unknown = [view for view in tracked.view_ids if view not in readings.view_ids]
    if unknown:
        raise ValueError(f"{table}: view {unknown[0]}: the robot's table has no such view")
    reasons = {**tracked.masked_views, **readings.masked_views}
    by_view = dict(zip(tracked.view_ids, host_matrices(tracked.poses), strict=True))
    unseen = np.full((4, 4), np.nan)
    measured = [
        unseen if view in reasons else by_view.get(view, unseen) for view in readings.view_ids
    ]
    with errors_at(description_path):
        data = PoseDataset.from_poses(
            readings.poses,
            np.stack(measured),
            content.get("mount", "eye_in_hand"),
            view_ids=readings.view_ids,
            masked_views=list(reasons.items()),
            joints=readings.joints,
            arm=readings.arm,
        )
    data = with_read_covariances(data, folder, entry)
    notes = () if tracked.table is None else tracked.table.notes
    return dataclasses.replace(
        data, notes=(*readings.notes, *notes), pose_format=readings.pose_format
    )


def write_tracked_poses(data: PoseDataset, folder: Path, pose_format: str) -> dict[str, Any]:
    """Write the table of a tracker, and return the entry that describes it.

    Raises:
        ValueError: an unknown pose format, or a name or position with which the table could not be
            read back; nothing is written.
    """
    seen = np.flatnonzero(data.seen)
    seen_ids = [data.view_ids[view] for view in seen]
    tracked = as_se3(data.tracked_matrices[seen])
    write_poses(folder, seen_ids, tracked, pose_format, TRACKED_POSES_FILE)
    return {
        **poses_entry(len(seen), pose_format),
        "file": TRACKED_POSES_FILE,
        "direction": "camera_from_world",
        **write_covariances(data, folder),
    }
