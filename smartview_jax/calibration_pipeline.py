"""Calibrate by the staged pipeline, then by the joint fit, with the command line's defaults."""

import dataclasses
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Unpack, cast, overload

import equinox as eqx
import numpy as np

import smartview_jax as sv

from .argument_checks import require_instance, require_one_of
from .calibration import Calibration, transform_names
from .cameras import AbstractLens, Camera
from .data_checks import views_to_use
from .dataset import (
    Dataset,
    PoseDataset,
    Rig,
    chain_residuals,
    given_places,
    repetition_warnings,
    require_picture_size,
)
from .engine import PIXEL_ASPECT, ROBOT_ERROR, Noise, Prior, parameter_names
from .fit_result import Rejection
from .geometry import PoseLike, host_poses
from .joint import (
    JointFit,
    JointOptions,
    RigFit,
    batch_least_squares,
    fit_joint,
    needs_precompiling,
    precompile,
)
from .rig_pipeline import calibrate_rig
from .rig_starts import RigStart
from .robot_errors import RobotError
from .runtime.array_namespace import AnyArray
from .runtime.blas_threads import on_one_blas_thread
from .runtime.compilation import refuse_traced
from .runtime.double_precision import require_double_precision
from .runtime.modules import fields_of, module_of, with_fields
from .staged import (
    StagedFit,
    check_start,
    fit_staged,
    kalman_filter,
    merged_start,
    with_start_doubts,
)

DEFAULT_LENS = "opencv4"
"""The default lens model: it predicts unseen views of real data sets best.

`python -m benchmarks defaults` compares the lens models. On some of these data sets a lens without
decentring distortion hides errors of the arm.
"""

MAX_RMS_RATIO_TO_STAGED, MAX_UNCORRECTED_RMS_RATIO_TO_STAGED = 1.5, 5.0
"""The ratios of joint to staged residual RMS above which a warning is given.

The first applies to the whole joint fit, the second to its chain without the robot correction.
"""

EXACT_POSE_SIGMA = 1e-9
"""The standard deviation, m and rad, of exact poses; it moves pixels by less than 1e-5."""

STEP2_METHODS = {"kalman": kalman_filter, "batch": batch_least_squares}
"""The methods, by name, that fit one camera to all views."""


class CalibrationFit(JointFit):
    """A joint fit that knows the staged fit from which it started.

    It is the joint fit, with what either fit left out in `rejected`, and the doubts of both in
    `warnings`.

    Attributes:
        staged: the fit by the paper's pipeline.
        joint: the joint fit by itself.
        data: the data set that was calibrated.
    """

    staged: StagedFit = eqx.field(kw_only=True)
    joint: JointFit = eqx.field(kw_only=True)
    data: Dataset = eqx.field(kw_only=True)

    @classmethod
    def of(cls, staged: StagedFit, joint: JointFit, data: Dataset) -> "CalibrationFit":
        """Return the joint fit with the staged fit that it started from.

        Args:
            staged: the staged fit.
            joint: the joint fit.
            data: the data set that both were fitted to.
        """
        joint = with_fields(joint, pose_format=data.pose_format)
        values = fields_of(joint, JointFit)
        values |= {"rejected": _all_rejected(staged, joint), "warnings": _warnings(staged, joint)}
        return module_of(cls, values | {"staged": staged, "joint": joint, "data": data})

    def report(self, path: str | os.PathLike[str]) -> None:
        """Write a page with the result, its accuracy, its warnings and plots (HTML).

        `report.write_page` also takes held-out errors and a diagnosis, as `smartview calibrate`
        computes them.
        """
        sv.report.write_page(Path(path), self, self.data)


def _all_rejected(staged: StagedFit, joint: JointFit) -> tuple[Rejection, ...]:
    """Return the observations that either fit left out, each once and with the first reason.

    The joint fit did not use what the staged fit had left out.
    """
    # Reversed twice: of equal keys a dict keeps the last one, and the first reason is wanted.
    both = (*staged.rejected, *joint.rejected)
    return tuple({entry[:2]: entry for entry in reversed(both)}.values())[::-1]


