"""Read and write a folder of pictures of an object with the robot's poses.

    smartview_object_views: 1
    camera: {image_size: [640, 480]}
    poses: {file: poses.csv, codec: matrix, length_unit: m, angle_unit: rad,
            direction: base_from_tool}
    pictures: {pattern: "images/{view}.png"}
    end: smartview_object_views

The file is called `object_views.yaml`. Pictures and poses are matched by the view's name, as in a
data-set folder. An entry `joints`, as in a data-set folder, may add joint readings to the poses or
replace them. The calibration is a separate file, because a camera is used for many objects.

In a folder of several cameras, a camera has a picture of a state of the robot or has none:

    smartview_object_views: 1
    cameras:
      left: {image_size: [1280, 1024]}
      right: {image_size: [1280, 1024]}
    poses: {file: poses.csv, codec: matrix, length_unit: m, angle_unit: rad,
            direction: base_from_tool}
    pictures: {pattern: "images/{camera}/{view}.png"}
    end: smartview_object_views

Cameras next to the arm need no robot: `views: [a, b]` in the place of `poses` names the states.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxlie import SE3
from jaxtyping import UInt8

from .. import schemas
from ..argument_checks import require_distinct
from ..detection import read_picture
from ..files import dump_yaml, file_transaction, read_yaml, write_atomically
from ..modeling import command_at
from ..robots import Command, CommandLike, SerialArm, as_command
from .folder_description import DescribedFolder
from .joints import joints_entry, write_joints
from .poses import poses_entry, write_poses
from .robot_readings import read_sound_readings

OBJECT_VIEWS_FILE = "object_views.yaml"
"""The name of the file that describes the folder."""


class ObjectViews(NamedTuple):
    """Pictures of an object and the robot's reported poses.

    Attributes:
        paths: files of the pictures.
        pictures: grey levels.
        command: reported pose of each view, with joint readings if the folder has them.
        image_size: width and height, px.
        notes: sentences on what was recognised in the tables.
    """

    view_ids: tuple[str, ...]
    paths: tuple[Path, ...]
    pictures: tuple[UInt8[np.ndarray, "rows columns"], ...]
    command: Command
    image_size: tuple[int, int]
    notes: tuple[str, ...] = ()

    @property
    def base_from_tool(self) -> SE3:
        """The reported poses, `(views)`."""
        return self.command.base_from_tool


class RigObjectViews(NamedTuple):
    """Pictures of an object by several cameras, with the robot's reported poses.

    Attributes:
        view_ids: names of the views, the camera's name before the state's: `left/3`.
        cameras: name of the camera of each view.
        states: name of the robot's state in each view.
        paths: files of the pictures.
        pictures: grey levels.
        command: reported pose of each view, with joint readings if the folder has them; None
            without a robot.
        notes: sentences on what was recognised in the tables.
    """

    view_ids: tuple[str, ...]
    cameras: tuple[str, ...]
    states: tuple[str, ...]
    paths: tuple[Path, ...]
    pictures: tuple[UInt8[np.ndarray, "rows columns"], ...]
    command: Command | None
    notes: tuple[str, ...] = ()


def load_object_views(folder: str | Path) -> ObjectViews:
    """Read the pictures of an object and their poses.

    Raises:
        FileNotFoundError: the description, a table or a picture is missing.
        ValueError: a wrong entry, view or picture; the message names it and the file.
    """
    described, description = DescribedFolder.of(folder, OBJECT_VIEWS_FILE).validated(
        schemas.OBJECT_VIEWS_SCHEMA
    )
    readings = read_sound_readings(described)
    width, height = description.camera.image_size
    pattern = description.pictures.pattern
    # Matched by name, so that an extra or missing picture does not shift the others.
    paths = tuple(described.folder / pattern.format(view=view) for view in readings.view_ids)
    pictures = tuple(read_picture(file, (width, height)) for file in paths)
    return ObjectViews(
        tuple(readings.view_ids),
        paths,
        pictures,
        readings.command,
        (width, height),
        readings.notes,
    )


def is_rig_object_views(folder: str | Path) -> bool:
    """Return whether a folder's `object_views.yaml` has several cameras; false without the file."""
    path = Path(folder) / OBJECT_VIEWS_FILE
    return path.is_file() and "cameras" in read_yaml(path)


