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

from ..calibration import Calibration, host_mount_from_holder
from ..cameras import AbstractLens, Camera, initial_lens
from ..data_checks import (
    MINIMUM_POINTS,
    ConventionReport,
    Findings,
    RobotAndCamera,
    SeenDistances,
    check_conventions,
    detection_findings,
    find_consistent_views,
    find_flexible_target,
    find_other_arm,
    find_shared_fault,
    find_shifted_numbering,
    joint_problem,
    mask_unusable_views,
    median_reprojection_errors,
    minimum_points,
    mismatched_views,
    pose_findings,
    require_minimum_views,
    shift_text,
    stale_views,
    target_turns,
    unusable_views,
    views_to_use,
)
from ..dataset import (
    Dataset,
    Observations,
    chain_residuals,
    contradictory_views,
    repeated_pose_reason,
)
from ..fit_result import FitCode, FitResult, Rejection
from ..geometry import PoseLike
from ..hand_eye import HandEyeResult, solve_hand_eye
from ..runtime.array_namespace import to_device
from ..runtime.blas_threads import on_one_blas_thread
from ..runtime.compilation import refuse_traced
from .given_start import known_bases, known_transforms
from .kalman import kalman_filter
from .picture_steps import (
    Step1,
    camera_poses_of_views,
    common_camera_doubt,
    pixel_noise,
    run_step1,
)
from .staged_fit import CommonCameraFit, CommonCameraOptions, StagedFit, with_region
from .stretched_target import fit_of_stretched_target
from .two_hands import place_bases
from .two_poses import choose_poses
from .weng import calibrate_views

_log = logging.getLogger(__name__)

MAX_UNCHECKED_POINTS = 6
"""The number of points up to which a view does not say which of them lies apart.

A pose passes through any three points exactly, so that good points look like outliers, or outliers
like good points, where these are half of all.
"""

