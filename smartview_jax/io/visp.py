"""Read files of ViSP: poses as `theta u` vectors in YAML, numbered pictures, cameras in XML."""

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Unpack

import jax
import numpy as np
from jaxlie import SE3

from .. import schemas
from ..argument_checks import errors_at
from ..cameras import Camera, Pinhole
from ..dataset import Dataset
from ..files import parse_yaml, read_text, write_atomically
from ..geometry import pose_codec
from ..targets import AbstractTarget
from .folder_pictures import ImportOptions, LoadOptions, numbered_pictures
from .picture_detections import ShownTarget
from .pictures import dataset_from_pictures


def import_visp(
    folder: str | Path,
    target: AbstractTarget,
    mount: str = "eye_in_hand",
    poses: str = "pose_rPe_{view}.yaml",
    pictures: str = "image-{view}.png",
    **options: Unpack[ImportOptions],
) -> Dataset:
    """Import a data set from a folder of ViSP's hand-eye calibration.

    Args:
        folder: folder with a pose file (base_from_tool, m and rad) and a picture for each view.
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        poses, pictures: patterns of the file names; `{view}` is the number that pairs them.
        options: `bad_views`, `progress` and `detection_limits`, as in `load_dataset`.

    Raises:
        FileNotFoundError: there are no pose files, or a picture is missing.
        ValueError: a file that is not a pose, or a picture without a pose.
    """
    folder = Path(folder)
    pose_pattern = re.compile(re.escape(poses).replace(re.escape("{view}"), r"(\d+)"))
    pose_paths = {
        int(match[1]): path
        for path in folder.glob(poses.replace("{view}", "*"))
        if (match := pose_pattern.fullmatch(path.name))
    }
    if not pose_paths:
        raise FileNotFoundError(f"{folder / poses}: no such files")
    # Sorted as numbers, not as text: view 2 before view 10.
    numbers = sorted(pose_paths)
    files = numbered_pictures(folder, pictures, numbers, folder / poses)
    rows = np.stack([read_visp_pose(pose_paths[number]).wxyz_xyz for number in numbers])
    return dataset_from_pictures(
        files,
        SE3(jax.device_put(rows)),
        ShownTarget(target, mount),
        options=LoadOptions(**options),
    )


def read_visp_pose(path: str | Path) -> SE3:
    """Read ViSP's pose vector: translation (m) and theta-u (rad), a 6 x 1 matrix in YAML.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: it does not hold six numbers, or angles that cannot be in rad.
    """
    data = schemas.read_validated(path, schemas.VISP_POSE_SCHEMA).data
    numbers = np.array([row[0] if isinstance(row, list) else row for row in data])
    with errors_at(path):
        return pose_codec("rotation_vector").decode(numbers, labels=["0"])


def write_visp_pose(path: str | Path, pose: SE3) -> None:
    """Write a pose as the vector of ViSP that `read_visp_pose` reads.

    Raises:
        ValueError: a value with which the file could not be read back.
    """
    row = pose_codec("rotation_vector").encode(pose)
    data = [[float(number)] for number in row]
    schemas.refuse_unreadable({"rows": 6, "cols": 1, "data": data}, schemas.VISP_POSE_SCHEMA, path)
    lines = [f"  - {number!r}" for number in data]
    write_atomically(path, "\n".join(["rows: 6", "cols: 1", "data:", *lines]) + "\n")


def read_visp_camera(path: str | Path) -> Camera:
    """Read the model without distortion of a ViSP camera file.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: an entry is missing, or the file declares entities, which are not expanded.
    """
    path, text = Path(path), read_text(path)
    # Nested entities can expand a small file to one that fills the memory.
    if "<!ENTITY" in text:
        raise ValueError(f"{path}: entity declarations are not accepted")
    try:
        camera = ElementTree.fromstring(text).find("camera")
    except (ElementTree.ParseError, ValueError) as error:
        raise ValueError(f"{path}: not readable as XML: {error}") from error
    values = {}
    for name in schemas.VispCameraEntry.model_fields:
        entry = None if camera is None else camera.find(f".//{name}")
        if entry is not None and entry.text is not None:
            # XML values are text; they are read as YAML, so that numbers have one syntax in all
            # files.
            values[name] = parse_yaml(entry.text, f"{path}: entry {name}")
    camera_entry = schemas.validate_content(values, schemas.VISP_CAMERA_SCHEMA, path)
    size = (camera_entry.image_width, camera_entry.image_height)
    return Camera(
        camera_entry.px, camera_entry.py, camera_entry.u0, camera_entry.v0, Pinhole(), size
    )
