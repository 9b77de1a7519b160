"""Read and write a data-set folder: `dataset.yaml`, `poses.csv`, `images/`, `detections.csv`.

    smartview_dataset: 1
    camera: {image_size: [640, 480]}
    target: {kind: circle_grid, rows: 10, columns: 10, spacing: 0.0254}
    mount: eye_in_hand
    poses: {file: poses.csv, codec: quaternion_xyzw, length_unit: m, angle_unit: rad,
            direction: base_from_tool}
    pictures: {pattern: "images/{view}.png"}

`poses.csv` has a column `view` and the codec's columns; a file of viewpoints, which states its
format and units itself, is named without them: `poses: {file: views.csv}`. In the pattern, `{view}`
is the view's name and `{height}` the index of the height, for a board at several heights; if every
picture has its own pose, the table states the height (see `read_board_heights`).
Instead of poses, or in addition to them, the folder may have joint readings (see `joints.py`).
Pictures, poses and joint readings are matched by the view's name, never by their order; a name has
up to 200 printable characters, does not begin with # and leads to no other folder. If the target's
pattern looks the same when rotated, `base_from_world` (`tool_from_world` for a fixed camera) gives
the target's approximate pose (see `folder_description.py`). The schema of the file is in
`schemas.dataset`; an unknown key is an error. A board printed by Kalibr can refer to Kalibr's file:
`target: {kind: aprilgrid, file: target.yaml}`. A folder of tracked poses instead of pictures is
described in `tracked_poses.py`, one of a depth sensor in `depth_folder.py`, and depths at the
points of pictures, from a camera whose lens is to be found, in `point_depths.py`.

For a camera on the hand of one arm and the target on the hand of another, `mount` is
`hand_to_hand`, `poses` has what the camera's arm reported and `other_poses` what the other one did,
by view, each in its own base:

    mount: hand_to_hand
    poses: {file: poses.csv, codec: ur, length_unit: m, angle_unit: rad, direction: base_from_tool}
    other_poses: {file: other_poses.csv, codec: kuka_abc, length_unit: mm, angle_unit: deg,
                  direction: base_from_tool}

A truncated file may still be valid YAML or CSV. Therefore `save_dataset` writes the number of
`rows` of every table, and `end_mark: true`, which requires the last line `end: smartview_dataset`.
A file written by hand needs neither.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxlie import SE3

from .. import schemas
from ..argument_checks import errors_at
from ..dataset import Dataset, PoseDataset, Rig
from ..detection import checked_pixels
from ..files import file_transaction
from ..geometry import PoseLike, as_se3
from ..targets import AbstractTarget, ListedPoints, target_to_dict
from .depth_folder import read_depth_pictures, read_points_folder
from .detections import DETECTIONS_FILE, read_detections, write_detections
from .folder_description import (
    DESCRIPTION_FILE,
    DescribedFolder,
    FolderDescription,
    described_camera,
    marked_entries,
)
from .folder_pictures import LoadOptions, picture_files, read_board_heights
from .joints import joints_entry, write_joints
from .picture_detections import ShownTarget
from .pictures import dataset_from_pictures
from .point_depths import DEPTHS_FILE, with_folder_depths, write_depths
from .poses import OTHER_POSES_FILE, POSES_FILE, RobotReadings, poses_entry, read_poses, write_poses
from .robot_readings import read_robot_readings
from .tracked_poses import read_tracked_folder, write_tracked_poses
from .two_hands_folder import require_one_numbering, with_other_hand


def load_dataset_folder(
    folder: Path, options: LoadOptions, holder_from_world: PoseLike | None = None
) -> Dataset:
    """Read a data set from a folder with a `dataset.yaml`; see `load_dataset`."""
    described = DescribedFolder.of(folder)
    if described.is_rig:
        raise ValueError(
            f"{described.path}: cameras: a folder with several cameras is read by load_rig; of "
            "the commands only smartview check, calibrate, compare, evaluate and plan do"
        )
    described, description = described.validated(schemas.DATASET_SCHEMA)
    if description.tracked_poses is not None:
        return read_tracked_folder(described, options.bad_views)
    if description.measured_points is not None:
        return read_points_folder(described, options)
    camera = described_camera(described, description)
    if holder_from_world is not None:
        camera = camera._replace(holder_from_world=as_se3(holder_from_world))
    readings = read_robot_readings(described, options.bad_views)
    if description.pictures is not None:
        if description.mount == "hand_to_hand":
            require_one_numbering(camera.target, described.path)
        files = camera_pictures(camera, readings, described, description.pictures.pattern)
        data = camera_dataset(camera, readings, files, options, described.path)
    elif camera.detections.is_file():
        data = detected_dataset(camera, readings, options, described.path)
    else:
        raise ValueError(
            f"{described.path}: entry 'pictures' is missing, and there is no {DETECTIONS_FILE}"
        )
    depths = description.depth_pictures
    if depths is not None and depths.camera is not None:
        return read_depth_pictures(data, readings, described, options)
    data = with_folder_depths(data, described, options)
    if description.mount != "hand_to_hand":
        return data
    entry = described.content["other_poses"]
    other = read_poses(described.folder, entry, options.bad_views, "other_poses")
    return with_other_hand(data, other, described.folder / entry["file"])


def _board_heights(camera: FolderDescription, readings: RobotReadings) -> Mapping[str, int] | None:
    """Return the height of the target in each view, if every picture has its own pose."""
    return read_board_heights(
        readings.table, camera.target, readings.view_ids, readings.name_suffix
    )


def camera_pictures(
    camera: FolderDescription, readings: RobotReadings, described: DescribedFolder, pattern: str
) -> dict[str, list[Path]]:
    """Return the files of a camera's pictures by view; see `picture_files`."""
    heights = _board_heights(camera, readings)
    return picture_files(described, pattern, readings.view_ids, camera.target, heights)


