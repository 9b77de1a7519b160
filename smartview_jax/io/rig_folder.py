"""Read and write a folder with the pictures of several cameras that watched one robot or several.

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

Of several arms, each has its own tables, and a camera states which arm moved it or its target:

    cameras:
      left_hand: {image_size: [640, 480], arm: left}
      right_hand: {image_size: [640, 480], arm: right}
    arms:
      left: {poses: {file: left/poses.csv, codec: ur, length_unit: m, angle_unit: rad,
                     direction: base_from_tool}}
      right: {poses: {file: right/poses.csv, codec: fanuc_wpr, length_unit: mm, angle_unit: deg,
                      direction: base_from_tool}}

A camera on one hand that sees a target on another states both arms; the views of a state have one
name in both tables. Cameras next to an arm may see the same target on its hand:

    cameras:
      wrist: {image_size: [640, 480], mount: hand_to_hand, arm: left, target_arm: right}
      fixed: {image_size: [1280, 1024], mount: eye_to_hand, arm: right}

A camera that measures depths too has the entry `depth_pictures` or `depths` of `point_depths`; the
table of the latter is `depths/<camera>.csv`:

    cameras:
      wrist: {image_size: [640, 480],
              depth_pictures: {pattern: "depth/wrist/{view}.png", unit: mm}}

Detected points of a camera are kept in `detections/<camera>.csv`. All else is as in a folder with
one camera (`dataset_folder`).
"""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from .. import schemas
from ..argument_checks import errors_at
from ..dataset import ONE_ARM, Dataset, Rig, arms_of, reported_poses
from ..detection import DetectionLimits
from ..files import file_transaction
from ..geometry import host_transforms
from ..targets import AbstractTarget, target_to_dict
from .csv_tables import read_table
from .dataset_folder import (
    camera_dataset,
    camera_pictures,
    described_target,
    detected_dataset,
    write_described_folder,
    write_visible_points,
    written_joints,
)
from .folder_description import (
    DESCRIPTION_FILE,
    DescribedFolder,
    FolderDescription,
    read_target,
    rough_pose,
)
from .folder_pictures import LoadOptions
from .point_depths import with_folder_depths, write_depths
from .poses import RobotReadings, poses_entry
from .robot_readings import read_robot_readings
from .table_text import VIEW_COLUMN
from .two_hands_folder import require_one_numbering, with_other_hand

DETECTIONS_FOLDER, DEPTHS_FOLDER = "detections", "depths"
"""The names of the folders with a table of detected points, or of depths, for each camera."""


def is_rig_folder(folder: str | os.PathLike[str]) -> bool:
    """Return whether a folder's `dataset.yaml` has several cameras; false without the file."""
    return (Path(folder) / DESCRIPTION_FILE).is_file() and DescribedFolder.of(folder).is_rig


