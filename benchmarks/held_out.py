"""Who predicts views it never saw: this library's fits beside OpenCV and vision-calibration.

Five folds by view (each view by itself below eight), the same for all, everything refitted in each
fold, on the real data sets that lie beside the checkout. And how far the hand-eye transforms found
from even and from odd views agree: nothing else that real data offer says more about the mount.
"""

# The wheel of vision_calibration fills its names in at run time.
# pyright: reportAttributeAccessIssue=false

import importlib.util
from collections.abc import Callable

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3

import smartview_jax as sv
from smartview_jax.cameras import OpenCV5, lens_by_name
from smartview_jax.evaluation import repeatability
from smartview_jax.geometry import as_se3

from .real_sets import SETS, SHARED, load

LENS = "opencv4"
BOUNDS = {
    ("rct_circle10x10", ""): 1.25,
    ("tampere_kuka_2", ""): 0.95,
    ("visp_franka_eih", ""): 5.0,
    ("koide_charuco", "20231006_"): 1.45,
    ("tampere_synthetic", "cs3_"): 0.034,
    ("lwr4_joint", ""): 3.1,
}
"""Held-out px that the fit with estimated errors keeps below."""

AGREEING = ("tampere_kuka_2", "")
AGREEMENT = (0.06, 0.5)
"""Degrees and mm within which even and odd views find the same hand-eye transform."""

ESTIMATED = "joint, errors estimated"


def run(smoke: bool = False) -> bool:
    """Print RMS held-out px of every method on every set; True where the bounds are kept."""
    sets = [entry for entry in SETS if (SHARED / entry[0]).is_dir()]
    sets = [entry for entry in sets if entry in BOUNDS or not smoke][: 1 if smoke else None]
    if not sets:
        print("skipped: the data sets are not beside this checkout (shared/data)")
        return True
    methods = _methods()
    if smoke:
        methods = {ESTIMATED: methods[ESTIMATED]}
    print(f"{'set':28}" + "".join(f"{name:>26}" for name in methods) + f"{'bound':>8}")
    kept = []
    for folder, prefix in sets:
        data, _ = load(folder, prefix)
        errors = {name: _held_out(data, method) for name, method in methods.items()}
        bound = BOUNDS.get((folder, prefix), np.inf)
        kept.append(errors[ESTIMATED] <= bound)
        row = "".join(f"{error:26.4g}" for error in errors.values())
        print(f"{folder + ' ' + prefix.rstrip('_'):28}{row}{bound:8.4g}", flush=True)
    if AGREEING in sets:
        kept.append(_halves_agree(load(*AGREEING)[0]))
    return all(kept)


def _methods() -> dict[str, Callable[[sv.Dataset], sv.Calibration]]:
    found = {
        "staged": lambda data: sv.fit_staged(data, LENS).calibration,
        "OpenCV, Park": _opencv,
        "joint, robot trusted": lambda data: _joint(data, "trusted").calibration,
        ESTIMATED: lambda data: _joint(data, "estimated").calibration,
    }
    if importlib.util.find_spec("vision_calibration") is None:
        print("missing: vision-calibration")
    else:
        found["vision-calibration"] = lambda data: _vision_calibration(data, True)
        found["  poses not refined"] = lambda data: _vision_calibration(data, False)
    return found


def _held_out(data: sv.Dataset, method: Callable[[sv.Dataset], sv.Calibration]) -> float:
    # Every method compiles its own programs; all together exhaust a process's memory maps.
    jax.clear_caches()
    try:
        return sv.held_out(data, method).deviations.rms
    except (ValueError, RuntimeError, cv2.error):
        return float("nan")


def _joint(data: sv.Dataset, noise: str) -> sv.JointFit:
    # The set with joint angles does not say how large its squares are.
    free = ("target_scale",) if data.arm is not None else ()
    return sv.fit_joint(data, sv.fit_staged(data, LENS).calibration, noise=noise, free=free)


def _halves_agree(data: sv.Dataset) -> bool:
    good = True
    for noise in ("trusted", "estimated"):
        found = repeatability(data, lambda half, noise=noise: _joint(half, noise))
        print(f"even and odd views of {AGREEING[0]}, {noise}: hand-eye {found.words}")
        turn, shift = np.rad2deg(found.rotation), 1e3 * found.translation
        stated = np.inf if found.in_std is None else found.in_std.max()
        within = turn <= AGREEMENT[0] and shift <= AGREEMENT[1] and stated <= 2.0
        good &= within or noise == "trusted"
    return good


def _opencv(data: sv.Dataset) -> sv.Calibration:
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
    lens = lens_by_name(LENS)
    lens = type(lens)(*map(float, distortion.ravel()[:4]))
    camera = sv.Camera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], lens, data.image_size)
    return sv.Calibration.eye_in_hand(
        camera, np.linalg.inv(tool_from_camera), SE3(mean).normalize()
    )


def _vision_calibration(data: sv.Dataset, refine: bool) -> sv.Calibration:
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
