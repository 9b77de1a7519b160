"""Read and write a folder with the pictures of several cameras that watched one robot.

    smartview_dataset: 1
    cameras:
      left: {image_size: [1280, 1024]}
      right: {image_size: [1280, 1024]}
    target: {kind: charuco, squares_x: 7, squares_y: 5, square: 0.03, marker: 0.022}
    mount: eye_in_hand
    poses: {file: poses.csv, codec: ur, length_unit: m, angle_unit: rad,
            direction: base_from_tool}
    pictures: {pattern: "images/{camera}/{view}.png"}

The table of poses has a row for each state of the robot; a camera has a picture of a state or has
none. With cameras on the hand and next to the arm, or with several targets, a camera states its own
`mount` and the name of its `target`:

    cameras:
      wrist: {image_size: [640, 480], target: table}
      fixed: {image_size: [1280, 1024], mount: eye_to_hand, target: hand}
    targets:
      table: {kind: chessboard, rows: 9, columns: 6, square: 0.025}
      hand: {kind: chessboard, rows: 4, columns: 3, square: 0.05}

Detected points of a camera are kept in `detections/<camera>.csv`. All else is as in a folder with
one camera (`dataset_folder`).
"""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..dataset import Dataset, Rig
from ..detection import DetectionLimits
from ..files import read_yaml
from ..targets import AbstractTarget, target_to_dict
from .csv_tables import read_table
from .dataset_folder import (
    DESCRIPTION_FILE,
    CameraDescription,
    LoadOptions,
    camera_board_heights,
    camera_dataset,
    detected_dataset,
    is_described,
    is_rig_description,
    picture_files,
    refuse_unreadable_robot,
    without_nulls,
    write_described_folder,
    write_visible_points,
    written_joints,
)
from .poses import poses_entry
from .robot_readings import RobotReadings, read_robot_readings, table_of_views
from .rough_pose import rough_pose_of
from .table_text import VIEW_COLUMN
from .target_file import read_target

if TYPE_CHECKING:
    from ..schemas.rig import RigFile

DETECTIONS_FOLDER = "detections"
"""The name of the folder with a table of detected points for each camera."""


def is_rig_folder(folder: str | os.PathLike[str]) -> bool:
    """Return whether a folder's `dataset.yaml` has several cameras; false without the file."""
    path = Path(folder) / DESCRIPTION_FILE
    return path.is_file() and is_rig_description(read_yaml(path))


def load_rig(
    folder: str | os.PathLike[str],
    bad_views: str = "raise",
    progress: Callable[[str], None] | None = None,
    keep_detections: bool = True,
    detection_limits: DetectionLimits | None = None,
) -> Rig:
    """Load the pictures (or detections) of several cameras, with one robot's poses.

    A camera's views are the states of the robot that it took a picture in. A picture in which the
    target is not found is kept as a masked view.

    Args:
        folder: with a `dataset.yaml` that has `cameras`.
        bad_views: treatment of a view with invalid values: `"raise"` or `"mask"`, as in
            `load_dataset`.
        progress: called with a line of text for each step of the work.
        keep_detections: whether to write the detections to the folder, to be read the next time.
        detection_limits: limits of the check of detected points; by default `DetectionLimits()`.

    Raises:
        FileNotFoundError: a file is missing, or a state has no picture from any camera.
        ValueError: something is wrong; the message names the file, the camera and the view.

    Example:
        >>> import tempfile
        >>> board = sv.targets.Chessboard(3, 4, 0.01)
        >>> seen = sv.simulation.random_target_scene(seed=0, views=3, target=board).data
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     sv.save_rig(sv.Rig({"left": seen, "right": seen.select([0, 1])}), folder)
        ...     print(sv.load_rig(folder))
        <Rig: 3 robot states; views of cameras left (3), right (2)>
    """
    from ..schemas.rig import RIG_SCHEMA
    from ..schemas.validation import validate_content

    folder = Path(folder)
    path = folder / DESCRIPTION_FILE
    raw_content = read_yaml(path)
    if not is_rig_description(raw_content):
        raise ValueError(f"{path}: entry 'cameras' is missing: load_dataset reads one camera")
    description = validate_content(raw_content, RIG_SCHEMA, path)
    content = without_nulls(raw_content)
    cameras = _cameras(folder, description, content, path)
    pattern = None if description.pictures is None else description.pictures.pattern
    patterns = {name: (pattern or "").replace("{camera}", name) for name in cameras}
    # A view's name in the table may end as the picture's does, which the first camera's tell.
    first = {"pictures": {"pattern": next(iter(patterns.values()))}} if pattern else {}
    readings = read_robot_readings(folder, {**content, **first}, path, bad_views)
    data = {}
    for name, camera in cameras.items():
        report = None if progress is None else _named(progress, name)
        options = LoadOptions(bad_views, report, keep_detections, detection_limits)
        if pattern is None:
            seen = _detected_views(camera, readings)
            data[name] = detected_dataset(camera, readings.of_views(seen), options, path)
            continue
        files = picture_files(
            folder,
            {"pattern": patterns[name]},
            readings.view_ids,
            camera.target,
            table_of_views(folder, content),
            path,
            camera_board_heights(camera, readings),
        )
        seen = [view for view, paths in files.items() if any(p.exists() for p in paths)]
        if not seen:
            raise FileNotFoundError(f"{folder / patterns[name]}: camera {name} has no picture")
        files = {view: files[view] for view in seen}
        data[name] = camera_dataset(camera, readings.of_views(seen), files, options, path)
    _refuse_unseen_states(readings.view_ids, data, table_of_views(folder, content))
    targets = {name: entry.target for name, entry in description.cameras.items()}
    if description.targets is None:
        return Rig(data)
    return Rig(data, {name: target for name, target in targets.items() if target is not None})


