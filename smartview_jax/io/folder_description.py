"""Read the description of a data-set folder, `dataset.yaml`, apart from its tables and pictures.

The target is in the description, or in the file of Kalibr that it names. Kalibr's `target.yaml` has
`target_type: 'aprilgrid'`, `tagCols`, `tagRows`, `tagSize` in m, and `tagSpacing`, the gap between
two tags relative to the tag's side.

The target's approximate pose, for a pattern that looks the same when rotated, is written by hand:

    base_from_world: {translation: [0.45, -0.1, 0.05], yaw_pitch_roll_deg: [90, 0, 180]}

or with a `quaternion_wxyz` as in `calibration.yaml`. On a command line it is six numbers separated
by commas: x, y, z in metres, yaw, pitch, roll in degrees.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxlie import SE3

from .. import schemas
from ..argument_checks import errors_at
from ..files import read_yaml
from ..geometry import pose_codec, transform_from_dict
from ..targets import AbstractTarget, AprilGrid, target_from_dict
from .detections import DETECTIONS_FILE

FORMAT_VERSION = 1
"""Version of the format of `dataset.yaml`."""

DESCRIPTION_FILE = "dataset.yaml"
"""The name of the file that describes the folder."""


class DescribedFolder(NamedTuple):
    """A folder with the entries of its description, which readers of its parts take."""

    folder: Path
    content: dict[str, Any]
    path: Path

    @classmethod
    def of(cls, folder: str | os.PathLike[str], file: str = DESCRIPTION_FILE) -> "DescribedFolder":
        """Read the description of a folder, which is not validated yet."""
        path = Path(folder) / file
        if path.parent.is_file():
            raise FileNotFoundError(f"{folder}: is a file, expected the folder of a data set")
        if not path.exists():
            hint = "; smartview new begins a data set" if file == DESCRIPTION_FILE else ""
            raise FileNotFoundError(f"{path}: no such file{hint}")
        return cls(path.parent, read_yaml(path), path)

    def validated(
        self, schema: "schemas.Schema[schemas.Content]"
    ) -> "tuple[DescribedFolder, schemas.Content]":
        """Return the folder without entries that are null, and its description as its type."""
        description = schemas.validate_content(self.content, schema, self.path)
        content = {key: value for key, value in self.content.items() if value is not None}
        return self._replace(content=content), description

    def of_one_camera(self, otherwise: str = "") -> "tuple[DescribedFolder, schemas.DatasetFile]":
        """Return folder and description if it has one camera; `otherwise` ends the error's text."""
        if self.is_rig:
            raise ValueError(
                f"{self.path}: cameras: expected a folder with one camera, found several{otherwise}"
            )
        return self.validated(schemas.DATASET_SCHEMA)

    @property
    def is_rig(self) -> bool:
        """Whether it has several cameras."""
        return self.content.get("cameras") is not None

    @property
    def view_table(self) -> Path:
        """The table that has a row for each view: of poses, joint readings or times."""
        if "poses" not in self.content:
            return self.folder / self.content["joints"]["file"]
        poses = self.content["poses"]
        return self.folder / (poses.get("picture_times") or poses["file"])


class FolderDescription(NamedTuple):
    """The description of one camera and its target; its pictures may not have been taken yet.

    Attributes:
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        image_size: width and height of its pictures, px.
        holder_from_world: approximate pose of the target; None if it is not known.
        detections: path of the table of detected points.
        detection_rows: stated number of rows of this table; None if it is not stated.
    """

    target: AbstractTarget
    mount: str
    image_size: tuple[int, int]
    holder_from_world: SE3 | None
    detections: Path
    detection_rows: int | None


def read_folder_description(folder: str | Path) -> FolderDescription:
    """Read target, mount and picture size from a folder that `smartview new` began.

    Raises:
        FileNotFoundError: the folder has no `dataset.yaml`.
        ValueError: a wrong entry; the message names it and the file.
    """
    described, description = DescribedFolder.of(folder).of_one_camera()
    path = described.path
    if description.mount == "hand_to_hand":
        raise ValueError(f"{path}: mount: expected one arm, found hand_to_hand, views of two arms")
    if description.camera is None:
        form = "tracked_poses" if description.target is None else "measured_points"
        raise ValueError(f"{path}: {form}: expected a data set with pictures of a target")
    return described_camera(described, description)