def camera_dataset(
    camera: FolderDescription,
    readings: RobotReadings,
    files: Mapping[str, Sequence[Path]],
    options: LoadOptions,
    description_path: Path,
) -> Dataset:
    """Return the data set of one camera, whose target is detected in its pictures."""
    data = dataset_from_pictures(
        files,
        readings.poses,
        ShownTarget(
            camera.target,
            camera.mount,
            camera.image_size,
            camera.holder_from_world,
            _board_heights(camera, readings),
        ),
        options=options,
        masked_views=readings.masked_views,
        cache=camera.detections if options.keep_detections else None,
    )
    return _with_joints(readings, data, description_path)


def detected_dataset(
    camera: FolderDescription,
    readings: RobotReadings,
    options: LoadOptions,
    description_path: Path,
) -> Dataset:
    """Return the data set of one camera from its table of detected points."""
    try:
        detected, table_notes = read_detections(
            camera.detections,
            readings.view_ids,
            len(camera.target.points),
            camera.detection_rows,
        )
        pixels, failed, notes = checked_pixels(
            camera.target.points,
            detected,
            readings.view_ids,
            camera.image_size,
            options.detection_limits,
        )
        if len(failed) == len(readings.view_ids):
            view, reason = next(iter(failed.items()))
            raise ValueError(f"view {view}: {reason}; so are all {len(failed)} views")
        data = Dataset.from_arrays(
            camera.target.points,
            pixels,
            readings.poses,
            camera.image_size,
            view_ids=readings.view_ids,
            mount=camera.mount,
            bad_views=options.bad_views,
            masked_views=list({**failed, **readings.masked_views}.items()),
            target=camera.target,
            notes=(*notes, *table_notes),
        )
    except ValueError as error:
        # `read_detections` names the file in its messages, `Dataset` does not.
        named = str(camera.detections.parent) in str(error)
        prefix = "" if named else f"{camera.detections}: "
        raise ValueError(f"{prefix}{error}") from error
    return _with_joints(readings, data, description_path)


def _with_joints(readings: RobotReadings, data: Dataset, description_path: Path) -> Dataset:
    """Return the data set with joint readings, pose format and notes of the robot's tables."""
    with errors_at(f"{description_path}: joints"):
        data = readings.with_joints(data)
    return dataclasses.replace(
        data, notes=(*readings.notes, *data.notes), pose_format=readings.pose_format
    )


def save_dataset(data: Dataset, folder: str | Path, pose_format: str = "matrix") -> None:
    """Write poses, target, detections, depths and joint readings for `load_dataset`.

    Args:
        data: a data set whose points are its target's; without a target they are listed. Or one of
            tracked poses.
        pose_format: pose format of the tables: one of `POSE_CODECS`.

    Raises:
        ValueError: an unknown pose format, points that are not the target's, or a name or value
            with which the folder could not be read back; nothing is written.

    For example:

        >>> import tempfile
        >>> board = sv.targets.Chessboard(3, 4, 0.01)
        >>> seen = sv.simulation.random_target_scene(seed=0, views=3, target=board).data
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     sv.save_dataset(seen, f"{folder}/board", pose_format="kuka_abc")
        ...     print(sv.load_dataset(f"{folder}/board").pose_format)
        kuka_abc
    """
    with file_transaction(folder) as place:
        if isinstance(data, PoseDataset):
            _save_tracked_poses(data, place, pose_format)
        else:
            _save_pictures(data, place, pose_format)