def _cameras(
    folder: Path, description: "RigFile", content: dict[str, Any], path: Path
) -> dict[str, CameraDescription]:
    """Return the description of each camera."""
    try:
        named = content.get("targets") or {"": content["target"]}
        targets = {name: read_target(folder, entry) for name, entry in named.items()}
        rough = {
            "eye_in_hand": rough_pose_of(description.base_from_world),
            "eye_to_hand": rough_pose_of(description.tool_from_world),
        }
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    cameras = {}
    for name, entry in description.cameras.items():
        mount = entry.mount or description.mount
        width, height = entry.image_size
        cameras[name] = CameraDescription(
            targets[entry.target or ""],
            mount,
            (width, height),
            rough[mount],
            folder / DETECTIONS_FOLDER / f"{name}.csv",
            None if entry.detections is None else entry.detections.rows,
        )
    return cameras


def _named(progress: Callable[[str], None], camera: str) -> Callable[[str], None]:
    """Return a function that reports progress with the camera's name."""
    return lambda text: progress(f"{camera}: {text}")


def _detected_views(camera: CameraDescription, readings: RobotReadings) -> list[str]:
    """Return the views that a camera's table of detected points has."""
    table = read_table(camera.detections, (VIEW_COLUMN,), ())
    detected = {row[VIEW_COLUMN] for row in table.rows}
    if unknown := sorted(detected - set(readings.view_ids)):
        raise ValueError(f"{camera.detections}: no pose for the view {', '.join(unknown[:5])}")
    return [view for view in readings.view_ids if view in detected]


def _refuse_unseen_states(
    view_ids: Sequence[str], cameras: Mapping[str, Dataset], table: Path
) -> None:
    """Raise a FileNotFoundError for a state of the robot that no camera has seen."""
    seen = {view for data in cameras.values() for view in data.view_ids}
    unseen = [view for view in view_ids if view not in seen]
    if unseen:
        raise FileNotFoundError(
            f"{table}: view {', '.join(unseen[:5])}: no camera has a picture of it"
        )


def save_rig(rig: Rig, folder: str | os.PathLike[str], pose_format: str = "matrix") -> None:
    """Write poses, targets and detections of a rig as a folder that `load_rig` reads.

    Args:
        rig: data sets with targets, whose points must be the targets'.
        folder: folder to create.
        pose_format: pose format of the table: one of `POSE_CODECS`.

    Raises:
        ValueError: an unknown pose format, a camera without a target's description, cameras that
            describe one target differently, or a name or value with which the folder could not be
            read back; nothing is written.

    Example:
        >>> import os, tempfile
        >>> board = sv.targets.Chessboard(3, 4, 0.01)
        >>> seen = sv.simulation.random_target_scene(seed=0, views=3, target=board).data
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     sv.save_rig(sv.Rig({"left": seen, "right": seen.select([0, 1])}), folder)
        ...     print(sorted(os.listdir(folder)))
        ['dataset.yaml', 'detections', 'poses.csv']
    """
    folder = Path(folder)
    targets = _described_targets(rig)
    refuse_unreadable_robot(folder, rig, pose_format)
    one_mount = len({data.mount for data in rig.cameras.values()}) == 1
    one_target = len(targets) == 1
    cameras = {}
    for name, data in rig.cameras.items():
        path = folder / DETECTIONS_FOLDER / f"{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        rows = write_visible_points(path, data)
        cameras[name] = {
            "image_size": [int(size) for size in data.image_size],
            **({} if one_mount else {"mount": data.mount}),
            **({} if one_target else {"target": rig.targets[name]}),
            "detections": {"rows": rows},
        }
    described = {name: target_to_dict(target) for name, target in targets.items()}
    entries: dict[str, Any] = {"cameras": cameras}
    entries |= {"target": next(iter(described.values()))} if one_target else {"targets": described}
    entries |= {"mount": next(iter(rig.cameras.values())).mount} if one_mount else {}
    entries["poses"] = poses_entry(len(rig.view_ids), pose_format)
    entries |= written_joints(folder, rig)
    write_described_folder(folder, rig.view_ids, rig.base_from_tool, entries, pose_format)


def _described_targets(rig: Rig) -> dict[str, AbstractTarget]:
    """Return the targets by name.

    Raises:
        ValueError: a camera without one, or cameras that describe one target differently.
    """
    targets: dict[str, AbstractTarget] = {}
    for name, data in rig.cameras.items():
        target = data.target
        if target is None or not is_described(data):
            raise ValueError(f"save_rig: camera {name!r} needs a target that describes its points")
        known = targets.setdefault(rig.targets[name], target)
        if target_to_dict(known) != target_to_dict(target):
            raise ValueError(f"save_rig: camera {name!r} describes {rig.targets[name]!r} otherwise")
    return targets
