"""Read the description of a data-set folder, `dataset.yaml`, apart from its tables and pictures."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from jaxlie import SE3

from ..files import read_yaml
from ..targets import AbstractTarget
from .detections import DETECTIONS_FILE
from .rough_pose import rough_pose
from .target_file import read_target

if TYPE_CHECKING:
    from ..schemas.dataset import DatasetFile

FORMAT_VERSION = 1
"""Version of the format of `dataset.yaml`."""

DESCRIPTION_FILE = "dataset.yaml"
"""The name of the file that describes the folder."""


class FolderDescription(NamedTuple):
    """The description of one camera and its target; its pictures may not have been taken yet.

    Attributes:
        target: the target in its pictures.
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
    from ..schemas.dataset import DATASET_SCHEMA
    from ..schemas.validation import validate_content

    folder = Path(folder)
    path = folder / DESCRIPTION_FILE
    content = read_yaml(path)
    description = validate_content(content, DATASET_SCHEMA, path)
    if description.mount == "hand_to_hand":
        raise ValueError(f"{path}: mount: expected one arm, found hand_to_hand, views of two arms")
    if description.camera is None:
        form = "tracked_poses" if description.target is None else "measured_points"
        raise ValueError(f"{path}: {form}: expected a data set with pictures of a target")
    return described_camera(folder, content, description, path)


def described_camera(
    folder: Path, content: Mapping[str, Any], description: "DatasetFile", path: Path
) -> FolderDescription:
    """Return the description of the camera of a folder with pictures.

    Args:
        folder: of the data set.
        content: content of its description.
        description: the same, validated.
        path: path of the description, for error messages.

    Raises:
        ValueError: a wrong target or rough pose; the message names the file.
    """
    assert description.camera is not None
    width, height = description.camera.image_size
    try:
        target = read_target(folder, content["target"])
        pose = rough_pose(description)
    except ValueError as error:
        # Both read parts of the file and do not know its name.
        raise ValueError(f"{path}: {error}") from error
    # Pictures of a target on another hand are read as by a camera on a hand.
    mount = "eye_in_hand" if description.mount == "hand_to_hand" else description.mount
    return FolderDescription(
        target,
        mount,
        (width, height),
        pose,
        folder / DETECTIONS_FILE,
        None if description.detections is None else description.detections.rows,
    )


def is_rig_description(content: Mapping[str, Any]) -> bool:
    """Return whether the content of a `dataset.yaml` has several cameras."""
    return content.get("cameras") is not None


def without_nulls(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return a description without the entries that are null, which count as absent."""
    return {key: value for key, value in content.items() if value is not None}


def marked_entries(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a description with the version of its format and the mark of its end.

    The mark at the beginning declares the one on the last line, so that a truncated file is an
    error.
    """
    from ..schemas.dataset import END_MARK

    return {"smartview_dataset": FORMAT_VERSION, "end_mark": True, **entries, "end": END_MARK}