def described_camera(
    described: DescribedFolder, description: "schemas.DatasetFile"
) -> FolderDescription:
    """Return the description of the camera of a folder with pictures."""
    assert description.camera is not None
    width, height = description.camera.image_size
    with errors_at(described.path):
        target = read_target(described.folder, described.content["target"])
        pose = rough_pose(description.base_from_world or description.tool_from_world)
    # Pictures of a target on another hand are read as by a camera on a hand.
    mount = "eye_in_hand" if description.mount == "hand_to_hand" else description.mount
    return FolderDescription(
        target,
        mount,
        (width, height),
        pose,
        described.folder / DETECTIONS_FILE,
        None if description.detections is None else description.detections.rows,
    )


def marked_entries(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a description with the version of its format and the mark of its end.

    The mark at the beginning declares the one on the last line, so that a truncated file is an
    error.
    """
    mark = {"end": "smartview_dataset"}
    return {"smartview_dataset": FORMAT_VERSION, "end_mark": True, **entries, **mark}


def read_target(folder: Path, content: dict[str, Any]) -> AbstractTarget:
    """Return the target of a data set.

    Args:
        folder: folder of the data set, to which a file name is relative.
        content: the entry `target`, as `schemas.target` defines it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a wrong entry; the message names it, and the file if it is in Kalibr's file.
    """
    if content.get("kind") != "aprilgrid" or content.get("file") is None:
        return target_from_dict({key: value for key, value in content.items() if value is not None})
    grid = read_april_grid(folder / content["file"])
    numbers = {name: getattr(grid, name) for name in ("rows", "columns", "size", "spacing")}
    given = {key: value for key, value in content.items() if key != "file" and value is not None}
    return target_from_dict({**given, **numbers})


def read_april_grid(path: str | Path) -> AprilGrid:
    """Read the `target.yaml` of Kalibr for an AprilGrid.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a different kind of target, or a missing or wrong entry.
    """
    content = read_yaml(path)
    kind = content.get("target_type")
    if kind != "aprilgrid":
        raise ValueError(f"{path}: target_type: expected 'aprilgrid', found {kind!r}")
    grid = schemas.validate_content(content, schemas.KALIBR_TARGET_SCHEMA, path)
    with errors_at(path):
        return AprilGrid(grid.tagRows, grid.tagCols, grid.tagSize, grid.tagSpacing)


def rough_pose(entry: "schemas.RoughPose | None") -> SE3 | None:
    """Return the approximate pose that an entry describes, or None without one."""
    if entry is None:
        return None
    content = entry.model_dump()
    if "quaternion_wxyz" in content:
        return transform_from_dict("the target's rough pose", content)
    return _decode_pose(
        "the target's rough pose", [*content["translation"], *content["yaw_pitch_roll_deg"]]
    )


def parse_rough_pose(option: str, text: str) -> SE3:
    """Read an approximate pose from six numbers separated by commas.

    Args:
        option: name of the command-line option, for the error message.
        text: the text given: x, y, z (m), yaw, pitch, roll (degrees).

    Raises:
        ValueError: not six finite numbers.
    """
    try:
        return _decode_pose(option, [float(word) for word in text.split(",")])
    except ValueError as error:
        raise ValueError(
            f"{option}: expected six numbers between commas, x,y,z (m),yaw,pitch,roll (degrees), "
            f"found {text!r}"
        ) from error


def _decode_pose(name: str, numbers: list[float]) -> SE3:
    """Return the pose of x, y, z (m), yaw, pitch, roll (degrees); an error begins with the name."""
    row = np.array(numbers, dtype=float)
    if row.shape != (6,) or not np.isfinite(row).all():
        raise ValueError(f"{name}: expected six finite numbers, found {numbers}")
    return pose_codec("yaw_pitch_roll").decode(row, angle_unit="deg", labels=[name])