def load_rig(
    folder: str | os.PathLike[str],
    bad_views: str = "raise",
    progress: Callable[[str], None] | None = None,
    keep_detections: bool = True,
    detection_limits: DetectionLimits | None = None,
) -> Rig:
    """Load the pictures (or detections) of several cameras, with the poses of one robot or several.

    A camera's views are the states of its robot that it took a picture in. A picture in which the
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
    described = DescribedFolder.of(folder)
    if not described.is_rig:
        raise ValueError(
            f"{described.path}: entry 'cameras' is missing: load_dataset reads one camera"
        )
    described, description = described.validated(schemas.RIG_SCHEMA)
    cameras = _cameras(described, description)
    pattern = None if description.pictures is None else description.pictures.pattern
    patterns = {name: (pattern or "").replace("{camera}", name) for name in cameras}
    arms = {name: entry.arm or ONE_ARM for name, entry in description.cameras.items()}
    others = {name: entry.target_arm for name, entry in description.cameras.items()}
    robots, readings_of = {}, {}
    for arm, content in (described.content.get("arms") or {ONE_ARM: described.content}).items():
        # A view's name in the table may end as the picture's does, which the arm's first camera's
        # tell.
        first = next(patterns[name] for name in cameras if arm in (arms[name], others[name]))
        pictures = {"pictures": {"pattern": first}} if pattern else {}
        robots[arm] = described._replace(content={**content, **pictures})
        readings_of[arm] = read_robot_readings(robots[arm], bad_views)
    data = {}
    for name, camera in cameras.items():
        readings, robot = readings_of[arms[name]], robots[arms[name]]
        if (other := others[name]) is not None:
            if pattern is not None:
                require_one_numbering(camera.target, described.path)
            # The joints of one arm do not tell the pose of one hand in the other's frame.
            readings = readings._replace(joints=None, arm=None)
        report = None if progress is None else _named(progress, name)
        options = LoadOptions(bad_views, report, keep_detections, detection_limits)
        data[name] = _views_of_camera(name, camera, readings, robot, patterns[name], options)
        entries = {**robot.content, **described.content["cameras"][name]}
        with errors_at(f"cameras.{name}"):
            data[name] = with_folder_depths(
                data[name],
                robot._replace(content=entries),
                options,
                f"{DEPTHS_FOLDER}/{name}.csv",
            )
        if other is not None:
            table = robots[other].view_table
            data[name] = with_other_hand(data[name], readings_of[other], table)
    for arm, robot in robots.items():
        seen = {name: data[name] for name in data if arm in (arms[name], others[name])}
        _refuse_unseen_states(readings_of[arm].view_ids, seen, robot.view_table)
    targets = {name: entry.target for name, entry in description.cameras.items()}
    known = {name: target for name, target in targets.items() if target is not None}
    return Rig(
        data,
        None if description.targets is None else known,
        None
        if description.arms is None
        else {
            name: arm if (other := others[name]) is None else (arm, other)
            for name, arm in arms.items()
        },
    )


def _views_of_camera(
    name: str,
    camera: FolderDescription,
    readings: RobotReadings,
    robot: DescribedFolder,
    pattern: str,
    options: LoadOptions,
) -> Dataset:
    """Return the data set of one camera, of those states in which it took a picture.

    Without a pattern of pictures only the detected points are known.
    """
    if not pattern:
        readings = readings.of_views(_detected_views(camera, readings))
        return detected_dataset(camera, readings, options, robot.path)
    files = camera_pictures(camera, readings, robot, pattern)
    files = {view: paths for view, paths in files.items() if any(p.exists() for p in paths)}
    if not files:
        raise FileNotFoundError(f"{robot.folder / pattern}: camera {name} has no picture")
    return camera_dataset(camera, readings.of_views(list(files)), files, options, robot.path)


def _cameras(
    described: DescribedFolder, description: "schemas.RigFile"
) -> dict[str, FolderDescription]:
    folder, content = described.folder, described.content
    with errors_at(described.path):
        named = content.get("targets") or {"": content["target"]}
        targets = {name: read_target(folder, entry) for name, entry in named.items()}
        rough = {
            arm: {
                "eye_in_hand": rough_pose(robot.base_from_world),
                "eye_to_hand": rough_pose(robot.tool_from_world),
            }
            for arm, robot in (description.arms or {ONE_ARM: description}).items()
        }
    cameras = {}
    for name, entry in description.cameras.items():
        # Pictures of a target on another hand are read as by a camera on a hand.
        is_pair = entry.mount == "hand_to_hand"
        mount = "eye_in_hand" if is_pair else entry.mount or description.mount
        width, height = entry.image_size
        cameras[name] = FolderDescription(
            targets[entry.target or ""],
            mount,
            (width, height),
            None if is_pair else rough[entry.arm or ONE_ARM][mount],
            folder / DETECTIONS_FOLDER / f"{name}.csv",
            None if entry.detections is None else entry.detections.rows,
        )
    return cameras


def _named(progress: Callable[[str], None], camera: str) -> Callable[[str], None]:
    """Return a function that reports progress with the camera's name."""
    return lambda text: progress(f"{camera}: {text}")