UNCHECKED_GATE_PROBABILITY = 1.0 - 1e-14
"""The least probability of the outlier gate where most views have so few points: eight standard
deviations, which are understated there, since the poses of the views follow the noise."""


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
    say = progress or (lambda _: None)
    if conventions not in ("raise", "report"):
        raise ValueError(f"conventions is 'raise' or 'report'; found {conventions!r}")
    place_is_given = rough_translation is not None or any(pose is not None for pose in known)
    views_to_use(data, camera, place_is_given)
    unusable = unusable_views(data, minimum_points(camera))
    say(f"Step 1: each of {data.view_count - len(unusable)} views by itself")
    observations, used = mask_unusable_views(data, unusable)
    step1 = run_step1(observations, data.image_size, used, lens, camera)
    # Views that Step 1 could not fit to the target (wrong corner numbering, another object).
    mismatched = mismatched_views(step1.rms, used, observations, data.image_size)
    if mismatched:
        # Repeat without them: they entered the median intrinsics from which Step 2 starts.
        unusable = {**unusable, **mismatched}
        require_minimum_views(data, unusable, minimum_points(camera))
        observations, used = mask_unusable_views(data, unusable)
        step1 = run_step1(observations, data.image_size, used, lens, camera)
    start_inliers = step1.inliers
    point_counts = np.asarray(observations.visible).sum(axis=1)
    unchecked = np.sum(point_counts[point_counts <= MAX_UNCHECKED_POINTS])
    if 2 * unchecked > point_counts.sum():
        gate_probability = max(gate_probability, UNCHECKED_GATE_PROBABILITY)
        start_inliers = observations.visible
    say("Step 2: one camera for all views")

    def fit_camera(
        observations: Observations, start: Camera, camera_from_world: SE3
    ) -> CommonCameraFit:
        """Return the camera that fits all views, without the robot's poses."""
        return step2(
            observations,
            start,
            camera_from_world,
            start_inliers,
            CommonCameraOptions(pixel_sigma, gate_probability, camera is not None),
            progress,
        )

    common_fit = fit_camera(observations, step1.camera, step1.camera_from_world)
    stretched = None
    if camera is None:

        def fit_again(of_stretched: Observations) -> tuple[Step1, CommonCameraFit]:
            """Return Steps 1 and 2 for other points of the target."""
            say("Steps 1 and 2 again: is the target stretched?")
            again = run_step1(of_stretched, data.image_size, used, lens, camera)
            return again, fit_camera(of_stretched, again.camera, again.camera_from_world)

        stretched = fit_of_stretched_target(observations, used, common_fit, fit_again)
    if stretched is not None:
        observations, step1, common_fit = stretched[:3]
    robot = host_mount_from_holder(data.mount, data.base_from_tool)
    groups = contradictory_views(data.mask_views(list(unusable)))
    stale = {
        view: repeated_pose_reason(data, view, other)
        for view, other in stale_views(groups, robot, common_fit.camera_from_world, used).items()
    }
    used[list(stale)] = False
    choice = choose_poses(
        observations,
        common_fit.camera,
        common_fit.camera_from_world,
        robot,
        used,
        pixel_noise(common_fit),
        known,
    )
    if choice is not None and choice.exchanged:
        say(f"Step 2 again: {len(choice.exchanged)} views have their other pose")
        common_fit = fit_camera(observations, common_fit.camera, choice.camera_from_world)
    renumbered = {}
    if choice is None:
        shifts = find_shifted_numbering(
            robot,
            common_fit.camera_from_world,
            used,
            np.asarray(data.points),
            np.asarray(common_fit.inliers),
        )
        renumbered = {view: shift_text(shift) for view, shift in shifts.items()}
        used[list(renumbered)] = False
    weights = used.astype(float)
    # Checked on the poses of Step 2, before Step 3: a wrong convention makes A X = X B meaningless,
    # and the transforms that minimise Eq. 17 would still look like an answer.
    turns = target_turns(np.asarray(data.points), np.asarray(observations.visible))
    report = check_conventions(
        data.base_from_tool,
        common_fit.camera_from_world,
        data.mount,
        weights,
        turns,
        data.view_ids,
    )
    outlying = {}
    if choice is not None and choice.explained:
        outlying = choice.outlying
        # The poses of a small target scatter by more than the check allows for.
        report = report._replace(problems=(), hypotheses=())
    if choice is None and not report.explained:
        report = _with_mistake_in_joints(report, data, common_fit.camera_from_world, used)
    camera_doubt = common_camera_doubt(
        observations,
        used,
        common_fit,
        lens,
        camera is not None,
        lambda name: fit_camera(
            observations,
            dataclasses.replace(step1.camera, lens=initial_lens(name, step1.camera.lens)),
            step1.camera_from_world,
        ),
    )
    if choice is None and not report.explained:
        report = _with_fault_of_many_views(report, data, common_fit, used, camera_doubt is None)
    camera_doubts = () if camera_doubt is None else (camera_doubt.text,)
    if camera_doubt is None and stretched is None:
        bending = find_flexible_target(
            observations,
            np.asarray(common_fit.inliers) & used[:, None],
            common_fit.camera,
            common_fit.camera_from_world,
        )
        camera_doubts = () if bending is None else (bending.sentence,)
    # A target that bends does not hide a mistake that explains how robot and camera move.
    is_explained = report.explained or bool(report.change)
    findings = Findings(
        pose_findings(unusable | stale, data.view_ids),
        detection_findings(mismatched, data.view_ids),
        () if camera_doubt is None and is_explained else camera_doubts,
        report.problems,
        is_explained,
    )
    report = report._replace(problems=findings.problems)
    if camera_doubt is None and stretched is not None:
        camera_doubt, camera_doubts = stretched.doubt, (stretched.doubt.text,)
    if report.problems and conventions == "raise":
        raise ValueError("; ".join(report.problems))
    say("Step 3: hand-eye and world transforms")
    # Step 3 has no outlier gate of its own: Eq. 17 is a sum of squares, which one wrong pair of
    # picture and pose can dominate.
    agreeing = used & ~np.isin(np.arange(data.view_count), list(outlying))
    consistency = find_consistent_views(
        robot,
        common_fit.camera_from_world,
        agreeing.astype(float),
        lambda camera_from_mount, holder_from_world: median_reprojection_errors(
            _calibration(data, common_fit.camera, camera_from_mount, holder_from_world),
            observations,
            common_fit.inliers,
        ),
        data.view_ids,
        turns,
    )
    consistent = consistency.consistent
    reasons = stale | renumbered | outlying | consistency.reasons
    for view in consistency.uncertain:
        view_id = data.view_ids[view]
        say(f"view {view_id}: its points determine its pose poorly; Step 3 does without it")
    step3 = solve_hand_eye(
        robot,
        common_fit.camera_from_world,
        np.asarray(consistent, dtype=float),
        rough_translation,
        length_scale,
        known,
    )
    _log.info("Step 2: %.3f px RMS; Step 3: %d views", float(common_fit.rms), int(consistent.sum()))
    calibration = _calibration(
        data, common_fit.camera, step3.camera_from_mount, step3.holder_from_world
    )
    if stretched is not None:
        calibration = dataclasses.replace(calibration, target_shape=stretched.shape)
    # Views with an uncertain pose do not enter Step 3, but their points are good observations.
    trusted = consistent.copy()
    trusted[list(consistency.uncertain)] = True
    inliers = np.asarray(common_fit.inliers) & trusted[:, None]
    ids = data.view_ids
    return StagedFit(
        with_region(calibration, data, np.flatnonzero(consistent)),
        step1.calibrations,
        common_fit,
        step3,
        to_device(chain_residuals(calibration, data.observations)),
        to_device(inliers),
        _rejections(data, unusable, np.asarray(common_fit.inliers))
        + tuple(Rejection(ids[view], None, text) for view, text in reasons.items()),
        tuple(int(view) for view in np.flatnonzero(consistent)),
        report,
        _fit_result(common_fit, step3, calibration),
        (
            *camera_doubts,
            *((report.change,) if report.change and not report.problems else ()),
            *report.ambiguities,
            # With a wrong camera any poses explain the pictures as badly.
            *((choice.warning,) if choice and choice.warning and not camera_doubts else ()),
        ),
        camera_doubt,
    )


