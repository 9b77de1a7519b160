"""Export a calibration for other programs: ROS, URDF, OpenCV.

Each function returns the text of a file. The camera frame is the optical frame (z forward, x to the
right), as image processing expects; `optical=False` gives the body frame of ROS's REP 103
(x forward, z up), for programs that add the optical joint themselves.
"""

import re
import shlex
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3

from ..argument_checks import require_readable
from ..calibration import Calibration
from ..cameras import AbstractOpenCVLens, Camera, Fisheye, OpenCV8, Pinhole
from ..files import dump_yaml
from ..schemas.messages import shortened_repr

_FRAME_NAME_PATTERN = re.compile(r"[A-Za-z0-9_/~][A-Za-z0-9_/~.-]{0,199}")


class OpenCVDistortion(NamedTuple):
    """A lens as one of OpenCV's distortion models.

    Attributes:
        model: ROS's name: `plumb_bob`, `rational_polynomial` or `equidistant`.
        coefficients: distortion coefficients in OpenCV's order.
        max_deviation: largest distance to the fitted lens over the picture, px; 0 if OpenCV has
            the same model.
    """

    model: str
    coefficients: tuple[float, ...]
    max_deviation: float


def opencv_coefficients(camera: Camera) -> OpenCVDistortion:
    """Return the lens as an OpenCV model: the same model, or the nearest k1, k2, p1, p2, k3.

    The lens models of the paper and of Weng map distorted to undistorted coordinates, the opposite
    of OpenCV's. Their inverse is not a polynomial, so the nearest polynomial is fitted over the
    picture, and its largest error is returned with it.
    """
    lens = camera.lens
    if isinstance(lens, Fisheye):
        return OpenCVDistortion("equidistant", tuple(float(k) for k in vars(lens).values()), 0.0)
    if isinstance(lens, OpenCV8):
        return OpenCVDistortion("rational_polynomial", _floats(lens.coefficients), 0.0)
    if isinstance(lens, AbstractOpenCVLens):
        return OpenCVDistortion("plumb_bob", _floats(lens.coefficients[:5]), 0.0)
    if isinstance(lens, Pinhole):
        return OpenCVDistortion("plumb_bob", (0.0,) * 5, 0.0)
    return _nearest_plumb_bob(camera)


def _floats(values: object) -> tuple[float, ...]:
    return tuple(float(value) for value in np.asarray(values))


def _nearest_plumb_bob(camera: Camera) -> OpenCVDistortion:
    """Fit OpenCV's five-coefficient lens to the camera by linear least squares over the picture."""
    width, height = camera.image_size
    u, v = np.meshgrid(np.linspace(0, width - 1, 41), np.linspace(0, height - 1, 31))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays, valid = camera.unproject(jnp.asarray(pixels))
    rays, pixels = np.asarray(rays)[np.asarray(valid)], pixels[np.asarray(valid)]
    focal = np.array([float(camera.alpha_u), float(camera.alpha_v)])
    distorted = (pixels - [float(camera.u0), float(camera.v0)]) / focal
    x, y = (rays[:, :2] / rays[:, 2:]).T
    s = x * x + y * y
    # With s = x^2 + y^2 of the undistorted point (x, y), OpenCV's model is
    #   x' = x (1 + k1 s + k2 s^2 + k3 s^3) + 2 p1 x y + p2 (s + 2 x^2)
    #   y' = y (1 + k1 s + k2 s^2 + k3 s^3) + p1 (s + 2 y^2) + 2 p2 x y
    # It is linear in (k1, k2, p1, p2, k3), the order of the columns of `monomials`, so that one
    # linear least-squares solution of monomials @ coefficients = (x' - x, y' - y) fits them.
    monomials = np.stack(
        [
            np.stack([x * s, x * s**2, 2 * x * y, s + 2 * x * x, x * s**3], axis=1),
            np.stack([y * s, y * s**2, s + 2 * y * y, 2 * x * y, y * s**3], axis=1),
        ]
    )
    distortion = distorted.T - np.stack([x, y])
    # Scaled by the focal length the least-squares residual is in pixels.
    design_matrix = (monomials * focal[:, None, None]).reshape(-1, 5)
    coefficients = np.linalg.lstsq(design_matrix, (distortion * focal[:, None]).ravel())[0]
    residuals = (monomials @ coefficients - distortion) * focal[:, None]
    max_deviation = float(np.hypot(*residuals).max())
    return OpenCVDistortion("plumb_bob", _floats(coefficients), max_deviation)


def mount_from_camera(calibration: Calibration, optical: bool = True) -> SE3:
    """Return the pose of the camera in the frame of its mount (the tool, or the base)."""
    pose = calibration.camera_from_mount.inverse()
    if optical:
        return pose
    # optical_from_link maps body axes to optical axes: x forward becomes z, y left becomes -x,
    # z up becomes -y.
    optical_from_link = SO3(jnp.array([0.5, 0.5, -0.5, 0.5]))
    return pose @ SE3.from_rotation(optical_from_link)