def _detected_views(camera: FolderDescription, readings: RobotReadings) -> list[str]:
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

    Each of several arms has a folder with its tables.

    Args:
        rig: data sets whose points are their targets'; without a target they are listed.
        pose_format: pose format of the table: one of `POSE_CODECS`.

    Raises:
        ValueError: an unknown pose format, points that are not the target's, cameras that describe
            one target differently, or a name or value with which the folder could not be read back;
            nothing is written.

    Example:
        >>> import os, tempfile
        >>> board = sv.targets.Chessboard(3, 4, 0.01)
        >>> seen = sv.simulation.random_target_scene(seed=0, views=3, target=board).data
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     sv.save_rig(sv.Rig({"left": seen, "right": seen.select([0, 1])}), folder)
        ...     print(sorted(os.listdir(folder)))
        ['dataset.yaml', 'detections', 'poses.csv']
    """
    with file_transaction(folder) as place:
        _save_rig(rig, place, pose_format)


def _save_rig(rig: Rig, folder: Path, pose_format: str) -> None:
    targets = _described_targets(rig)
    several = len(rig.robot_names) > 1
    places = {arm: f"{arm}/" if several else "" for arm in rig.robot_names}
    robots = {}
    states = {arm: _states(rig, arm) for arm in places}
    for arm, place in places.items():
        poses = poses_entry(len(states[arm]), pose_format)
        robots[arm] = {"poses": {**poses, "file": f"{place}{poses['file']}"}}
    mounts = {data.mount for data in rig.cameras.values()}
    one_mount = len(mounts) == 1 and "hand_to_hand" not in mounts
    one_target = len(targets) == 1
    cameras = {}
    for name, data in rig.cameras.items():
        path = folder / DETECTIONS_FOLDER / f"{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        rows = write_visible_points(path, data)
        arm, *other = arms_of(rig.arms[name])
        cameras[name] = {
            "image_size": [int(size) for size in data.image_size],
            **({} if one_mount else {"mount": data.mount}),
            **({} if one_target else {"target": rig.targets[name]}),
            **({"arm": arm} if several else {}),
            **({"target_arm": other[0]} if other else {}),
            "detections": {"rows": rows},
            **write_depths(data, folder / DEPTHS_FOLDER / f"{name}.csv"),
        }
    described = {name: target_to_dict(target) for name, target in targets.items()}
    entries: dict[str, Any] = {"cameras": cameras}
    entries |= {"target": next(iter(described.values()))} if one_target else {"targets": described}
    entries |= {"mount": mounts.pop()} if one_mount else {}
    tables = {}
    for arm, place in places.items():
        poses = host_transforms(np.array(list(states[arm].values())))
        tables[robots[arm]["poses"]["file"]] = (tuple(states[arm]), poses)
        alone = [name for name, of_camera in rig.arms.items() if of_camera == arm]
        if set(states[arm]) == {view for name in alone for view in rig.cameras[name].view_ids}:
            # The joints of states that only a camera of a pair saw are not known.
            for name, entry in written_joints(folder / place, rig.of_arm(arm)).items():
                robots[arm][name] = {**entry, "file": f"{place}{entry['file']}"}
    entries |= {"arms": robots} if several else robots[rig.robot_names[0]]
    write_described_folder(folder, tables, entries, pose_format)


def _states(rig: Rig, arm: str) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Return the pose that an arm reported in each of its states, by the view's name."""
    states: dict[str, Float[np.ndarray, "4 4"]] = {}
    for name, data in rig.cameras.items():
        for reporter, poses in zip(arms_of(rig.arms[name]), reported_poses(data), strict=True):
            if reporter == arm:
                for view, pose in zip(data.view_ids, poses, strict=True):
                    states.setdefault(view, pose)
    return states


def _described_targets(rig: Rig) -> dict[str, AbstractTarget]:
    targets: dict[str, AbstractTarget] = {}
    # The target of listed points may be described by another camera.
    for name, data in sorted(rig.cameras.items(), key=lambda item: item[1].target is None):
        target = described_target(data, f"save_rig: camera {name!r}")
        known = targets.setdefault(rig.targets[name], target)
        if data.target is None and np.array_equal(known.points, target.points):
            continue
        if target_to_dict(known) != target_to_dict(target):
            raise ValueError(f"save_rig: camera {name!r} describes {rig.targets[name]!r} otherwise")
    return targets
