"""ViSP: poses as `theta u` vectors in YAML, numbered pictures, cameras in XML."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3

from ..cameras import Camera, Pinhole
from ..dataset import Dataset
from ..files import read_yaml, write_atomically
from ..geometry import pose_codec
from ..targets import AbstractTarget
from .pictures import from_pictures, numbered_pictures


def import_visp(
    folder: str | Path,
    target: AbstractTarget,
    mount: str = "eye_in_hand",
    poses: str = "pose_rPe_{view}.yaml",
    pictures: str = "image-{view}.png",
    bad_views: str = "raise",
    progress: Callable[[str], None] | None = None,
) -> Dataset:
    """A data set from a folder of ViSP's hand-eye calibration.

    Args:
        folder: with a pose file (base_from_tool, m and rad) and a picture for each view.
        target: what the pictures show.
        mount: where the camera is.
        poses, pictures: names of the files; `{view}` is the number that pairs them.
        bad_views: as in `load_dataset`.
        progress: told what is being done.

    Raises:
        FileNotFoundError: there are no pose files, or a picture is missing.
        ValueError: a file that is no pose, or a picture without one.
    """
    folder = Path(folder)
    name = re.compile(re.escape(poses).replace(re.escape("{view}"), r"(\d+)"))
    found = {
        int(match[1]): path
        for path in folder.glob(poses.replace("{view}", "*"))
        if (match := name.fullmatch(path.name))
    }
    if not found:
        raise FileNotFoundError(f"{folder / poses}: no such files")
    numbers = sorted(found)
    files = numbered_pictures(folder, pictures, numbers, folder / poses)
    rows = jnp.stack([read_visp_pose(found[number]).wxyz_xyz for number in numbers])
    return from_pictures(files, SE3(rows), target, mount, bad_views=bad_views, progress=progress)


def read_visp_pose(path: str | Path) -> SE3:
    """ViSP's pose vector: translation (m) and theta-u (rad), a 6 x 1 matrix in YAML.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: it does not hold six numbers.
    """
    data = read_yaml(path).get("data")
    try:
        numbers = np.array(data, dtype=float).reshape(1, 6)
    except (TypeError, ValueError):
        raise ValueError(f"{path}: data: expected 6 numbers, found {data!r}") from None
    pose = pose_codec("rotation_vector").decode(numbers, labels=[str(path)])
    return SE3(pose.wxyz_xyz[0])


def write_visp_pose(path: str | Path, pose: SE3) -> None:
    """The inverse of `read_visp_pose`."""
    row = pose_codec("rotation_vector").encode(SE3(pose.wxyz_xyz[None]))[0]
    lines = [f"  - [{float(number)!r}]" for number in row]
    write_atomically(path, "\n".join(["rows: 6", "cols: 1", "data:", *lines]) + "\n")


def read_visp_camera(path: str | Path) -> Camera:
    """The model without distortion of a ViSP camera file.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: an entry is missing, or the file declares entities, which are not expanded.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    text = path.read_text(encoding="utf-8")
    if "<!ENTITY" in text:
        raise ValueError(f"{path}: entity declarations are not accepted")
    try:
        camera = ElementTree.fromstring(text).find("camera")
    except ElementTree.ParseError as error:
        raise ValueError(f"{path}: not readable as XML: {error}") from error

    def number(name: str) -> float:
        entry = None if camera is None else camera.find(f".//{name}")
        if entry is None or entry.text is None:
            raise ValueError(f"{path}: entry {name!r} is missing")
        return float(entry.text)

    size = (int(number("image_width")), int(number("image_height")))
    return Camera(number("px"), number("py"), number("u0"), number("v0"), Pinhole(), size)
