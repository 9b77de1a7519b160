"""Whole hand-eye calibrations by other libraries, from a data set to a `Calibration`.

These run in the caller's process; nothing is timed.
"""

# The wheel of vision_calibration fills its names in at run time.
# pyright: reportAttributeAccessIssue=false

import importlib.util

import cv2
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3

import smartview_jax as sv
from smartview_jax.cameras import OpenCV4, OpenCV5
from smartview_jax.geometry import as_se3

HAS_VISION_CALIBRATION = importlib.util.find_spec("vision_calibration") is not None


def opencv_park(data: sv.Dataset) -> sv.Calibration:
    """`calibrateCamera`, `calibrateHandEye`, and the board where its views say on average."""
    views = data.usable_views()
    parts = [_seen(data, int(k)) for k in views]
    points, pixels = ([part[k].astype(np.float32) for part in parts] for k in (0, 1))
    if not all(np.ptp(part[:, 2]) == 0.0 for part in points):
        raise ValueError("calibrateCamera needs a plane, or a start")
    flags = cv2.CALIB_FIX_K3
    _, K, distortion, turns, shifts = cv2.calibrateCamera(
        points,
        pixels,
        data.image_size,
        None,  # pyright: ignore[reportArgumentType]
        None,  # pyright: ignore[reportArgumentType]
        flags=flags,
    )
    base_from_tool = np.asarray(data.base_from_tool.as_matrix())[views]
    camera_from_world = np.tile(np.eye(4), (len(views), 1, 1))
    camera_from_world[:, :3, :3] = [cv2.Rodrigues(turn)[0] for turn in turns]
    camera_from_world[:, :3, 3] = [shift.ravel() for shift in shifts]
    tool_from_camera = np.eye(4)
    tool_from_camera[:3, :3], shift = cv2.calibrateHandEye(
        list(base_from_tool[:, :3, :3]),
        list(base_from_tool[:, :3, 3]),
        list(camera_from_world[:, :3, :3]),
        list(camera_from_world[:, :3, 3]),
        method=cv2.CALIB_HAND_EYE_PARK,
    )
    tool_from_camera[:3, 3] = shift.ravel()
    worlds = as_se3(base_from_tool @ tool_from_camera @ camera_from_world)
    mean = worlds.parameters().mean(axis=0)
    lens = OpenCV4(*map(float, distortion.ravel()[:4]))
    camera = sv.Camera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], lens, data.image_size)
    return sv.Calibration.eye_in_hand(
        camera, np.linalg.inv(tool_from_camera), SE3(mean).normalize()
    )


def vision_calibration(data: sv.Dataset, refine: bool) -> sv.Calibration:
    """Its whole pipeline, with its defaults but for whether it refines the robot's poses."""
    import vision_calibration as vc  # pyright: ignore[reportMissingImports]

    def pose(transform: SE3) -> "vc.Pose":
        w, x, y, z = np.asarray(transform.rotation().wxyz).tolist()
        return vc.Pose((x, y, z, w), tuple(np.asarray(transform.translation()).tolist()))

    def back(found: "vc.Pose") -> SE3:
        x, y, z, w = found.rotation_xyzw
        return SE3.from_rotation_and_translation(
            SO3(jnp.array([w, x, y, z])), jnp.array(found.translation_xyz)
        )

    views = []
    for k in data.usable_views():
        points, pixels = _seen(data, int(k))
        seen = vc.Observation(points.tolist(), pixels.tolist())
        views.append(vc.SingleCamHandeyeView(seen, pose(SE3(data.base_from_tool.wxyz_xyz[k]))))
    config = vc.SingleCamHandeyeCalibrationConfig(robot_poses=vc.RobotPoseConfig(refine=refine))
    found = vc.run_single_cam_handeye(vc.SingleCamHandeyeDataset(views), config)
    inner, bent = found.camera.intrinsics, found.camera.distortion
    lens = OpenCV5(bent.k1, bent.k2, bent.p1, bent.p2, bent.k3)
    camera = sv.Camera(inner.fx, inner.fy, inner.cx, inner.cy, lens, data.image_size)
    return sv.Calibration.eye_in_hand(
        camera, back(found.gripper_se3_camera).inverse(), back(found.base_se3_target)
    )


def _seen(data: sv.Dataset, view: int) -> tuple[np.ndarray, np.ndarray]:
    seen = np.asarray(data.visible[view])
    return np.asarray(data.points[view])[seen], np.asarray(data.pixels[view])[seen]
