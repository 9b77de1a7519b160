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
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxlie import SE3
from jaxtyping import Float, UInt8

from ..argument_checks import require_distinct
from ..detection import read_picture
from ..files import read_yaml, write_atomically
from ..geometry import PoseLike, as_se3
from ..robots import Command, SerialArm
from .joints import joints_entry, refuse_unreadable_joints, write_joints
from .poses import poses_entry, refuse_unreadable_poses, write_poses
from .robot_readings import read_robot_readings

OBJECT_VIEWS_FILE = "object_views.yaml"
"""The name of the file that describes the folder."""


class ObjectViews(NamedTuple):
    """Pictures of an object and the robot's reported poses.

    Attributes:
        view_ids: names of the views.
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


def load_object_views(folder: str | Path) -> ObjectViews:
    """Read the pictures of an object and their poses.

    Raises:
        FileNotFoundError: the description, a table or a picture is missing.
        ValueError: a wrong entry, view or picture; the message names it and the file.
    """
    # Importing pydantic takes a tenth of a second, so it is imported only where files are read.
    from ..schemas.object_views import OBJECT_VIEWS_SCHEMA
    from ..schemas.validation import validate_content

    folder = Path(folder)
    path = folder / OBJECT_VIEWS_FILE
    content = read_yaml(path)
    description = validate_content(content, OBJECT_VIEWS_SCHEMA, path)
    readings = read_robot_readings(folder, content, path, "raise")
    readings.refuse_masked(path)
    width, height = description.camera.image_size
    pattern = description.pictures.pattern
    # Matched by name, so that an extra or missing picture does not shift the others.
    paths = tuple(folder / pattern.format(view=view) for view in readings.view_ids)
    pictures = tuple(read_picture(file, (width, height)) for file in paths)
    return ObjectViews(
        tuple(readings.view_ids),
        paths,
        pictures,
        readings.command,
        (width, height),
        readings.notes,
    )


def write_object_views(
    folder: str | Path,
    view_ids: Sequence[str],
    pictures: Sequence[UInt8[np.ndarray, "rows columns"]],
    base_from_tool: PoseLike,
    suffix: str = ".png",
    pose_format: str = "matrix",
    joints: Float[np.ndarray, "views joints"] | None = None,
    arm: SerialArm | None = None,
) -> Path:
    """Write pictures of an object and their poses as a folder that `load_object_views` reads.

    Args:
        folder: folder to create.
        view_ids: names of the views, used as file names.
        pictures: one for each view, all of the same size.
        base_from_tool: `(views)` poses that the robot reported.
        suffix: format of the picture files; `".jpg"` is small, `".png"` lossless.
        pose_format: pose format of `poses.csv`: one of `POSE_CODECS`.
        joints: joint readings, rad (m for a prismatic joint), needed if the calibration
            corrects errors of the arm.
        arm: the arm that has these readings.

    Raises:
        ValueError: numbers of views, pictures, poses and readings differ, or the pictures' sizes
            differ, or only one of `joints` and `arm` is given, or a view's name is invalid; nothing
            is written.
    """
    from ..schemas.object_views import OBJECT_VIEWS_SCHEMA
    from ..schemas.validation import refuse_unreadable, write_validated

    folder, poses = Path(folder), as_se3(base_from_tool)
    if not len(view_ids) == len(pictures) == len(poses.wxyz_xyz) > 0:
        raise ValueError(
            f"found {len(view_ids)} views, {len(pictures)} pictures and {len(poses.wxyz_xyz)} "
            f"poses; expected one of each for every view"
        )
    if (joints is None) != (arm is None):
        raise ValueError("joints and arm: give both, or neither")
    if joints is not None and len(joints) != len(view_ids):
        raise ValueError(f"joints: expected {len(view_ids)} rows, found {len(joints)}")
    require_distinct("view_ids", view_ids)
    refuse_unreadable_poses(folder, view_ids, poses)
    if joints is not None and arm is not None:
        refuse_unreadable_joints(folder, view_ids, joints, arm)
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
    refuse_unreadable(description, OBJECT_VIEWS_SCHEMA, folder / OBJECT_VIEWS_FILE)
    for view, picture in zip(view_ids, pictures, strict=True):
        # Encoded in memory, because `cv2.imwrite` leaves half a file when it is interrupted.
        encoded = cv2.imencode(suffix, picture)[1].tobytes()
        write_atomically(folder / "images" / f"{view}{suffix}", encoded)
    write_poses(folder, view_ids, poses, pose_format)
    if joints is not None and arm is not None:
        write_joints(folder, view_ids, joints, arm)
    # Written last: an interrupted run leaves a folder that is not described, not half of one.
    write_validated(folder / OBJECT_VIEWS_FILE, description, OBJECT_VIEWS_SCHEMA)
    return folder
