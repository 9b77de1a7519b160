"""Calibrate by the paper's three steps in one call.

Step 1 (`weng.py`, Eq. 8) calibrates each view by itself, Step 2 (`kalman.py`, Eq. 9) fits one
camera to all views, Step 3 (`hand_eye`, Eq. 17) solves for the hand-eye and world transforms.
"""

import dataclasses
import logging
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxlie import SE3

from ..calibration import Calibration
from ..cameras import AbstractLens, Camera
from ..data_checks import (
    MINIMUM_POINTS,
    ViewConsistency,
    find_consistent_views,
    median_reprojection_errors,
    views_to_use,
)
from ..dataset import Dataset, chain_residuals
from ..fit_result import FitCode, FitResult, Rejection
from ..geometry import PoseLike
from ..hand_eye import HandEyeResult, solve_hand_eye
from ..runtime.array_namespace import to_device
from ..runtime.blas_threads import on_one_blas_thread
from ..runtime.compilation import refuse_traced
from .common_camera import CameraSteps, fit_pictures
from .given_start import known_bases, known_transforms
from .kalman import kalman_filter
from .motion_checks import MotionChecks, PairedViews, check_motion, pair_views
from .picture_steps import camera_poses_of_views
from .staged_fit import CommonCameraFit, CommonCameraOptions, StagedFit, with_region
from .two_hands import place_bases
from .weng import calibrate_views

_log = logging.getLogger(__name__)


@on_one_blas_thread
def fit_staged(
    data: Dataset,
    lens: str | AbstractLens = "radial",
    *,
    camera: Camera | None = None,
    rough_translation: np.ndarray | None = None,
    length_scale: float = 1.0,
    pixel_sigma: float | None = None,
    gate_probability: float = 0.9999,
    conventions: str = "raise",
    step2: Callable[..., CommonCameraFit] = kalman_filter,
    start: Calibration | Mapping[str, PoseLike] | None = None,
    progress: Callable[[str], None] | None = None,
) -> StagedFit:
    """Calibrate in three steps: each view (Weng), all views (Kalman), hand-eye (BFGS).

    Args:
        data: at least three views with six visible points each.
        lens: a name or a lens; Step 1 always uses the paper's (Eq. 3), or none for `"pinhole"`.
        camera: a known camera; Steps 1 and 2 then estimate the poses only.
        rough_translation: approximate position of the target, m (the paper's start of Step 3).
        length_scale: metres per unit of length in Eq. 17, whose result depends on that unit.
        pixel_sigma: standard deviation of u and v, px; estimated if not given.
        gate_probability: fraction of good measurements that pass the outlier gate.
        conventions: `"raise"` an error if robot and camera motion contradict each other, or
            `"report"` it in the result.
        step2: the paper's filter, or a function with the same arguments, such as
            `joint.batch_least_squares`.
        start: a calibration or transforms by name, as far as they are known: what the robot's
            motion leaves undetermined stays there.
        progress: called with a sentence about each step.

    Raises:
        ValueError: too few usable views, a robot that did not move, or that never turned where no
            start says the camera's place, or poses that cannot belong to these pictures.

    For example:

        >>> staged = sv.fit_staged(data)
        >>> print(np.round(1e3 * staged.calibration.camera_from_tool.translation()), "mm")
        [-19.  60. -88.] mm
    """
    refuse_traced("fit_staged", data, camera)
    if data.hands is not None:
        bases = known_bases(start)
        if bases is None:
            bases = place_bases(data.hands, *camera_poses_of_views(data, lens, camera))
        data = data.with_bases(bases)
    known = known_transforms(start, data.mount)
    if conventions not in ("raise", "report"):
        raise ValueError(f"conventions is 'raise' or 'report'; found {conventions!r}")
    place_is_given = rough_translation is not None or any(pose is not None for pose in known)
    views_to_use(data, camera, place_is_given)
    options = CommonCameraOptions(pixel_sigma, gate_probability, camera is not None)
    steps = CameraSteps(lens, camera, step2, options, progress)
    views = pair_views(data, fit_pictures(data, steps), known)
    checks = check_motion(data, views)
    if checks.report.problems and conventions == "raise":
        raise ValueError("; ".join(checks.report.problems))
    steps.say("Step 3: hand-eye and world transforms")
    consistency = _views_of_step3(data, views, checks)
    for view in consistency.uncertain:
        view_id = data.view_ids[view]
        steps.say(f"view {view_id}: its points determine its pose poorly; Step 3 does without it")
    common_fit = views.pictures.common
    step3 = solve_hand_eye(
        data.mount_from_holder,
        common_fit.camera_from_world,
        np.asarray(consistency.consistent, dtype=float),
        rough_translation,
        length_scale,
        known,
    )
    count = int(consistency.consistent.sum())
    _log.info("Step 2: %.3f px RMS; Step 3: %d views", float(common_fit.rms), count)
    return _assembled(data, views, checks, consistency, step3)


