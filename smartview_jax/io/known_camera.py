"""Read known cameras from files in any format that is supported."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import yaml

from .. import schemas
from ..calibration import Calibration
from ..cameras import AbstractLens, Camera, Fisheye, OpenCV4, OpenCV5, OpenCV8, Pinhole
from ..files import StrictYamlLoader, parse_yaml, read_text
from .visp import read_visp_camera


def read_camera(path: str | Path) -> Camera:
    """Read a camera from a calibration.yaml, or a file of OpenCV, ROS, Kalibr, mrcal or ViSP.

    Args:
        path: of the file; the format is recognised from its content.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: a wrong or missing entry, or a camchain with several cameras; the message names
            it and the file.
    """
    text = read_text(path)
    if text.lstrip().startswith("<"):
        return read_visp_camera(path)
    # The first entry of every calibration file, YAML or JSON.
    if "smartview_calibration" in text:
        return Calibration.load(path).camera
    if "LENSMODEL_" in text:
        return read_mrcal_camera(path)
    if _is_camchain(text):
        cameras = read_kalibr_cameras(path)
        if len(cameras) != 1:
            raise ValueError(f"{path}: expected one camera, found {', '.join(cameras)}")
        return next(iter(cameras.values()))
    return read_opencv_camera(path)


def read_cameras(path: str | Path, names: Sequence[str]) -> dict[str, Camera]:
    """Read known cameras of a rig, by name.

    Args:
        path: folder with one file for each known camera, called as the camera is, such as
            `left.yaml`, in any format of `read_camera`; or Kalibr's camchain of all cameras. The
            entries of a camchain that are not called as the cameras are, such as cam0 and cam1, are
            the cameras in their order.
        names: of the rig's cameras, in their order.

    Raises:
        FileNotFoundError: the path is missing.
        ValueError: no file for any camera, two for one, a file with another name while a camera
            has none, a camchain of another number of cameras, or a file that cannot be
            read; the message names it.
    """
    path = Path(path)
    if path.is_dir():
        present = sorted(path.iterdir())
        files = {name: [file for file in present if file.stem == name] for name in names}
        for name, candidates in files.items():
            if len(candidates) > 1:
                listed = ", ".join(file.name for file in candidates)
                raise ValueError(f"{path}: expected one file for camera {name!r}, found {listed}")
        if not any(files.values()):
            listed = ", ".join(file.name for file in present) or "nothing"
            raise ValueError(
                f"{path}: expected a file for a camera, such as {names[0]}.yaml; found {listed}"
            )
        if lacking := [name for name, candidates in files.items() if not candidates]:
            _refuse_misnamed([file for file in present if file.stem not in names], lacking)
        return {
            name: read_camera(candidates[0]) for name, candidates in files.items() if candidates
        }
    if not _is_camchain(read_text(path)):
        raise ValueError(
            f"{path}: expected a folder with a file for each camera, such as {names[0]}.yaml, or "
            "Kalibr's camchain.yaml"
        )
    cameras = read_kalibr_cameras(path)
    if set(cameras) <= set(names):
        return cameras
    # In their order only if no name is shared: cam1 of the file would become another camera.
    if len(cameras) != len(names) or set(cameras) & set(names):
        raise ValueError(
            f"{path}: expected {len(names)} cameras, for {', '.join(names)}; found "
            f"{', '.join(cameras)}"
        )
    return dict(zip(names, cameras.values(), strict=True))


def _refuse_misnamed(others: Sequence[Path], lacking: Sequence[str]) -> None:
    """Raise a ValueError for a camera's file among others that are not called as a camera is."""
    for file in others:
        try:
            read_camera(file)
        except (ValueError, OSError):
            # It is no camera's: a report, or where two arms are.
            continue
        raise ValueError(
            f"{file}: it has a camera, but no camera of the rig is called {file.stem!r}; call it "
            f"{' or '.join(f'{name}{file.suffix}' for name in lacking)}, or take it away"
        )


def _is_camchain(text: str) -> bool:
    """Return whether a text is a camchain of Kalibr, by its entries cam0, cam1, ..."""
    return re.search(r"^cam\d+:", text, re.MULTILINE) is not None


def read_kalibr_cameras(path: str | Path) -> dict[str, Camera]:
    """Read the cameras in a camchain of Kalibr, by name (`cam0`, `cam1`, ...).

    Kalibr's distortion models are OpenCV's: `radtan` has k1, k2, p1, p2, and `equidistant` is the
    fisheye with k1, k2, k3, k4. The transforms between the cameras, and to
    an IMU, are not read.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: a wrong or missing entry, or a model other than pinhole with radtan, equidistant
            or no distortion; the message names it and the file.
    """
    cameras = {}
    for name, entry in schemas.read_validated(path, schemas.KALIBR_CAMCHAIN_SCHEMA).items():
        model = entry.distortion_model
        lens = Pinhole() if model == "none" else _lens(entry.distortion_coeffs, model, path)
        cameras[name] = _camera(entry.intrinsics, lens, entry.resolution, f"{path}: {name}")
    return cameras


