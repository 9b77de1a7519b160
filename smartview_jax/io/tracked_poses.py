"""Read a data-set folder whose tracker measured the target's poses: pairs of poses, no pictures.

    smartview_dataset: 1
    mount: eye_in_hand
    poses: {file: poses.csv, codec: quaternion_xyzw, length_unit: m, angle_unit: rad,
            direction: base_from_tool}
    tracked_poses: {file: tracker.csv, codec: quaternion_xyzw, length_unit: m, angle_unit: rad,
                    direction: camera_from_world}

Both tables have a column `view`, by whose names they are matched; a view that the tracker's table
does not have was not seen. The world is the target's frame. The robot's poses may be joint readings
or the log of a moving robot, as in `dataset_folder`.

The entry may also name the covariances of the poses, and the depth sensor that measured them:

    tracked_poses:
      file: tracker.csv
      ...
      covariances: {file: tracker_covariances.csv, rows: 15}
      depth_sensor: {scale: 1.02, offset: 0.001, scale_std: 0.0003, ...}
      camera: {image_size: [640, 480], alpha_u: 600.0, ...}

The table has a column `view` and 21 columns "cov_x_x", "cov_x_y", ..., "cov_rz_rz": the upper half
of each pose's covariance, of its translation x, y, z (m) and its rotation vector rx, ry, rz (rad)
in the camera's axes, always of `camera_from_world`. If a depth sensor measured the poses, the next
columns are the change of each pose by the sensor's scale and offset ("by_scale_x", ...,
"by_offset_rz") and the RMS distance of its points from the target (`point_rms`, m).
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..argument_checks import errors_at, shortened_repr
from ..cameras import camera_from_dict, camera_to_dict
from ..dataset import DepthSensor, PoseDataset
from ..geometry import as_se3, host_matrices
from ..runtime.array_namespace import to_device
from .csv_tables import parse_numbers, read_table, refuse_truncated, write_view_table
from .folder_description import DescribedFolder
from .poses import poses_entry, read_poses, write_poses
from .robot_readings import read_robot_readings

TRACKED_POSES_FILE = "tracker.csv"
"""The name of the file that `write_tracked_poses` writes."""

_DIRECTIONS = {"camera_from_world": "base_from_tool", "world_from_camera": "tool_from_base"}
"""Directions of the tracker's table by the direction that the robot's table would have."""

COVARIANCES_FILE = "tracker_covariances.csv"
"""The name of the file with the covariances of the poses."""

_AXES = ("x", "y", "z", "rx", "ry", "rz")
_UPPER = np.triu_indices(len(_AXES))
_COVARIANCE_COLUMNS = tuple(f"cov_{_AXES[i]}_{_AXES[j]}" for i, j in zip(*_UPPER, strict=True))
_SENSOR_COLUMNS = (
    *(f"by_{cause}_{axis}" for axis in _AXES for cause in ("scale", "offset")),
    "point_rms",
)


def read_tracked_folder(described: DescribedFolder, bad_views: str) -> PoseDataset:
    """Read the pairs of poses of a folder with an entry `tracked_poses`."""
    folder, content = described.folder, described.content
    readings, entry = read_robot_readings(described, bad_views), content["tracked_poses"]
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
    with errors_at(described.path):
        data = PoseDataset.from_poses(
            readings.poses,
            np.stack(measured),
            content.get("mount", "eye_in_hand"),
            view_ids=readings.view_ids,
            masked_views=list(reasons.items()),
            joints=readings.joints,
            arm=readings.arm,
        )
    data = _with_read_covariances(data, folder, entry)
    notes = (*readings.notes, *tracked.notes)
    return dataclasses.replace(data, notes=notes, pose_format=readings.pose_format)


def write_tracked_poses(data: PoseDataset, folder: Path, pose_format: str) -> dict[str, Any]:
    """Write the table of a tracker, and return the entry that describes it."""
    seen = np.flatnonzero(data.seen)
    seen_ids = [data.view_ids[view] for view in seen]
    tracked = as_se3(data.tracked_matrices[seen])
    write_poses(folder, seen_ids, tracked, pose_format, TRACKED_POSES_FILE)
    return {
        **poses_entry(len(seen), pose_format),
        "file": TRACKED_POSES_FILE,
        "direction": "camera_from_world",
        **_write_covariances(data, folder),
    }


def _write_covariances(data: PoseDataset, folder: Path) -> dict[str, Any]:
    """Write the covariances of a data set, if it has any, and return the entries that tell of them.

    Covariances that the data set does not state are of no interest: a fit estimates them.
    """
    entries: dict[str, Any] = {}
    if data.camera is not None:
        entries["camera"] = camera_to_dict(data.camera)
    if not data.states_covariance:
        return entries
    seen = np.flatnonzero(data.seen)
    columns = [np.asarray(data.covariance)[seen][:, _UPPER[0], _UPPER[1]]]
    names = _COVARIANCE_COLUMNS
    if data.sensor is not None:
        changes = np.asarray(data.sensor_changes)[seen].reshape(len(seen), -1)
        columns += [changes, np.asarray(data.point_rms)[seen, None]]
        names = (*names, *_SENSOR_COLUMNS)
        entries["depth_sensor"] = dataclasses.asdict(data.sensor)
    rows = np.concatenate(columns, axis=1)
    ids = [data.view_ids[view] for view in seen]
    write_view_table(folder / COVARIANCES_FILE, ids, names, rows)
    entries["covariances"] = {"file": COVARIANCES_FILE, "rows": len(ids)}
    return entries


def _with_read_covariances(
    data: PoseDataset, folder: Path, entry: Mapping[str, Any]
) -> PoseDataset:
    """Return a data set with the covariances that its folder states, if it states any."""
    if "camera" in entry:
        data = dataclasses.replace(data, camera=camera_from_dict(entry["camera"], None))
    if "covariances" not in entry:
        return data
    path, sensor = folder / entry["covariances"]["file"], entry.get("depth_sensor")
    names = (*_COVARIANCE_COLUMNS, *(() if sensor is None else _SENSOR_COLUMNS))
    table = read_table(path, ("view", *names), ())
    refuse_truncated(path, table.rows, entry["covariances"].get("rows"))
    index = {view: k for k, view in enumerate(data.view_ids)}
    numbers = np.full((data.view_count, len(names)), np.nan)
    for row in table.rows:
        if (view := row["view"]) not in index:
            raise ValueError(f"{path}: view {shortened_repr(view)} has no pose")
        if np.isfinite(numbers[index[view]]).all():
            raise ValueError(f"{path}: view {view} has more than one row")
        numbers[index[view]] = parse_numbers(path, row, names, view)
    missing = data.seen & ~np.isfinite(numbers).all(axis=1)
    if missing.any():
        view = data.view_ids[int(np.argmax(missing))]
        raise ValueError(f"{path}: view {view} has no covariance")
    upper = len(_COVARIANCE_COLUMNS)
    covariance = np.empty((data.view_count, len(_AXES), len(_AXES)))
    covariance[:, _UPPER[0], _UPPER[1]] = covariance[:, _UPPER[1], _UPPER[0]] = numbers[:, :upper]
    with errors_at(path):
        data = data.with_covariance(covariance)
    if sensor is None:
        return data
    changes = np.where(data.seen[:, None], numbers[:, upper:-1], 0.0)
    return dataclasses.replace(
        data,
        sensor=DepthSensor(**sensor),
        sensor_changes=to_device(changes.reshape(data.view_count, len(_AXES), 2)),
        point_rms=to_device(numbers[:, -1]),
    )