def _warnings(staged: StagedFit, joint: JointFit) -> tuple[str, ...]:
    """Return the doubts of both fits, and differences between them, gravest first.

    What the staged fit doubts, and a joint fit that is worse, concern the data as a whole.
    """
    # The joint fit does not see what the staged fit had set aside.
    repetitions = [
        text for text in repetition_warnings(staged.rejected) if text not in joint.warnings
    ]
    answered = _answered_doubts(staged, joint)
    return (
        *(text for text in staged.warnings if text not in answered),
        *_staged_comparison_warnings(staged, joint),
        *joint.warnings,
        *repetitions,
    )


def _answered_doubts(staged: StagedFit, joint: JointFit) -> tuple[str, ...]:
    """Return the doubts of the staged fit that the joint fit answers.

    No single camera fits pictures of a stretched target that is taken as stated.
    """
    doubt, estimate = staged.camera_doubt, joint.noise_estimate
    shape = None if estimate is None else estimate.target_shape
    if doubt is None or shape is None or not shape.is_stretched or joint.noise is None:
        return ()
    return (doubt.text,) if doubt.misfit.is_answered_by(joint.noise.within_view_pixel) else ()


@overload
def calibrate(
    data: Dataset,
    lens: str | AbstractLens = DEFAULT_LENS,
    *,
    camera: Camera | None = None,
    start: Calibration | Mapping[str, PoseLike] | None = None,
    step2: str = "kalman",
    progress: Callable[[str], None] | None = None,
    **joint_options: Unpack[JointOptions],
) -> CalibrationFit: ...


@overload
def calibrate(
    data: Rig,
    lens: str | AbstractLens = DEFAULT_LENS,
    *,
    camera: Mapping[str, Camera] | None = None,
    start: RigStart | None = None,
    progress: Callable[[str], None] | None = None,
    **joint_options: Unpack[JointOptions],
) -> RigFit: ...


@on_one_blas_thread
def calibrate(
    data: Dataset | Rig,
    lens: str | AbstractLens = DEFAULT_LENS,
    *,
    camera: Camera | Mapping[str, Camera] | None = None,
    start: Calibration | Mapping[str, PoseLike] | RigStart | None = None,
    step2: str = "kalman",
    progress: Callable[[str], None] | None = None,
    **joint_options: Unpack[JointOptions],
) -> CalibrationFit | RigFit:
    """Calibrate by the staged pipeline, then by the joint fit without the staged fit's outliers.

    Args:
        data: at least three views with six visible points each; with a known camera four suffice.
            The cameras of a `Rig` are calibrated together, and the result is a `RigFit`; one or two
            views suffice for a known camera whose target another one on the same arm sees in three.
        lens: the lens model of both fits; the paper's is `"radial"`.
        camera: a known camera, which both fits then hold; of a rig, known cameras by name.
        start: where the joint fit starts, which is what parameters of `fixed` keep and what priors
            without a mean are about: a calibration, or one or both transforms by name, such as
            `camera_from_tool` from a drawing; by default the staged fit's. A transform alone moves
            the other one so that the first usable view stays as it is. A transform that the
            pictures contradict is named in `warnings`, and used only where it is held.
            Of a rig, such a start for some of the cameras, by the camera's name.
        step2: `"kalman"`, the paper's filter, or `"batch"`, which is faster on many points.
        progress: called with a line of text for each stage.
        joint_options: options of `fit_joint`, by keyword.

    Raises:
        TypeError: an argument of the wrong type.
        ValueError: a camera or a start that does not match this data set's pictures or mount; and
            the errors of `fit_staged` and `fit_joint`.

    For example:

        >>> fit = sv.calibrate(data, "radial", noise=noise)  # by default it is estimated
        >>> print(np.round(1e3 * fit.calibration.camera_from_tool.translation()), "mm")
        [-19.  60. -90.] mm
    """
    if isinstance(data, Rig):
        if step2 != "kalman":
            raise ValueError("calibrate: a rig takes no step2")
        cameras, starts = _by_camera(camera, start)
        return calibrate_rig(
            data, lens, cameras=cameras, start=starts, progress=progress, **joint_options
        )
    refuse_traced("calibrate", data, camera)
    # The second thread has settings of its own: it would compile everything before the refusal.
    require_double_precision()
    require_one_of("step2", step2, STEP2_METHODS)
    camera = _checked_camera(data, camera)
    if camera is not None:
        joint_options["fixed"] = ("camera", *joint_options.get("fixed", ()))
    start = cast(Calibration | Mapping[str, PoseLike] | None, start)
    # A start from other data would otherwise show only as a fit that goes astray.
    check_start(start, data)
    # Errors in the data are raised before the precompilation, which cannot be interrupted.
    priors = joint_options.get("priors") or {}
    # Without a start, held parameters keep the staged result, which cannot know a position either.
    held = joint_options.get("fixed", ()) if start else ()
    translation_is_given = given_places(transform_names(data.mount), held, priors)
    views_to_use(data, camera, translation_is_given)
    with _joint_fit_precompiled(data, lens, camera, joint_options):
        staged = fit_staged(
            data,
            lens,
            camera=camera,
            step2=STEP2_METHODS[step2],
            start=start or _places_of_priors(priors, data.mount),
            progress=progress,
        )
    staged, start = with_start_doubts(staged, start, data, (*held, *priors))
    try:
        joint = fit_joint(
            data,
            merged_start(staged.calibration, start, data, camera),
            # A start of another lens is converted; a known camera keeps its own.
            lens=lens if camera is None and isinstance(start, Calibration) else None,
            inliers=staged.inliers,
            progress=progress,
            **joint_options,
        )
    except ValueError as error:
        if doubts := _doubts_of_staged_fit(staged, data):
            raise ValueError(f"{'; '.join(doubts)} (what the fit says: {error})") from error
        raise
    return CalibrationFit.of(staged, joint, data)