def read_opencv_camera(path: str | Path) -> Camera:
    """Read the camera in a file of `cv2.FileStorage`: camera matrix, distortion, picture size.

    The camera_info files of ROS have the same entries, and the name of the lens model. A printed
    message of camera_info (`rostopic echo`) is read, too, with its binning and region of interest.

    Raises:
        ValueError: an entry is missing, the number of coefficients fits no lens model, or the
            message is of a camera that was not calibrated.
    """
    # OpenCV's first line, %YAML:1.0, is not a valid YAML directive, which has a blank: %YAML 1.0.
    text = re.sub(r"\A%YAML:1\.0\s*", "", read_text(path))
    # `rostopic echo` ends each message with a line of dashes.
    read = parse_yaml(
        re.sub(r"^---\s*\Z", "", text, flags=re.MULTILINE), Path(path), _OpenCVYamlLoader
    )
    read = _of_message(read, path)
    content = schemas.validate_content(read, schemas.OPENCV_CAMERA_SCHEMA, path)
    K = _array(content.camera_matrix, "camera_matrix", path)
    if K.shape != (3, 3) or K[1, 0] or K[0, 1] or K[2].tolist() != [0.0, 0.0, 1.0]:
        raise ValueError(
            f"{path}: camera_matrix: expected [fx 0 cx; 0 fy cy; 0 0 1], found {K.tolist()}"
        )
    coefficients = _array(content.distortion_coefficients, "distortion_coefficients", path)
    lens = _lens(coefficients.ravel().tolist(), content.distortion_model, path)
    size = (content.image_width, content.image_height)
    return _camera((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), lens, size, f"{path}: camera_matrix")


def _of_message(read: Any, path: str | Path) -> Any:
    """Return a printed message of ROS's camera_info as a file of it would be, and others as read.

    K is of the whole sensor; pictures are cut out of it, then binned.
    """
    if not isinstance(read, dict) or not {"width", "height"} <= set(read):
        return read
    k, d = (read.get(name, read.get(name.upper())) for name in "kd")
    if k is None or d is None:
        return read
    message = schemas.validate_content(read | {"k": k, "d": d}, schemas.CAMERA_INFO_SCHEMA, path)
    matrix = np.array(message.k).reshape(3, 3)
    if not matrix[0, 0] > 0.0:
        raise ValueError(f"{path}: the camera was not calibrated: its focal length in K is 0")
    roi = message.roi
    size = np.array([roi.width or message.width, roi.height or message.height])
    binning = np.maximum([message.binning_x, message.binning_y], 1)
    # The centre of the first pixel is (0, 0), so that its corner stays where it is.
    matrix[:2, 2] += 0.5 - np.array([roi.x_offset, roi.y_offset])
    matrix[:2] /= binning[:, None]
    matrix[:2, 2] -= 0.5
    width, height = (size // binning).tolist()
    coefficients = message.d or [0.0] * (4 if message.distortion_model == "equidistant" else 5)
    return {
        "image_width": width,
        "image_height": height,
        "camera_matrix": {"rows": 3, "cols": 3, "data": matrix.ravel().tolist()},
        "distortion_model": message.distortion_model or None,
        "distortion_coefficients": {"rows": 1, "cols": len(coefficients), "data": coefficients},
    }


def read_mrcal_camera(path: str | Path) -> Camera:
    """Read the camera in a cameramodel file of mrcal.

    Its content is a Python literal, which is YAML as well, apart from bytes. It is read as YAML,
    whose reader refuses repeated keys and deep nesting.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: a wrong or missing entry, or a lens that is not OpenCV's, which
            `mrcal-convert-lensmodel` converts; the message names it and the file.
    """
    # The data of the calibration, as bytes in base 85, are the only part that is not YAML.
    text = re.sub(r"'optimization_inputs':\s*b'[^']*',?", "", read_text(path))
    read = parse_yaml(text, Path(path))
    content = schemas.validate_content(read, schemas.MRCAL_CAMERA_SCHEMA, path)
    pinhole, coefficients = content.intrinsics[:4], content.intrinsics[4:]
    lens = _lens(coefficients, None, path) if coefficients else Pinhole()
    return _camera(pinhole, lens, content.imagersize, f"{path}: intrinsics")


def _array(matrix: "schemas.OpenCVMatrix", name: str, path: str | Path) -> np.ndarray:
    """Return a matrix of the file as an array; raise a ValueError if its size is wrong."""
    if matrix.rows * matrix.cols != len(matrix.data):
        raise ValueError(
            f"{path}: {name}: {matrix.rows} x {matrix.cols}, but {len(matrix.data)} numbers"
        )
    return np.array(matrix.data).reshape(matrix.rows, matrix.cols)


def _lens(coefficients: Sequence[float], model: str | None, path: str | Path) -> AbstractLens:
    """Return the lens model with this number of coefficients (4, 5 or 8), or the named fisheye."""
    # `equidistant` is ROS's name of OpenCV's fisheye; its four coefficients differ from OpenCV4's.
    fisheye, count = model == "equidistant", len(coefficients)
    kinds = {4: Fisheye} if fisheye else {4: OpenCV4, 5: OpenCV5, 8: OpenCV8}
    if count not in kinds:
        expected = "4" if fisheye else "4, 5 or 8"
        raise ValueError(f"{path}: distortion_coefficients: expected {expected}, found {count}")
    return kinds[count](*map(jnp.asarray, coefficients))


def _camera(
    intrinsics: Sequence[float], lens: AbstractLens, size: Sequence[int], source: str
) -> Camera:
    """Return a camera of alpha_u, alpha_v, u0, v0, within the limits of calibration.yaml."""
    names = ("alpha_u", "alpha_v", "u0", "v0")
    numbers = {name: float(x) for name, x in zip(names, intrinsics, strict=True)}
    schemas.validate_content(numbers, schemas.PINHOLE_SCHEMA, source)
    return Camera(**numbers, lens=lens, image_size=(size[0], size[1]))


class _OpenCVYamlLoader(StrictYamlLoader):
    """A plain YAML loader that also reads the tag `!!opencv-matrix`, as a mapping."""


def _construct_matrix(loader: StrictYamlLoader, node: yaml.Node) -> dict[Any, Any]:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.YAMLError("an opencv-matrix is a mapping")
    return loader.construct_mapping(node, deep=True)


_OpenCVYamlLoader.add_constructor("tag:yaml.org,2002:opencv-matrix", _construct_matrix)