def _calibration(
    data: Dataset, camera: Camera, camera_from_mount: SE3, holder_from_world: SE3
) -> Calibration:
    """Return a calibration of the data's mount; of two arms with the bases where the data say."""
    ends = camera_from_mount, holder_from_world
    return Calibration(camera, *ends, data.mount, base_from_other_base=data.base_from_other_base)


def _with_mistake_in_joints(
    report: ConventionReport, data: Dataset, camera_from_world: SE3, used: np.ndarray
) -> ConventionReport:
    """Return the report with a mistake in the joint readings, or with another arm, if it has one.

    Another arm may look like a target of another size.
    """
    if data.joints is None or data.arm is None:
        return report
    readings, text = np.asarray(data.joints), ""
    if report.problems:
        text = joint_problem(readings, data.arm, camera_from_world, data.mount, used)
    if not text:
        lengths = find_other_arm(readings, data.arm, camera_from_world, data.mount, used)
        text = "" if lengths is None else lengths.sentence
    return report._replace(problems=(text,), explained=True) if text else report


def _with_fault_of_many_views(
    report: ConventionReport,
    data: Dataset,
    common_fit: CommonCameraFit,
    used: np.ndarray,
    camera_fits: bool,
) -> ConventionReport:
    """Return the report with the one fault that makes many views wrong, if there is one.

    It is a problem where no calibration can be right with it, else a doubt. A camera that does not
    fit puts targets at wrong distances, so that nothing tells whether its focus changes.
    """
    poses = RobotAndCamera(
        data.base_from_tool,
        common_fit.camera_from_world,
        data.mount,
        data.view_ids,
        report.length_ratio,
    )
    if camera_fits:
        distances = SeenDistances.of_points(
            np.asarray(data.points),
            np.asarray(data.pixels),
            np.asarray(common_fit.inliers),
            pixel_noise(common_fit),
        )
        poses = poses._replace(distances=distances)
    fault = find_shared_fault(poses, used)
    if fault is None:
        return report
    text = fault.sentence
    return report._replace(change=text, problems=(text,) if fault.contradicts else report.problems)


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