def load_rig_object_views(folder: str | Path) -> RigObjectViews:
    """Read the pictures of an object by several cameras, and the robot's poses.

    Raises:
        FileNotFoundError: the description or a table is missing, or a state has no picture.
        ValueError: a wrong entry, view or picture; the message names it and the file.
    """
    described, description = DescribedFolder.of(folder, OBJECT_VIEWS_FILE).validated(
        schemas.RIG_OBJECT_VIEWS_SCHEMA
    )
    folder, pattern = described.folder, description.pictures.pattern
    states, command, notes = description.views, None, ()
    if states is None:
        # A view's name in the table may end as the picture's does, which the first camera's tell.
        first = pattern.replace("{camera}", next(iter(description.cameras)))
        content = {**described.content, "pictures": {"pattern": first}}
        readings = read_sound_readings(described._replace(content=content))
        states, command, notes = list(readings.view_ids), readings.command, readings.notes
    entries = [
        (camera, k, folder / pattern.format(camera=camera, view=state))
        for k, state in enumerate(states)
        for camera in description.cameras
    ]
    entries = [entry for entry in entries if entry[2].is_file()]
    seen = {k for _, k, _ in entries}
    for k, state in enumerate(states):
        if k not in seen:
            raise FileNotFoundError(f"{folder / pattern}: no camera has a picture of view {state}")
    sizes = {name: entry.image_size for name, entry in description.cameras.items()}
    rows = np.array([k for _, k, _ in entries])
    return RigObjectViews(
        tuple(f"{camera}/{states[k]}" for camera, k, _ in entries),
        tuple(camera for camera, _, _ in entries),
        tuple(states[k] for k in rows),
        tuple(file for _, _, file in entries),
        tuple(read_picture(file, (sizes[c][0], sizes[c][1])) for c, _, file in entries),
        None if command is None else command_at(command, rows),
        notes,
    )


def write_object_views(
    folder: str | Path,
    view_ids: Sequence[str],
    pictures: Sequence[UInt8[np.ndarray, "rows columns"]],
    command: CommandLike,
    suffix: str = ".png",
    pose_format: str = "matrix",
    arm: SerialArm | None = None,
) -> Path:
    """Write pictures of an object and their poses as a folder that `load_object_views` reads.

    Args:
        view_ids: names of the views, used as file names.
        pictures: one for each view, all of the same size.
        command: poses that the robot reported, `(views)`; with joint readings if the calibration
            corrects errors of the arm.
        suffix: format of the picture files; `".jpg"` is small, `".png"` lossless.
        pose_format: pose format of `poses.csv`: one of `POSE_CODECS`.

    Raises:
        ValueError: numbers of views, pictures, poses and readings differ, or the pictures' sizes
            differ, or only one of joint readings and `arm` is given, or a view's name is invalid;
            nothing is written.
    """
    folder, command = Path(folder), as_command(command)
    poses, joints = command.base_from_tool, command.joints
    if not len(view_ids) == len(pictures) == len(poses.wxyz_xyz) > 0:
        raise ValueError(
            f"found {len(view_ids)} views, {len(pictures)} pictures and {len(poses.wxyz_xyz)} "
            f"poses; expected one of each for every view"
        )
    if (joints is None) != (arm is None):
        raise ValueError("joint readings of the command, and arm: give both, or neither")
    if joints is not None and len(joints) != len(view_ids):
        raise ValueError(f"joints: expected {len(view_ids)} rows, found {len(joints)}")
    require_distinct("view_ids", view_ids)
    sizes = {picture.shape for picture in pictures}
    if len(sizes) > 1:
        raise ValueError(f"pictures: expected one size, found {sorted(sizes)}")
    height, width = pictures[0].shape
    description: dict[str, Any] = {
        "smartview_object_views": 1,
        "camera": {"image_size": [width, height]},
        "poses": poses_entry(len(view_ids), pose_format),
        "pictures": {"pattern": f"images/{{view}}{suffix}"},
    }
    if arm is not None:
        description["joints"] = joints_entry(len(view_ids), arm)
    description["end"] = "smartview_object_views"
    schemas.refuse_unreadable(description, schemas.OBJECT_VIEWS_SCHEMA, folder / OBJECT_VIEWS_FILE)
    with file_transaction(folder) as temporary:
        # First the table, which refuses names that lead out of the folder.
        write_poses(temporary, view_ids, poses, pose_format)
        if joints is not None and arm is not None:
            write_joints(temporary, view_ids, np.asarray(joints), arm)
        for view, picture in zip(view_ids, pictures, strict=True):
            encoded = cv2.imencode(suffix, picture)[1].tobytes()
            write_atomically(temporary / "images" / f"{view}{suffix}", encoded)
        write_atomically(temporary / OBJECT_VIEWS_FILE, dump_yaml(description))
    return folder
