"""The joint fit on the real data sets that lie next to the checkout, against reference figures.

Each set's measured.json holds what OpenCV and scipy reached on the same corners: `joint_px` with
the intrinsics free, `he_only_refined_px` with the intrinsics of `cv2.calibrateCamera` held, or with
given ones. The fits here start from the staged pipeline, never from the reference. Intrinsics are
calibrated again: the four digits in measured.json move the rendered sets' figures by a tenth.
"""

import json
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import equinox as eqx
import jaxlie
import numpy as np
from jaxlie import SE3

import smartview_jax as sv
from smartview_jax.cameras import Camera, lens_by_name
from smartview_jax.evaluation import Predictor

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"

LENS = "opencv4"
"""The lens of the reference figures, and of all fits that are compared on these sets."""

SETS = (
    ("rct_circle10x10", ""),
    ("tampere_kuka_2", ""),
    ("lwr4_joint", ""),
    ("koide_charuco", "20231006_"),
    ("koide_charuco", "20230920_"),
    ("visp_franka_eih", ""),
    ("tampere_synthetic", "cs1_"),
    ("tampere_synthetic", "cs2_"),
    ("tampere_synthetic", "cs3_"),
)
SMOKE_SETS = SETS[:1]


def run(smoke: bool = False) -> bool:
    """Print the table; True where every figure is within its bound."""
    sets = present(SMOKE_SETS if smoke else SETS)
    if not sets:
        return True
    print(f"{'set':28}{'joint px':>10}{'ref':>8}{'K held':>10}{'ref':>8}{'seconds':>9}  hand-eye")
    rows = [_row(folder, prefix) for folder, prefix in sets]
    return all(rows)


def present(wanted: Iterable[tuple[str, str]] = SETS) -> list[tuple[str, str]]:
    """Return the sets that lie next to the checkout; say so where there are none."""
    present_sets = [entry for entry in wanted if (SHARED / entry[0]).is_dir()]
    if not present_sets:
        print("skipped: the data sets are not next to this checkout (shared/data)")
    return present_sets


def load(folder: str, prefix: str) -> tuple[sv.Dataset, dict]:
    """A real set from its tables, and its reference figures."""
    path = SHARED / folder
    reference = json.loads((path / f"{prefix}measured.json").read_text())
    data = sv.io.import_correspondences(
        path / f"{prefix}poses.csv",
        path / f"{prefix}corners.csv",
        image_size=tuple(reference["image_size"]),
    )
    if folder == "lwr4_joint":
        joints = np.loadtxt(path / "joint_angles.csv", delimiter=",")
        data = data.with_joints(joints, sv.robots.kuka_lwr4())
    return data, reference


def held_out_px(
    data: sv.Dataset, fitter: Callable[[sv.Dataset], Predictor | sv.JointFit], folds: int = 5
) -> float:
    """RMS held-out error, px; NaN where a fold failed or a point cannot be predicted at all.

    Without the worst fold, or its worst points, the figure would be of another, easier task.
    """
    try:
        unseen = sv.held_out(data, fitter, folds)
    except (ValueError, RuntimeError, cv2.error):
        return float("nan")
    whole = not unseen.failures and not unseen.errors.unpredicted_count
    return unseen.errors.rms if whole else float("nan")


def _row(folder: str, prefix: str) -> bool:
    data, reference = load(folder, prefix)
    began = time.perf_counter()
    staged = sv.fit_staged(data)
    joint = sv.fit_joint(data, staged.calibration, lens=LENS, noise="trusted")
    seconds = time.perf_counter() - began
    held = sv.fit_joint(
        data,
        _with_camera(joint.calibration, _intrinsics_alone(data, reference)),
        noise="trusted",
        fixed=("camera",),
    )
    synthetic = folder == "tampere_synthetic"
    joint_px, held_px = _rms(data, joint), _rms(data, held)
    good = _near(joint_px, reference["joint_px"], 0.01) and _near(
        held_px, reference["he_only_refined_px"], 0.10 if synthetic else 0.01
    )
    note = _truth_note(joint.calibration) if synthetic else ""
    print(
        f"{folder + ' ' + prefix.rstrip('_'):28}{joint_px:10.4f}{reference['joint_px']:8.3f}"
        f"{held_px:10.4f}{reference['he_only_refined_px']:8.3f}{seconds:9.1f}  {note}"
        f"{'' if good else '  OUT OF BOUND'}"
    )
    return good


def _near(value: float, reference: float, tolerance: float) -> bool:
    """Within a relative tolerance and the half digit that the reference was rounded to."""
    return abs(value - reference) <= tolerance * reference + 5e-4


def _rms(data: sv.Dataset, fit) -> float:
    seen = np.asarray(data.visible)
    return float(np.sqrt(np.mean(np.sum(np.asarray(fit.residuals)[seen] ** 2, axis=-1))))


def _intrinsics_alone(data: sv.Dataset, reference: dict) -> Camera:
    """OpenCV's, from the same corners, unless the set came with a camera."""
    lens, size = type(lens_by_name(LENS)), tuple(reference["image_size"])
    if str(reference["intr_rms_px"]).startswith("given"):
        fx, fy, cx, cy, *distortion = reference["K"]
        return Camera(fx, fy, cx, cy, lens(*distortion), size)
    views = [np.asarray(seen) for seen in data.visible]
    points = [np.asarray(p, np.float32)[k] for p, k in zip(data.points, views, strict=True)]
    pixels = [np.asarray(p, np.float32)[k] for p, k in zip(data.pixels, views, strict=True)]
    _, K, distortion, _, _ = cv2.calibrateCamera(
        points, pixels, size, None, None, flags=cv2.CALIB_FIX_K3, criteria=(3, 500, 1e-14)
    )
    return Camera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], lens(*distortion.ravel()[:4]), size)


def _with_camera(calibration: sv.Calibration, camera: Camera) -> sv.Calibration:
    return eqx.tree_at(lambda c: c.camera, calibration, camera)


def _truth_note(calibration: sv.Calibration) -> str:
    """Distance to the exact hand-eye transform of the rendered sets: diag(1, -1, -1), no offset."""
    truth = SE3.from_rotation(jaxlie.SO3.from_x_radians(np.pi))
    error = np.asarray((calibration.camera_from_tool @ truth).log())
    millimetres = 1e3 * np.linalg.norm(error[:3])
    degrees = np.rad2deg(np.linalg.norm(error[3:]))
    return f"truth: {millimetres:.3f} mm, {degrees:.4f} deg"
