"""Read cameras from the YAML files that `cv2.FileStorage` and ROS's camera_calibration write."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
import yaml

from ..cameras import AbstractLens, Camera, Fisheye, OpenCV4, OpenCV5, OpenCV8
from ..files import StrictYamlLoader, parse_yaml, read_text

if TYPE_CHECKING:
    from ..schemas.external_formats import OpenCVMatrix


def read_opencv_camera(path: str | Path) -> Camera:
    """Read the camera in a file of `cv2.FileStorage`: camera matrix, distortion, picture size.

    The camera_info files of ROS have the same entries, and the name of the lens model.

    Raises:
        ValueError: an entry is missing, or the number of coefficients fits no lens model.
    """
    from ..schemas.calibration import PINHOLE_SCHEMA
    from ..schemas.external_formats import OPENCV_CAMERA_SCHEMA
    from ..schemas.validation import validate_content

    content = validate_content(_read_opencv_yaml(Path(path)), OPENCV_CAMERA_SCHEMA, path)
    K = _array(content.camera_matrix, "camera_matrix", path)
    if K.shape != (3, 3) or K[1, 0] or K[0, 1] or K[2].tolist() != [0.0, 0.0, 1.0]:
        raise ValueError(
            f"{path}: camera_matrix: expected [fx 0 cx; 0 fy cy; 0 0 1], found {K.tolist()}"
        )
    # The same limits as in calibration.yaml: positive focal lengths, and a plausible centre.
    intrinsics = {"alpha_u": K[0, 0], "alpha_v": K[1, 1], "u0": K[0, 2], "v0": K[1, 2]}
    validate_content(
        {key: float(x) for key, x in intrinsics.items()}, PINHOLE_SCHEMA, f"{path}: camera_matrix"
    )
    coefficients = _array(content.distortion_coefficients, "distortion_coefficients", path).ravel()
    lens = opencv_lens(coefficients, content.distortion_model, str(path))
    return Camera(**intrinsics, lens=lens, image_size=(content.image_width, content.image_height))


def _array(matrix: "OpenCVMatrix", name: str, path: str | Path) -> np.ndarray:
    """Return a matrix of the file as an array; raise a ValueError if its size is wrong."""
    if matrix.rows * matrix.cols != len(matrix.data):
        raise ValueError(
            f"{path}: {name}: {matrix.rows} x {matrix.cols}, but {len(matrix.data)} numbers"
        )
    return np.array(matrix.data).reshape(matrix.rows, matrix.cols)


def opencv_lens(coefficients: np.ndarray, model: str | None, path: str) -> AbstractLens:
    """Return the lens model with this number of coefficients (4, 5 or 8), or the named fisheye.

    Raises:
        ValueError: no lens has so many coefficients; the message names the file.
    """
    k = [jnp.asarray(x) for x in coefficients]
    if model == "equidistant":
        # ROS's name of OpenCV's fisheye; its four coefficients differ from OpenCV4's.
        if len(k) != 4:
            raise ValueError(f"{path}: distortion_coefficients: expected 4, found {len(k)}")
        return Fisheye(k[0], k[1], k[2], k[3])
    if len(k) == 4:
        return OpenCV4(k[0], k[1], k[2], k[3])
    if len(k) == 5:
        return OpenCV5(k[0], k[1], k[2], k[3], k[4])
    if len(k) == 8:
        return OpenCV8(k[0], k[1], k[2], k[3], k[4], k[5], k[6], k[7])
    raise ValueError(f"{path}: distortion_coefficients: expected 4, 5 or 8, found {len(k)}")


class _OpenCVYamlLoader(StrictYamlLoader):
    """A plain YAML loader that also reads the tag `!!opencv-matrix`, as a mapping."""


def _construct_matrix(loader: StrictYamlLoader, node: yaml.Node) -> dict[Any, Any]:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.YAMLError("an opencv-matrix is a mapping")
    return loader.construct_mapping(node, deep=True)


_OpenCVYamlLoader.add_constructor("tag:yaml.org,2002:opencv-matrix", _construct_matrix)


def _read_opencv_yaml(path: Path) -> Any:
    # OpenCV's first line, %YAML:1.0, is not a valid YAML directive, which has a blank: %YAML 1.0.
    text = re.sub(r"\A%YAML:1\.0\s*", "", read_text(path))
    return parse_yaml(text, path, _OpenCVYamlLoader)