def _save_tracked_poses(data: PoseDataset, folder: Path, pose_format: str) -> None:
    entries = {
        "mount": data.mount,
        "poses": poses_entry(data.view_count, pose_format),
        "tracked_poses": write_tracked_poses(data, folder, pose_format),
        **written_joints(folder, data),
    }
    poses = {POSES_FILE: (data.view_ids, data.base_from_tool)}
    write_described_folder(folder, poses, entries, pose_format)


def _save_pictures(data: Dataset, folder: Path, pose_format: str) -> None:
    target = described_target(data, "save_dataset: the data set")
    base_from_tool, of_other = data.base_from_tool, {}
    if data.hands is not None:
        base_from_tool, other = data.hands.base_from_tool, data.hands.other_base_from_other_tool
        write_poses(folder, data.view_ids, other, pose_format, OTHER_POSES_FILE)
        of_other = {"other_poses": poses_entry(data.view_count, pose_format, OTHER_POSES_FILE)}
    write_dataset_folder(
        folder,
        data.view_ids,
        base_from_tool,
        data.image_size,
        target,
        data.mount,
        {
            "detections": {"rows": write_visible_points(folder / DETECTIONS_FILE, data)},
            **write_depths(data, folder / DEPTHS_FILE),
            **written_joints(folder, data),
            **of_other,
        },
        pose_format,
    )


def described_target(data: Dataset, owner: str) -> AbstractTarget:
    """Return the target of a data set, or its listed points; an error names the owner."""
    points, target = np.asarray(data.points), data.target
    if target is None:
        differ = np.flatnonzero((points != points[:1]).any(axis=(1, 2)))
        if len(differ):
            first, other = data.view_ids[0], data.view_ids[differ[0]]
            raise ValueError(
                f"{owner} has no target, and its points differ between views {first} and {other}: "
                "a folder has one list of points"
            )
        return ListedPoints.of(points[0])
    if points.shape[1:] != target.points.shape or not np.allclose(
        points, target.points[None], atol=1e-9
    ):
        raise ValueError(f"{owner} has points that are not its target's")
    return target


def write_visible_points(path: Path, data: Dataset) -> int:
    """Write the points that are visible to a table of detections; return the number of rows.

    A point that was hidden, such as a gross error, has no row, so it stays hidden when read back.
    """
    visible = np.asarray(data.visible)[..., None]
    return write_detections(path, data.view_ids, np.where(visible, data.pixels, np.nan))


def written_joints(folder: Path, data: Dataset | Rig) -> dict[str, Any]:
    """Write the joint readings, if there are any, and return the entry that describes them."""
    if data.arm is None or data.joints is None:
        return {}
    write_joints(folder, data.view_ids, np.asarray(data.joints), data.arm)
    return {"joints": joints_entry(len(data.view_ids), data.arm)}


def write_dataset_folder(
    folder: Path,
    view_ids: Sequence[str],
    base_from_tool: SE3,
    image_size: tuple[int, int],
    target: AbstractTarget,
    mount: str,
    extra_entries: dict[str, Any] | None = None,
    pose_format: str = "matrix",
) -> None:
    """Write `poses.csv` and then `dataset.yaml`, which marks the folder as a data set.

    Args:
        folder: a folder that already has the pictures or detections.
        view_ids: one id for each pose.
        base_from_tool: reported poses, `(views)`.
        image_size: width and height, px.
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        extra_entries: further entries of the description, such as `pictures` or `joints`.
        pose_format: one of `POSE_CODECS`.

    Raises:
        ValueError: an unknown pose format, or a name or a value with which the folder could not be
            read back.
    """
    entries = {
        "camera": {"image_size": [int(size) for size in image_size]},
        "target": target_to_dict(target),
        "mount": mount,
        "poses": poses_entry(len(view_ids), pose_format),
        **(extra_entries or {}),
    }
    poses = {POSES_FILE: (view_ids, base_from_tool)}
    write_described_folder(folder, poses, entries, pose_format)


def write_described_folder(
    folder: Path,
    poses: Mapping[str, tuple[Sequence[str], SE3]],
    entries: Mapping[str, Any],
    pose_format: str,
) -> None:
    """Write tables of poses, by their names, and then the description with the given entries."""
    description = marked_entries(entries)
    schema = schemas.RIG_SCHEMA if "cameras" in description else schemas.DATASET_SCHEMA
    schemas.refuse_unreadable(description, schema, folder / DESCRIPTION_FILE)
    for file, (view_ids, base_from_tool) in poses.items():
        write_poses(folder, view_ids, base_from_tool, pose_format, file)
    # Written last: an interrupted run leaves a folder that is not a data set, not half of one.
    schemas.write_validated(folder / DESCRIPTION_FILE, description, schema)