@contextmanager
def _joint_fit_precompiled(
    data: Dataset, lens: str | AbstractLens, camera: Camera | None, options: JointOptions
) -> Iterator[None]:
    """Compile the joint fit while the block runs; the end of the block waits for it.

    Errors are ignored, since the fit itself raises the same.
    """
    noise, field = options.get("noise", "estimated"), options.get("field", "auto")
    if not needs_precompiling(data, lens, camera, noise, field):
        yield
        return
    with ThreadPoolExecutor(max_workers=1) as background:
        background.submit(precompile, data, lens, camera=camera, noise=noise, field=field)
        yield


def _doubts_of_staged_fit(staged: StagedFit, data: Dataset) -> tuple[str, ...]:
    """Return what the staged fit doubts, in sentences.

    A wrong lens or start, and views that contradict the robot, are likelier than what the joint fit
    stumbles over.
    """
    suspicious = staged.conventions.suspicious_views
    return (*staged.warnings, *(f"view {data.view_ids[view]}: {text}" for view, text in suspicious))


def _by_camera(
    camera: Camera | Mapping[str, Camera] | None,
    start: Calibration | Mapping[str, PoseLike] | RigStart | None,
) -> tuple[Mapping[str, Camera] | None, RigStart | None]:
    """Return known cameras and starts by the cameras' names, as a rig takes them.

    Raises:
        TypeError: a single camera, or a single calibration.
    """
    if isinstance(start, Calibration):
        raise TypeError("start: expected starts by camera for a rig, found a Calibration")
    if isinstance(camera, Camera):
        raise TypeError("camera: expected known cameras by name for a rig, found a Camera")
    return camera, cast(RigStart | None, start)


def _checked_camera(data: Dataset, camera: Camera | Mapping[str, Camera] | None) -> Camera | None:
    """Return the known camera of a data set.

    Raises:
        TypeError: data or camera of the wrong type.
        ValueError: a camera whose pictures have another size.
    """
    require_instance("data", data, Dataset)
    if isinstance(data, PoseDataset):
        raise TypeError("data: tracked poses have no pixels: fit_poses fits them")
    if camera is None:
        return None
    require_instance("camera", camera, Camera, "Camera(alpha_u, alpha_v, u0, v0, lens, size)")
    assert isinstance(camera, Camera)
    require_picture_size("the known camera", camera, data.image_size)
    return camera


def _places_of_priors(priors: Mapping[str, Prior], mount: str) -> dict[str, PoseLike]:
    """Return the transforms, with zero rotation, whose position has a prior in all axes."""
    poses: dict[str, PoseLike] = {}
    for name in transform_names(mount):
        paths = [f"{name}.translation.{axis}" for axis in "xyz"]
        means = [priors[path].mean for path in paths if path in priors]
        if len(means) == len(paths):
            place = np.array([0.0 if mean is None else mean for mean in means])
            poses[name] = host_poses(np.eye(3), place)
    return poses


