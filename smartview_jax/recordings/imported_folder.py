"""Write what all imported data-set folders have: the description, and the record of the import."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from .. import schemas
from ..argument_checks import errors_at
from ..files import dump_yaml, parse_yaml, read_yaml, write_atomically
from ..io import DESCRIPTION_FILE, TARGETS, marked_entries, read_april_grid, read_target
from ..targets import AbstractTarget, target_to_dict
from .camera_names import ONE_CAMERA
from .picture_messages import PictureFile

RECORD_FILE = "import.yaml"
"""The name of the file that says what was taken from where."""

POSE_FORMAT = "quaternion_xyzw"
"""Pose format of the tables, as in ROS."""


class TargetText(NamedTuple):
    """The entry `target` of a description.

    Attributes:
        text: in YAML.
        is_template: whether the lengths are only examples, to be replaced by measured ones.
    """

    text: str
    is_template: bool


class ImportedFolder(NamedTuple):
    """The result of an import.

    Attributes:
        left_out: number of pictures that are no views, by reason.
        notes: sentences on what was used and found.
        camera_file: the file of the known camera, or the folder with the files of several known
            cameras; None if the bag has none.
        in_motion: whether the robot's poses are a log, from which each view's is interpolated.
        target_is_template: whether the target's lengths are examples, still to be measured.
    """

    folder: Path
    view_ids: tuple[str, ...]
    left_out: dict[str, int]
    notes: tuple[str, ...]
    camera_file: Path | None
    in_motion: bool
    target_is_template: bool

    def write_record(self, recording: str, stamps: Mapping[str, Any]) -> None:
        """Write the sources that were used, and the pictures that were left out, to the folder.

        Args:
            recording: name of the bag or of the data set.
            stamps: time of every view, ns, by its name; of several cameras by the camera's name.
        """
        content = {
            "recording": recording,
            "notes": list(self.notes),
            "left_out": self.left_out,
            "stamps_ns": dict(stamps),
        }
        write_atomically(self.folder / RECORD_FILE, dump_yaml(content))


def view_names(count: int) -> tuple[str, ...]:
    """Return the names of so many views: 0001, 0002, ..."""
    digits = max(4, len(str(count)))
    return tuple(f"{1 + k:0{digits}d}" for k in range(count))


def picture_entries(
    recording: Path, first: Mapping[str, PictureFile], notes: list[str]
) -> dict[str, Any]:
    """Return the entries of a description that describe the pictures, and add to the notes.

    Args:
        recording: the bag or data set, for errors.
        first: the first picture of each camera, by its name, in the order of the description.
        notes: sentences on what was found.

    Raises:
        ValueError: the pictures of the cameras have different formats.
    """
    suffixes = {picture.suffix for picture in first.values()}
    if len(suffixes) > 1:
        listed = ", ".join(f"{name} {picture.suffix}" for name, picture in first.items())
        raise ValueError(
            f"{recording}: image: expected the pictures of all cameras in one format; "
            f"found {listed}: import each camera into a folder of its own"
        )
    for name, picture in first.items():
        if picture.bits > 8:
            of_camera = f" of {name}" if name else ""
            notes.append(
                f"pictures{of_camera}: {picture.bits} bits, kept; detection stretches them to 8"
            )
    sizes = {name: {"image_size": list(picture.size)} for name, picture in first.items()}
    suffix = suffixes.pop()
    if ONE_CAMERA in first:
        return {"camera": sizes[ONE_CAMERA], "pictures": {"pattern": f"images/{{view}}{suffix}"}}
    return {"cameras": sizes, "pictures": {"pattern": f"images/{{camera}}/{{view}}{suffix}"}}


def write_description(folder: Path, entries: Mapping[str, Any], target: TargetText | None) -> None:
    """Write the description, with comments in the target's entry if it is to be filled in."""
    path = folder / DESCRIPTION_FILE
    *lines, end_mark = dump_yaml(marked_entries(entries)).splitlines(keepends=True)
    text = "".join([*lines, "" if target is None else target.text, end_mark])
    schema = schemas.RIG_SCHEMA if "cameras" in entries else schemas.DATASET_SCHEMA
    schemas.refuse_unreadable(parse_yaml(text, path), schema, path)
    write_atomically(path, text)


def target_text(target: AbstractTarget | str | Path) -> TargetText:
    """Return the entry for a target, for a kind such as `"charuco"`, or for the target in a file.

    Files are a `dataset.yaml`, or only its entry `target`, and the `target.yaml` of Kalibr.
    """
    if isinstance(target, AbstractTarget):
        return _text_of(target)
    if str(target) in TARGETS:
        return TargetText(f"{TARGETS[str(target)]}\n", True)
    path = Path(target)
    if not path.is_file():
        raise FileNotFoundError(
            f"target: expected one of {', '.join(TARGETS)}, or a file such as dataset.yaml; there "
            f"is no file {path}"
        )
    content = read_yaml(path)
    if "target_type" in content:
        return _text_of(read_april_grid(path))
    entry = content.get("target", content if "kind" in content else None)
    if not isinstance(entry, dict):
        raise ValueError(f"{path}: expected an entry target")
    with errors_at(path):
        return _text_of(read_target(path.parent, entry))


def _text_of(target: AbstractTarget) -> TargetText:
    return TargetText(dump_yaml({"target": target_to_dict(target)}), False)
