"""Import folders of robot_cal_tools and industrial_calibration (`cal_data.yaml`, `target.yaml`)."""

from pathlib import Path
from typing import Unpack

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from .. import schemas
from ..argument_checks import errors_at
from ..dataset import Dataset
from ..files import parse_yaml, read_text
from ..geometry import pose_codec
from ..targets import AbstractTarget, CircleGrid
from .csv_tables import duplicates
from .folder_pictures import ImportOptions, LoadOptions
from .picture_detections import ShownTarget
from .pictures import dataset_from_pictures

DATA_FILE = "cal_data.yaml"
"""The name of the file that lists the picture and the pose file of every view."""

_POSE_KEYS = ("x", "y", "z", "qx", "qy", "qz", "qw")


def import_robot_cal_tools(
    folder: str | Path,
    mount: str = "eye_in_hand",
    **options: Unpack[ImportOptions],
) -> Dataset:
    """Import a data set with pictures of a modified circle grid.

    Views are named by their picture files, not by their index in `cal_data.yaml`, whose order is
    alphabetical (0, 1, 10, ...).

    Args:
        folder: folder with `cal_data.yaml`, `target.yaml`, and the files that they name.
        mount: `"eye_in_hand"` or `"eye_to_hand"`; the folder does not contain it.
        options: `bad_views`, `progress` and `detection_limits`, as in `load_dataset`.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a wrong value; the message names the file.
    """
    folder = Path(folder)
    entries = _read_entries(folder / DATA_FILE)
    views = [Path(image).stem for image, _ in entries]
    rows = np.stack([_read_pose(folder / pose) for _, pose in entries])
    with errors_at(folder / DATA_FILE):
        poses = pose_codec("quaternion_xyzw").decode(rows, labels=views)
    return dataset_from_pictures(
        {view: [folder / image] for view, (image, _) in zip(views, entries, strict=True)},
        poses,
        ShownTarget(_read_target(folder / "target.yaml"), mount),
        options=LoadOptions(**options),
    )


def _read_entries(path: Path) -> list[tuple[str, str]]:
    """Read the picture file and pose file of every view, in the order of the pictures' names."""
    entries = schemas.validate_content(
        parse_yaml(read_text(path), path), schemas.CAL_DATA_SCHEMA, path
    )
    views = duplicates([Path(entry.image).stem for entry in entries])
    if views:
        raise ValueError(f"{path}: view {', '.join(views)} has more than one entry")
    # Sorting by length first puts names that are numbers into numerical order: 2.png before 10.png.
    return sorted(
        ((entry.image, entry.pose) for entry in entries),
        key=lambda files: (len(Path(files[0]).stem), files[0]),
    )


def _read_pose(path: Path) -> np.ndarray:
    """Read a pose file as x, y, z (m) and the quaternion qx, qy, qz, qw."""
    pose = schemas.read_validated(path, schemas.POSE_SCHEMA)
    return np.array([getattr(pose, key) for key in _POSE_KEYS])


def _read_target(path: Path) -> AbstractTarget:
    """Read `target.yaml`; raise a ValueError unless it is a modified circle grid."""
    finder = schemas.read_validated(path, schemas.TARGET_SCHEMA).target_finder
    if "ModifiedCircleGrid" not in finder.type:
        raise ValueError(f"{path}: expected a modified circle grid, found {finder.type!r}")
    # A modified circle grid has one larger circle, at the origin.
    return CircleGrid(finder.rows, finder.cols, finder.spacing, origin_mark=True)


def read_robot_cal_kinematics(path: str | Path) -> tuple[Float[np.ndarray, "views joints"], SE3]:
    """Read a kinematic calibration: a camera observes a target on a positioner.

        '<time stamp>': {camera_joints: [], target_joints: [rad, ...], pose: {x, y, z, qx, ...}}

    Returns:
        The positioner's joint readings (rad) and `camera_from_target`, in the file's order.

    Raises:
        ValueError: an entry lacks a number, or the camera has joints.
        FileNotFoundError: the file is missing.
    """
    path = Path(path)
    measurements = schemas.read_validated(path, schemas.KINEMATIC_MEASUREMENTS_SCHEMA)
    for name, entry in measurements.items():
        if entry.camera_joints:
            raise ValueError(f"{path}: entry {name}: the camera has joints; only the target may")
    joints = [entry.target_joints for entry in measurements.values()]
    if len({len(row) for row in joints}) != 1:
        raise ValueError(f"{path}: target_joints: entries have different numbers of joints")
    rows = [[getattr(entry.pose, key) for key in _POSE_KEYS] for entry in measurements.values()]
    with errors_at(path):
        poses = pose_codec("quaternion_xyzw").decode(
            np.array(rows), labels=list(map(str, measurements))
        )
    return np.array(joints), poses