def ros_static_transform(
    calibration: Calibration, parent: str, child: str, optical: bool = True
) -> str:
    """Return the command `ros2 run tf2_ros static_transform_publisher ...` for the camera's pose.

    Raises:
        ValueError: a frame's name that ROS does not accept. A shell runs the line, so names are
            checked and quoted.
    """
    parent, child = _quoted_frame_name(parent), _quoted_frame_name(child)
    pose = mount_from_camera(calibration, optical)
    x, y, z = _floats(pose.translation())
    qw, qx, qy, qz = _floats(pose.rotation().wxyz)
    return (
        "ros2 run tf2_ros static_transform_publisher "
        f"--x {x!r} --y {y!r} --z {z!r} --qx {qx!r} --qy {qy!r} --qz {qz!r} --qw {qw!r} "
        f"--frame-id {parent} --child-frame-id {child}\n"
    )


def _quoted_frame_name(name: str) -> str:
    """Return a frame's name quoted for a shell; raise a ValueError where ROS does not accept it."""
    require_frame_name(name)
    return shlex.quote(name)


def require_frame_name(name: str) -> None:
    """Raise a ValueError for a frame's name that ROS does not accept."""
    if not _FRAME_NAME_PATTERN.fullmatch(name):
        raise ValueError(
            "frame: expected a name of letters, digits, '_', '/', '~', '.' and '-', beginning "
            f"with none of the last two; found {shortened_repr(name)}"
        )


def ros_camera_info(calibration: Calibration, name: str = "camera") -> str:
    """Return a camera_info file in the format that ROS's camera_calibration writes.

    Raises:
        ValueError: a name that no file could hold, or a camera with which the file could not be
            read back.
    """
    require_readable("camera", [name])
    camera = calibration.camera
    lens = opencv_coefficients(camera)
    K = _camera_matrix(camera)
    content = {
        "image_width": camera.image_size[0],
        "image_height": camera.image_size[1],
        "camera_name": name,
        "camera_matrix": _matrix_entry(K),
        "distortion_model": lens.model,
        "distortion_coefficients": _matrix_entry(np.array([lens.coefficients])),
        "rectification_matrix": _matrix_entry(np.eye(3)),
        "projection_matrix": _matrix_entry(np.concatenate([K, np.zeros((3, 1))], axis=1)),
    }
    _refuse_unreadable(content)
    note = ""
    if lens.max_deviation:
        note = f"# nearest plumb_bob to the fitted lens: up to {lens.max_deviation:.3g} px off\n"
    return note + dump_yaml(content)


def urdf_origin(calibration: Calibration, optical: bool = True) -> str:
    """Return the URDF `<origin>` of a joint from mount to camera; rpy is about fixed axes, rad."""
    pose = mount_from_camera(calibration, optical)
    xyz = " ".join(repr(value) for value in _floats(pose.translation()))
    rpy = " ".join(repr(float(angle)) for angle in pose.rotation().as_rpy_radians())
    return f'<origin xyz="{xyz}" rpy="{rpy}"/>\n'


def opencv_yaml(calibration: Calibration) -> str:
    """Return a `cv2.FileStorage` file: camera matrix, distortion, and both transforms (m).

    Raises:
        ValueError: a camera with which the file could not be read back.
    """
    lens = opencv_coefficients(calibration.camera)
    first, second = calibration.transform_names
    matrices = {
        "camera_matrix": _camera_matrix(calibration.camera),
        "distortion_coefficients": np.array([lens.coefficients]),
        first: np.asarray(calibration.camera_from_mount.as_matrix()),
        second: np.asarray(calibration.holder_from_world.as_matrix()),
    }
    width, height = calibration.camera.image_size
    _refuse_unreadable(
        {
            "image_width": width,
            "image_height": height,
            "distortion_model": lens.model,
            **{name: _matrix_entry(matrix) for name, matrix in matrices.items()},
        }
    )
    # Written line by line: `dump_yaml` knows neither OpenCV's first line nor its matrix tag.
    lines = ["%YAML:1.0", "---", f"image_width: {width}", f"image_height: {height}"]
    lines += [
        f'distortion_model: "{lens.model}"',
        f"distortion_deviation_px: {lens.max_deviation!r}",
    ]
    for name, matrix in matrices.items():
        # Seventeen decimals keep every digit of a float64.
        numbers = ", ".join(f"{value:.17e}" for value in matrix.ravel())
        lines += [
            f"{name}: !!opencv-matrix",
            f"   rows: {matrix.shape[0]}",
            f"   cols: {matrix.shape[1]}",
            "   dt: d",
            f"   data: [ {numbers} ]",
        ]
    return "\n".join(lines) + "\n"


def _refuse_unreadable(content: dict[str, object]) -> None:
    """Raise a ValueError for a camera that `read_opencv_camera` would refuse."""
    from ..schemas.external_formats import OPENCV_CAMERA_SCHEMA
    from ..schemas.validation import refuse_unreadable

    refuse_unreadable(content, OPENCV_CAMERA_SCHEMA, "camera")


def _camera_matrix(camera: Camera) -> np.ndarray:
    """Return the camera matrix [fx 0 cx; 0 fy cy; 0 0 1], px."""
    fx, fy, cx, cy = _floats(jnp.stack([camera.alpha_u, camera.alpha_v, camera.u0, camera.v0]))
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _matrix_entry(matrix: np.ndarray) -> dict[str, object]:
    """Return a matrix as the mapping of rows, cols and data that ROS uses in YAML."""
    return {"rows": len(matrix), "cols": matrix.shape[1], "data": matrix.ravel().tolist()}
