"""Export a calibration for other programs: ROS, URDF, OpenCV, Kalibr, mrcal.

Each function returns the text of a file. The camera frame is the optical frame (z forward, x to the
right), as image processing expects; `optical=False` gives the body frame of ROS's REP 103
(x forward, z up), for programs that add the optical joint themselves.
"""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from ..calibration import Calibration
from ..cameras import (
    AbstractOpenCVLens,
    Camera,
    Fisheye,
    OpenCV8,
    Pinhole,
    camera_to_dict,
)
from ..export_text import (
    OpenCVDistortion,
    RigCamera,
    body_pose,
    camera_info_text,
    inverse_pose,
    kalibr_camchain_text,
    opencv_text,
    origin_text,
    pose_matrix,
    static_transform_launch_text,
    static_transform_text,
)
from ..geometry import host_matrices


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


def mount_from_camera(calibration: Calibration, optical: bool = True) -> np.ndarray:
    """Return the pose of the camera in the frame of its mount (the tool, or the base).

    It is a unit quaternion, real part first, and a translation (m).
    """
    pose = inverse_pose(np.asarray(calibration.camera_from_mount.wxyz_xyz))
    return pose if optical else body_pose(pose)


def ros_static_transform(
    calibration: Calibration, parent: str, child: str, optical: bool = True
) -> str:
    """Return the command `ros2 run tf2_ros static_transform_publisher ...` for the camera's pose.

    Raises:
        ValueError: a frame's name that ROS does not accept. A shell runs the line, so names are
            checked and quoted.
    """
    return static_transform_text(mount_from_camera(calibration, optical), parent, child)


def ros_launch_file(calibration: Calibration, parent: str, child: str, optical: bool = True) -> str:
    """Return a launch file of ROS 2 (XML) that publishes the camera's pose as a static transform.

    A frame's name that ROS does not accept is a ValueError.
    """
    pose = mount_from_camera(calibration, optical)
    return static_transform_launch_text(pose, parent, child)


def ros_camera_info(calibration: Calibration, name: str = "camera") -> str:
    """Return a camera_info file in the format that ROS's camera_calibration writes.

    Raises:
        ValueError: a name that no file could hold, or a camera with which the file could not be
            read back.
    """
    camera = calibration.camera
    return camera_info_text(camera_to_dict(camera), opencv_coefficients(camera), name)


def urdf_origin(calibration: Calibration, optical: bool = True) -> str:
    """Return the URDF `<origin>` of a joint from mount to camera; rpy is about fixed axes, rad."""
    return f"{origin_text(pose_matrix(mount_from_camera(calibration, optical)))}\n"


def opencv_yaml(calibration: Calibration) -> str:
    """Return a `cv2.FileStorage` file: camera matrix, distortion, and both transforms (m).

    Raises:
        ValueError: a camera with which the file could not be read back.
    """
    transforms = calibration.camera_from_mount, calibration.holder_from_world
    matrices = dict(zip(calibration.transform_names, map(host_matrices, transforms), strict=True))
    camera = calibration.camera
    return opencv_text(camera_to_dict(camera), opencv_coefficients(camera), matrices)


def kalibr_camchain(calibrations: Mapping[str, Calibration]) -> str:
    """Return a `camchain.yaml` of cameras on one mount, such as `RigFit.calibrations`, for Kalibr.

    Raises:
        ValueError: cameras on different mounts, or a lens that Kalibr does not have.
    """
    return kalibr_camchain_text(
        {
            name: RigCamera(
                camera_to_dict(calibration.camera),
                opencv_coefficients(calibration.camera),
                calibration.mount,
                mount_from_camera(calibration),
            )
            for name, calibration in calibrations.items()
        }
    )


def mrcal_cameramodel(calibration: Calibration) -> str:
    """Return a cameramodel file of mrcal with the camera and its pose on the mount.

    The extrinsics are the hand-eye transform, `camera_from_tool` (`camera_from_base` for a fixed
    camera): mrcal's reference frame is the mount.

    Raises:
        ValueError: a fisheye, which mrcal has no model of.
    """
    camera, lens = calibration.camera, opencv_coefficients(calibration.camera)
    if lens.model == "equidistant":
        raise ValueError(f"mrcal has no lens like {camera.lens!r}: calibrate with lens='opencv8'")
    coefficients = [float(x) for x in lens.coefficients]
    intrinsics = [float(x) for x in (camera.alpha_u, camera.alpha_v, camera.u0, camera.v0)]
    matrix = host_matrices(calibration.camera_from_mount)
    turn = Rotation.from_matrix(matrix[:3, :3]).as_rotvec()
    entries = {
        "lensmodel": f"LENSMODEL_OPENCV{len(coefficients)}",
        "intrinsics": intrinsics + coefficients,
        "extrinsics": [float(x) for x in (*turn, *matrix[:3, 3])],
        "imagersize": list(camera.image_size),
    }
    lines = "".join(f"    {name!r}: {value!r},\n" for name, value in entries.items())
    return f"{{\n{lines}}}\n"