def _views_of_step3(data: Dataset, views: PairedViews, checks: MotionChecks) -> ViewConsistency:
    """Return which views agree with each other.

    Step 3 has no outlier gate of its own: Eq. 17 is a sum of squares, which one wrong pair of
    picture and pose can dominate.
    """
    pictures, common_fit = views.pictures, views.pictures.common
    agreeing = pictures.used & ~np.isin(np.arange(data.view_count), list(views.mispaired))
    return find_consistent_views(
        data.mount_from_holder,
        common_fit.camera_from_world,
        agreeing.astype(float),
        lambda camera_from_mount, holder_from_world: median_reprojection_errors(
            _calibration(data, common_fit.camera, camera_from_mount, holder_from_world),
            pictures.observations,
            common_fit.inliers,
        ),
        data.view_ids,
        checks.turns,
    )


def _assembled(
    data: Dataset,
    views: PairedViews,
    checks: MotionChecks,
    consistency: ViewConsistency,
    step3: HandEyeResult,
) -> StagedFit:
    """Return the result of all steps."""
    pictures, common_fit, choice = views.pictures, views.pictures.common, views.choice
    calibration = _calibration(
        data, common_fit.camera, step3.camera_from_mount, step3.holder_from_world
    )
    if pictures.stretched is not None:
        calibration = dataclasses.replace(calibration, target_shape=pictures.stretched.shape)
    # Views with an uncertain pose do not enter Step 3, but their points are good observations.
    trusted = consistency.consistent.copy()
    trusted[list(consistency.uncertain)] = True
    in_step3, ids = np.flatnonzero(consistency.consistent), data.view_ids
    reasons = views.stale | views.renumbered | views.mispaired | consistency.reasons
    report = checks.report
    return StagedFit(
        with_region(calibration, data, in_step3),
        pictures.step1.calibrations,
        common_fit,
        step3,
        to_device(chain_residuals(calibration, data.observations)),
        to_device(np.asarray(common_fit.inliers) & trusted[:, None]),
        _rejections(data, pictures.unusable, np.asarray(common_fit.inliers))
        + tuple(Rejection(ids[view], None, text) for view, text in reasons.items()),
        tuple(int(view) for view in in_step3),
        report,
        _fit_result(common_fit, step3, calibration),
        (
            *checks.doubts,
            *((report.change,) if report.change and not report.problems else ()),
            *report.doubts,
            # With a wrong camera any poses explain the pictures as badly.
            *((choice.warning,) if choice and choice.warning and not checks.doubts else ()),
        ),
        checks.camera_doubt,
    )


def _calibration(
    data: Dataset, camera: Camera, camera_from_mount: SE3, holder_from_world: SE3
) -> Calibration:
    """Return a calibration of the data's mount; of two arms with the bases where the data say."""
    ends = camera_from_mount, holder_from_world
    return Calibration(camera, *ends, data.mount, base_from_other_base=data.base_from_other_base)


def fit_one_view_intrinsics(data: Dataset, view: int | None = None, **options: Any) -> StagedFit:
    """Calibrate with the intrinsics that Step 1 finds in a single view, taken for all views.

    This is the method that the paper criticises, for comparison.

    Args:
        data: as for `fit_staged`.
        view: index of the view; by default the one that determines its focal length best.
        options: passed on to `fit_staged`.
    """
    # Step 1 runs here on its own first, only to find the camera; `fit_staged` then holds it fixed.
    used = data.select(data.usable_views(MINIMUM_POINTS))
    step1 = calibrate_views(used.observations, data.image_size)
    chosen = int(np.argmin(np.asarray(step1.alpha_relative_std))) if view is None else view
    return fit_staged(data, camera=step1.camera(chosen, data.image_size), **options)


def _rejections(
    data: Dataset, unusable: dict[int, str], inliers: np.ndarray
) -> tuple[Rejection, ...]:
    """Return every rejected view and every point rejected by Step 2, with reasons."""
    # Points of unusable views are not listed one by one; the reason for the view covers them.
    rejected_views = [Rejection(data.view_ids[view], None, text) for view, text in unusable.items()]
    rejected_points = [
        Rejection(data.view_ids[view], int(point), "beyond the chi-square gate of Step 2")
        for view, point in np.argwhere(np.asarray(data.visible) & ~inliers)
        if view not in unusable
    ]
    return tuple(rejected_views + rejected_points)


def _fit_result(
    step2: CommonCameraFit, step3: HandEyeResult, calibration: Calibration
) -> FitResult:
    """Return whether all steps converged, with a message."""
    finite = all(
        np.isfinite(np.asarray(pose.wxyz_xyz)).all()
        for pose in (calibration.camera_from_mount, calibration.holder_from_world)
    )
    if not finite:
        return FitResult(FitCode.DIVERGED, "Step 3: the answer is not finite")
    return FitResult(
        FitCode.CONVERGED if step2.converged and step3.converged else FitCode.STOPPED_EARLY,
        f"Step 2: {step2.message}; Step 3: {step3.message}, started by {step3.best_starts[0]}",
    )