def refit_uncorrected(data: Dataset, fit: CalibrationFit) -> Calibration:
    """Fit the chain that predicts best for programs that do not correct the robot's error.

    Such programs use transforms only. The fit takes the robot's poses as exact, so its camera and
    hand-eye transform absorb the robot's error: this hand-eye transform is not the best estimate
    of the camera's mount. Rejected observations stay out and held parameters stay held. Of the
    priors only the one on the ratio of the focal lengths is applied, so that square pixels stay so.

    If the noise was estimated, the poses get the standard deviation `EXACT_POSE_SIGMA` instead,
    and the robot error fields of that fit are held at zero. The optimum is the same, and the
    program for it is compiled already.

    Args:
        data: the data set that `fit` was fitted to.
        fit: the calibration to refit without a correction.
    """
    # The parameters that the first fit held are held again: they are the ones it did not estimate.
    start, estimated = fit.joint.calibration.uncorrected, set(fit.joint.parameter_names)
    fixed = tuple(name for name in parameter_names(start) if name not in estimated)
    # A target size that the user did not free is held too: a fit that trusts the robot distorts it.
    not_asked_for = () if fit.noise_estimate is None else fit.noise_estimate.free
    free = tuple(name for name in estimated & {"target_scale"} if name not in not_asked_for)
    used = fit.joint.problem.observations.visible
    priors = _prior_on_aspect(fit.joint)
    options: JointOptions = {"noise": "trusted", "fixed": fixed, "free": free, "priors": priors}
    if fit.noise_estimate is not None:
        field, pixel = fit.noise_estimate.encompassing_field, fit.noise_estimate.noise.pixel
        groups = () if field is None else field.group_names
        noise = Noise(pixel, EXACT_POSE_SIGMA, EXACT_POSE_SIGMA).with_unit_groups(field)
        held = tuple(f"{ROBOT_ERROR}.{name}" for name in groups)
        options |= {"noise": noise, "field": field, "fixed": (*fixed, *held)}
        if field is not None:
            start = dataclasses.replace(start, robot_error=RobotError.without_errors(field))
    refitted = fit_joint(data, start, inliers=used, **options)
    return refitted.calibration.uncorrected


def _prior_on_aspect(joint: JointFit) -> dict[str, Prior]:
    """Return the prior on the ratio of the focal lengths that a fit had; empty without one."""
    if PIXEL_ASPECT not in joint.std:
        return {}
    problem = joint.problem
    names = problem.fitted_names(parameter_names(problem.parameters.start))
    place = names.index(PIXEL_ASPECT)
    mean = problem.host_start_values()[place] - problem.host_offset_at_start()[place]
    std = 1.0 / float(np.asarray(problem.prior_weight.shared)[place])
    return {PIXEL_ASPECT: Prior(mean=float(mean), std=std)}


def _staged_comparison_warnings(staged: StagedFit, joint: JointFit) -> tuple[str, ...]:
    """Return the warnings from comparing the joint fit's residuals with the staged fit's."""
    inliers = np.asarray(joint.inliers)

    def rms(residuals: AnyArray) -> float:
        return float(np.sqrt(np.mean(np.sum(np.asarray(residuals)[inliers] ** 2, axis=-1))))

    staged_rms, joint_rms = rms(staged.residuals), rms(joint.residuals)
    messages = []
    if joint_rms > MAX_RMS_RATIO_TO_STAGED * staged_rms:
        messages.append(
            f"the joint fit leaves residuals of {joint_rms:.2f} px, the staged fit "
            f"{staged_rms:.2f} px"
        )
    if joint.calibration.robot_error is not None:
        uncorrected_rms = rms(
            # The problem's points already include the target's shape.
            chain_residuals(
                with_fields(joint.calibration.uncorrected, target_shape=None),
                joint.problem.observations,
            )
        )
        if uncorrected_rms > MAX_UNCORRECTED_RMS_RATIO_TO_STAGED * staged_rms:
            messages.append(
                f"without the robot correction the joint fit leaves residuals of "
                f"{uncorrected_rms:.1f} px (staged: {staged_rms:.1f} px): the correction absorbs "
                "an error of camera, hand-eye or target; measure the target"
            )
    return tuple(messages)
