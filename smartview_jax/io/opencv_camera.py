"""Cameras in the YAML that `cv2.FileStorage` writes."""

import re
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import yaml

from ..cameras import AbstractLens, Camera, OpenCV4, OpenCV5, OpenCV8


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
