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

    views = [
        vc.SingleCamHandeyeView(_observation(data, int(k)), _pose(data, int(k)))
        for k in data.usable_views()
    ]
    config = vc.SingleCamHandeyeCalibrationConfig(robot_poses=vc.RobotPoseConfig(refine=refine))
    found = vc.run_single_cam_handeye(vc.SingleCamHandeyeDataset(views), config)
    inner, bent = found.camera.intrinsics, found.camera.distortion
    lens = OpenCV5(bent.k1, bent.k2, bent.p1, bent.p2, bent.k3)
    camera = sv.Camera(inner.fx, inner.fy, inner.cx, inner.cy, lens, data.image_size)
    return sv.Calibration.eye_in_hand(
        camera, _transform(found.gripper_se3_camera).inverse(), _transform(found.base_se3_target)
    )


def opencv_stereo(rig: sv.Rig) -> dict[str, np.ndarray]:
    """`camera_from_tool` of two cameras: `stereoCalibrate`, and the first's `calibrateHandEye`.

    Both see one board in the same states of the robot.
    """
    first, second = rig.cameras.values()
    views = [int(k) for k in first.usable_views()]
    points = [_seen(first, k)[0].astype(np.float32) for k in views]
    pixels = [[_seen(d, k)[1].astype(np.float32) for k in views] for d in (first, second)]
    cameras = [
        cv2.calibrateCamera(
            points,
            seen,
            first.image_size,
            None,  # pyright: ignore[reportArgumentType]
            None,  # pyright: ignore[reportArgumentType]
            flags=cv2.CALIB_FIX_K3,
        )[1:3]
        for seen in pixels
    ]
    (K1, D1), (K2, D2) = cameras
    found = cv2.stereoCalibrate(
        points,
        pixels[0],
        pixels[1],
        K1,
        D1,
        K2,
        D2,
        first.image_size,
        flags=cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3,
    )
    second_from_first = np.eye(4)
    second_from_first[:3, :3], second_from_first[:3, 3] = found[5], found[6].ravel()
    mount = np.asarray(opencv_park(first).camera_from_tool.as_matrix())
    return dict(zip(rig.cameras, (mount, second_from_first @ mount), strict=True))


def vision_calibration_rig(rig: sv.Rig) -> dict[str, np.ndarray]:
    """`camera_from_tool` of all cameras on the hand, by its rig pipeline with its defaults."""
    import vision_calibration as vc  # pyright: ignore[reportMissingImports]

    views = []
    for state, view in enumerate(rig.view_ids):
        seen, pose = [], None
        for data in rig.cameras.values():
            index = data.view_ids.index(view) if view in data.view_ids else None
            seen.append(None if index is None else _observation(data, index))
            pose = pose if index is None else _pose(data, index)
        assert pose is not None, state
        views.append(vc.RigHandeyeView(seen, pose))
    found = vc.run_rig_handeye(vc.RigHandeyeDataset(len(rig.cameras), views))
    rig_from_tool = np.linalg.inv(np.asarray(_transform(found.gripper_se3_rig).as_matrix()))
    return {
        name: np.asarray(_transform(pose).as_matrix()) @ rig_from_tool
        for name, pose in zip(rig.cameras, found.cam_se3_rig, strict=True)
    }


def _observation(data: sv.Dataset, view: int):
    import vision_calibration as vc  # pyright: ignore[reportMissingImports]

    points, pixels = _seen(data, view)
    return vc.Observation(points.tolist(), pixels.tolist())


def _pose(data: sv.Dataset, view: int):
    import vision_calibration as vc  # pyright: ignore[reportMissingImports]

    w, x, y, z, *position = np.asarray(data.base_from_tool.wxyz_xyz[view]).tolist()
    return vc.Pose((x, y, z, w), tuple(position))


def _transform(pose) -> SE3:
    x, y, z, w = pose.rotation_xyzw
    return SE3.from_rotation_and_translation(
        SO3(jnp.array([w, x, y, z])), jnp.array(pose.translation_xyz)
    )


def _seen(data: sv.Dataset, view: int) -> tuple[np.ndarray, np.ndarray]:
    seen = np.asarray(data.visible[view])
    return np.asarray(data.points[view])[seen], np.asarray(data.pixels[view])[seen]
