"""Poses and cameras as other programs write them.

They hold a part of a data set only; what is read here goes into `Dataset.from_arrays`, or into
`fit_staged(camera=...)`.
"""

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import yaml
from jaxlie import SE3

from ..cameras import AbstractLens, Camera, OpenCV4, OpenCV5, OpenCV8, Pinhole
from ..files import read_yaml
from ..geometry import pose_codec


def read_matrix_rows(path: str | Path, length_unit: str) -> SE3:
    """Poses from a text file with one 4x4 matrix, row by row, on every line.

    Args:
        path: of the file; numbers are parted by blanks, tabs or commas.
        length_unit: of the translations: m, cm or mm.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: a line that is not a rigid transform, named by its number from 1.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    lines = path.read_text(encoding="utf-8").splitlines()
    rows, names = [], []
    for number, line in enumerate(lines, start=1):
        fields = re.split(r"[\s,;]+", line.split("#")[0].strip())
        if fields == [""]:
            continue
        try:
            rows.append([float(field) for field in fields])
        except ValueError:
            raise ValueError(f"{path}: line {number} is not a row of numbers") from None
        if len(rows[-1]) != 16:
            raise ValueError(f"{path}: line {number} has {len(rows[-1])} numbers, not 16")
        names.append(str(number))
    if not rows:
        raise ValueError(f"{path}: no poses")
    try:
        return pose_codec("matrix").decode(np.array(rows), length_unit, labels=names)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def read_visp_pose(path: str | Path) -> SE3:
    """ViSP's pose vector: translation (m) and theta-u (rad), a 6 x 1 matrix in YAML."""
    data = read_yaml(path).get("data")
    try:
        numbers = np.array(data, dtype=float).reshape(1, 6)
    except (TypeError, ValueError):
        raise ValueError(f"{path}: data: expected 6 numbers, found {data!r}") from None
    pose = pose_codec("rotation_vector").decode(numbers, labels=[str(path)])
    return SE3(pose.wxyz_xyz[0])


def read_visp_camera(path: str | Path) -> Camera:
    """The model without distortion of a ViSP camera file.

    Raises:
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


def read_opencv_camera(path: str | Path) -> Camera:
    """The camera in a file of `cv2.FileStorage`: camera matrix, distortion, picture size.

    Raises:
        ValueError: an entry is missing, or there are coefficients of no known model.
    """
    content = _read_opencv_yaml(Path(path))
    missing = [
        key
        for key in ("camera_matrix", "distortion_coefficients", "image_width", "image_height")
        if key not in content
    ]
    if missing:
        raise ValueError(f"{path}: entry {', '.join(missing)} is missing")
    K = content["camera_matrix"]
    lens = _opencv_lens(content["distortion_coefficients"].ravel(), str(path))
    size = (int(content["image_width"]), int(content["image_height"]))
    return Camera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], lens, size)


def _opencv_lens(numbers: np.ndarray, path: str) -> AbstractLens:
    k = [jnp.asarray(x) for x in numbers]
    if len(k) == 4:
        return OpenCV4(k[0], k[1], k[2], k[3])
    if len(k) == 5:
        return OpenCV5(k[0], k[1], k[2], k[3], k[4])
    if len(k) == 8:
        return OpenCV8(k[0], k[1], k[2], k[3], k[4], k[5], k[6], k[7])
    raise ValueError(f"{path}: distortion_coefficients: expected 4, 5 or 8, found {len(k)}")


class _OpenCVLoader(yaml.SafeLoader):
    """The safe loader, which also knows OpenCV's matrices and nothing else."""


def _matrix(loader: yaml.SafeLoader, node: yaml.Node) -> np.ndarray:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.YAMLError("an opencv-matrix is a mapping")
    entry = loader.construct_mapping(node, deep=True)
    return np.array(entry["data"], dtype=float).reshape(entry["rows"], entry["cols"])


_OpenCVLoader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def _read_opencv_yaml(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    # OpenCV's first line, %YAML:1.0, is not YAML.
    text = re.sub(r"\A%YAML:1\.0\s*", "", path.read_text(encoding="utf-8"))
    try:
        content = yaml.load(text, Loader=_OpenCVLoader)
    except (yaml.YAMLError, KeyError, ValueError) as error:
        raise ValueError(f"{path}: not readable as OpenCV YAML: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a mapping, found {type(content).__name__}")
    return content
