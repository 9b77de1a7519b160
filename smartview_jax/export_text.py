"""Write a calibration for other programs from its plain numbers: ROS, URDF, OpenCV.

Only NumPy is needed, so that `smartview export` answers at once; `io` has the same functions for a
`Calibration`. Shapes are in docstrings, because importing jaxtyping takes a tenth of that answer's
time.
"""

import re
import shlex
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from .argument_checks import require_readable, shortened_repr
from .files import dump_yaml

Pose: TypeAlias = np.ndarray
"""A pose as seven numbers: a unit quaternion, real part first, and a translation (m)."""

_FRAME_NAME_PATTERN = re.compile(r"[A-Za-z0-9_/~][A-Za-z0-9_/~.-]{0,199}")

MOUNT_FRAMES = {"eye_in_hand": "tool0", "eye_to_hand": "base_link", "hand_to_hand": "tool0"}
"""ROS's usual frame of the mount, by where the camera is: the robot's tool, or its base."""

_COEFFICIENTS = {
    "pinhole": ("plumb_bob", ()),
    "opencv4": ("plumb_bob", ("k1", "k2", "p1", "p2")),
    "opencv5": ("plumb_bob", ("k1", "k2", "p1", "p2", "k3")),
    "opencv8": ("rational_polynomial", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "fisheye": ("equidistant", ("k1", "k2", "k3", "k4")),
}
"""ROS's name of the model and OpenCV's order of coefficients of every lens that OpenCV has, too."""

_PLUMB_BOB_COUNT = 5
"""Number of coefficients of ROS's plumb_bob; those that a lens does not have are zero."""


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


def opencv_distortion(lens: Mapping[str, Any]) -> OpenCVDistortion | None:
    """Return the lens of a calibration file as OpenCV's model; None if OpenCV has no such model.

    Raises:
        ValueError: names of numbers that are not the lens's names.
    """
    if lens["model"] not in _COEFFICIENTS:
        return None
    model, names = _COEFFICIENTS[lens["model"]]
    given = sorted(set(lens) - {"model"})
    if given != sorted(names):
        raise ValueError(f"camera.lens: expected the numbers {sorted(names)}, found {given}")
    coefficients = tuple(float(lens[name]) for name in names)
    if model == "plumb_bob":
        coefficients += (0.0,) * (_PLUMB_BOB_COUNT - len(coefficients))
    return OpenCVDistortion(model, coefficients, 0.0)


def inverse_pose(pose: Pose) -> Pose:
    """Return the inverse of a rigid transform."""
    inverse = np.array([pose[0], *-pose[1:4], 0.0, 0.0, 0.0])
    inverse[4:] = -pose_matrix(inverse)[:3, :3] @ pose[4:]
    return inverse


def body_pose(pose: Pose) -> Pose:
    """Return the pose of a camera's body frame (x forward, z up) for its optical frame's pose."""
    # optical_from_link maps body axes to optical axes: x forward becomes z, y left becomes -x,
    # z up becomes -y. Its quaternion, (1, 1, -1, 1) / 2, is multiplied from the right.
    w, x, y, z = pose[:4]
    rotated = 0.5 * np.array([w - x + y - z, w + x + y + z, -w - x + y + z, w - x - y + z])
    return np.concatenate([rotated, pose[4:]])


def pose_matrix(pose: Pose) -> np.ndarray:
    """Return a rigid transform as a matrix, `(4, 4)`."""
    w, x, y, z = pose[:4] / np.linalg.norm(pose[:4])
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = pose[4:]
    return matrix


def roll_pitch_yaw(rotation: np.ndarray) -> tuple[float, float, float]:
    """Return roll, pitch and yaw about the fixed axes x, y, z (rad) of a rotation, `(3, 3)`.

    URDF and ROS use these angles.
    Near a pitch of 90 degrees, where only the sum or difference of roll and yaw is determined, the
    three angles still give this rotation to all digits.
    """
    R = rotation
    yaw = float(np.arctan2(R[1, 0], R[0, 0]))
    pitch = float(np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0])))
    # Roll for this yaw, not by itself, so that errors of both cancel where they are determined
    # poorly: Rz(-yaw) R is Ry(pitch) Rx(roll), whose second row is (0, cos roll, -sin roll).
    c, s = np.cos(yaw), np.sin(yaw)
    roll = float(np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1]))
    return roll, pitch, yaw


def static_transform_text(mount_from_camera: Pose, parent: str, child: str) -> str:
    """Return the command `ros2 run tf2_ros static_transform_publisher ...` for a pose.

    Raises:
        ValueError: a frame's name that ROS does not accept. A shell runs the line, so names are
            checked and quoted.
    """
    parent, child = (shlex.quote(checked_frame_name(name)) for name in (parent, child))
    words = _publisher_words(mount_from_camera, parent, child)
    return f"ros2 run tf2_ros static_transform_publisher {words}\n"


def static_transform_launch_text(mount_from_camera: Pose, parent: str, child: str) -> str:
    """Return a launch file of ROS 2 that publishes a pose: `ros2 launch camera.launch.xml`.

    Raises:
        ValueError: a frame's name that ROS does not accept.
    """
    return launch_text({"hand_eye": StaticTransform(mount_from_camera, parent, child)})


class StaticTransform(NamedTuple):
    """A frame that does not move in its parent.

    Attributes:
        pose: of the frame in its parent.
        parent: name of the parent.
        child: name of the frame.
    """

    pose: Pose
    parent: str
    child: str


def launch_text(transforms: Mapping[str, StaticTransform]) -> str:
    """Return a launch file of ROS 2 that publishes several poses, by the name of each.

    Raises:
        ValueError: a frame's name that ROS does not accept.
    """
    nodes = []
    for name, (pose, parent, child) in transforms.items():
        parent, child = (checked_frame_name(frame) for frame in (parent, child))
        words = _publisher_words(pose, parent, child)
        nodes.append(
            f'  <node pkg="tf2_ros" exec="static_transform_publisher" name="{name}_publisher"\n'
            f'        args="{words}"/>\n'
        )
    return f"<launch>\n{''.join(nodes)}</launch>\n"


def _publisher_words(pose: Pose, parent: str, child: str) -> str:
    """Return the arguments of `static_transform_publisher`."""
    qw, qx, qy, qz, x, y, z = pose.tolist()
    return (
        f"--x {x!r} --y {y!r} --z {z!r} --qx {qx!r} --qy {qy!r} --qz {qz!r} --qw {qw!r} "
        f"--frame-id {parent} --child-frame-id {child}"
    )


def easy_handeye_text(
    mount_from_camera: Pose, mount: str, parent: str, child: str, name: str
) -> str:
    """Return a `.calib` file, whose transform easy_handeye2's publisher sends to ROS.

    Args:
        mount_from_camera: the pose of the camera in the frame of its mount.
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        parent: frame of the mount: the robot's tool, or its base for a fixed camera.
        child: frame of the camera.
        name: name of the calibration, which is the file's name in easy_handeye2's folder.

    Raises:
        ValueError: a name that ROS does not accept.
    """
    in_hand = mount != "eye_to_hand"
    mounts = {**MOUNT_FRAMES, "eye_in_hand" if in_hand else mount: parent}
    frames = {
        "robot_base_frame": mounts["eye_to_hand"],
        "robot_effector_frame": mounts["eye_in_hand"],
        "tracking_base_frame": child,
        "tracking_marker_frame": "marker",
    }
    qw, qx, qy, qz, x, y, z = mount_from_camera.tolist()
    content = {
        "parameters": {
            "name": checked_frame_name(name),
            "calibration_type": "eye_in_hand" if in_hand else "eye_on_base",
            **{key: checked_frame_name(frame) for key, frame in frames.items()},
            "freehand_robot_movement": True,
            "move_group_namespace": "/",
            "move_group": "manipulator",
        },
        "transform": {
            "translation": {"x": x, "y": y, "z": z},
            "rotation": {"x": qx, "y": qy, "z": qz, "w": qw},
        },
    }
    return dump_yaml(content)


def checked_frame_name(name: str) -> str:
    """Return a frame's name; raise a ValueError where ROS does not accept it."""
    if not _FRAME_NAME_PATTERN.fullmatch(name):
        raise ValueError(
            "frame: expected a name of letters, digits, '_', '/', '~', '.' and '-', beginning "
            f"with none of the last two; found {shortened_repr(name)}"
        )
    return name


def origin_text(matrix: np.ndarray) -> str:
    """Return the URDF `<origin>` of a frame's pose `(4, 4)`; rpy is about fixed axes, rad."""
    xyz = " ".join(repr(value) for value in matrix[:3, 3].tolist())
    rpy = " ".join(repr(angle) for angle in roll_pitch_yaw(matrix[:3, :3]))
    return f'<origin xyz="{xyz}" rpy="{rpy}"/>'


def camera_info_text(camera: Mapping[str, Any], lens: OpenCVDistortion, name: str) -> str:
    """Return a camera_info file in the format that ROS's camera_calibration writes.

    Args:
        camera: the camera, as in a calibration file.
        lens: its lens as OpenCV's model.
        name: name of the camera.

    Raises:
        ValueError: a name that no file could hold, or a camera with which the file could not be
            read back.
    """
    require_readable("camera", [name])
    width, height = camera["image_size"]
    K = _camera_matrix(camera)
    content = {
        "image_width": width,
        "image_height": height,
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


class RigCamera(NamedTuple):
    """A camera among others on one mount.

    Attributes:
        camera: the camera, as in a calibration file.
        lens: its lens as OpenCV's model.
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        mount_from_camera: pose of the camera in the frame of its mount.
    """

    camera: Mapping[str, Any]
    lens: OpenCVDistortion
    mount: str
    mount_from_camera: Pose


def kalibr_camchain_text(cameras: Mapping[str, RigCamera]) -> str:
    """Return a `camchain.yaml` as Kalibr writes it; each camera's pose is in the one before it.

    Args:
        cameras: cameras by name, in the order of the chain.

    Raises:
        ValueError: cameras on different mounts, or a lens that Kalibr does not have.
    """
    mounts = {entry.mount for entry in cameras.values()}
    if len(mounts) > 1:
        raise ValueError(
            "kalibr: the cameras move against each other: some are on the hand, some are fixed"
        )
    content, before = {}, None
    for number, (name, entry) in enumerate(cameras.items()):
        model, coefficients = _kalibr_distortion(name, entry.lens)
        K = _camera_matrix(entry.camera)
        mount_from_camera = pose_matrix(entry.mount_from_camera)
        chained = {}
        if before is not None:
            chained = {"T_cn_cnm1": (np.linalg.inv(mount_from_camera) @ before).tolist()}
        content[f"cam{number}"] = {
            **chained,
            "camera_model": "pinhole",
            "distortion_coeffs": coefficients,
            "distortion_model": model,
            "intrinsics": [K[0, 0].item(), K[1, 1].item(), K[0, 2].item(), K[1, 2].item()],
            "resolution": [int(size) for size in entry.camera["image_size"]],
            "rostopic": f"/{checked_frame_name(name)}/image_raw",
        }
        before = mount_from_camera
    return dump_yaml(content)


def _kalibr_distortion(name: str, lens: OpenCVDistortion) -> tuple[str, list[float]]:
    """Return Kalibr's name of a lens and its four coefficients.

    Raises:
        ValueError: a lens with more coefficients.
    """
    if lens.model == "equidistant":
        return "equidistant", list(lens.coefficients)
    if lens.model != "plumb_bob" or any(lens.coefficients[4:]):
        raise ValueError(
            f"kalibr: Kalibr has no lens like that of {name}: calibrate with lens opencv4 (its "
            "radtan), or fisheye (its equidistant)"
        )
    return "radtan", list(lens.coefficients[:4])


def opencv_text(
    camera: Mapping[str, Any], lens: OpenCVDistortion, transforms: Mapping[str, np.ndarray]
) -> str:
    """Return a `cv2.FileStorage` file: camera matrix, distortion, and transforms as matrices (m).

    Args:
        camera: the camera, as in a calibration file.
        lens: its lens as OpenCV's model.
        transforms: 4x4 matrices by name.

    Raises:
        ValueError: a camera with which the file could not be read back.
    """
    matrices = {
        "camera_matrix": _camera_matrix(camera),
        "distortion_coefficients": np.array([lens.coefficients]),
        **transforms,
    }
    width, height = camera["image_size"]
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
    from .schemas.external_formats import OPENCV_CAMERA_SCHEMA
    from .schemas.validation import refuse_unreadable

    refuse_unreadable(content, OPENCV_CAMERA_SCHEMA, "camera")


def _camera_matrix(camera: Mapping[str, Any]) -> np.ndarray:
    """Return the camera matrix [fx 0 cx; 0 fy cy; 0 0 1], px."""
    fx, fy, cx, cy = (float(camera[name]) for name in ("alpha_u", "alpha_v", "u0", "v0"))
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _matrix_entry(matrix: np.ndarray) -> dict[str, object]:
    """Return a matrix as the mapping of rows, cols and data that ROS uses in YAML."""
    return {"rows": len(matrix), "cols": matrix.shape[1], "data": matrix.ravel().tolist()}
