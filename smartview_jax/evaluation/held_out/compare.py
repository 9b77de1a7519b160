"""Compare calibration methods: the paper's methods, and the joint fit."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Unpack

from ...calibration import Calibration
from ...calibration_pipeline import DEFAULT_LENS, calibrate
from ...cameras import AbstractLens, Camera
from ...dataset import Dataset
from ...fit_result import Rejection
from ...geometry import PoseLike
from ...joint import JointOptions
from ...staged import fit_one_view_intrinsics, fit_staged
from ..free_poses import free_pose_errors
from ..measures import ReprojectionErrors, reprojection_errors
from ..rejections import rejected_by
from .held_out import (
    FoldFit,
    HeldOutErrors,
    choose_uncorrected,
    fit_folds,
    has_correction,
    predictor_of,
    score,
    whole_fit,
)

UNCORRECTED_SUFFIX = "without correction"
"""The suffix of a method's name for its row without the correction of the robot's error."""


class Method(NamedTuple):
    """A method of the comparison.

    Attributes:
        fitter: function from a data set to a fit. Methods with the same fitter use the same fits.
        choose: function from a fit and the data to the part of the fit that is scored.
        measure: function from a predictor and the data to reprojection errors.
    """

    fitter: Callable[[Dataset], Any]
    choose: Callable[[Any, Dataset], Any] = whole_fit
    measure: Callable[[Any, Dataset], ReprojectionErrors] = reprojection_errors


class MethodResult(NamedTuple):
    """The results of one method on one data set.

    Attributes:
        name: the method's name.
        fitted: reprojection errors on the views that were fitted; None where the fit failed.
        held_out: held-out errors; None where the fit failed.
        rejected: observations that the method left out; None if it failed or does not report them.
        failure: the reason of a failure.
    """

    name: str
    fitted: ReprojectionErrors | None
    held_out: HeldOutErrors | None
    rejected: tuple[Rejection, ...] | None = None
    failure: str | None = None


def standard_methods(
    lens: str | AbstractLens = DEFAULT_LENS,
    *,
    camera: Camera | None = None,
    start: Calibration | Mapping[str, PoseLike] | None = None,
    **joint_options: Unpack[JointOptions],
) -> dict[str, Method]:
    """Return the paper's methods, the joint fit, and the lower bound of a free pose per view.

    Args:
        lens: lens model of all methods except the one without distortion.
        camera: a known camera; methods about estimating the camera are then left out.
        start: start of the joint fits, as for `calibrate`.
        joint_options: options of the joint fits, except the noise model, which each method sets.
    """

    def calibrate_estimated(data: Dataset) -> Any:
        return calibrate(data, lens, camera=camera, start=start, **joint_options)

    def calibrate_trusted(data: Dataset) -> Any:
        options: JointOptions = {**joint_options, "noise": "trusted"}
        return calibrate(data, lens, camera=camera, start=start, **options)

    methods = {
        "staged": Method(calibrate_trusted, lambda fit, _: fit.staged),
        "staged, no distortion": Method(lambda data: fit_staged(data, lens="pinhole")),
        "linear interpolation": Method(
            calibrate_trusted, lambda fit, data: fit.staged.interpolation(data)
        ),
        "one view's intrinsics": Method(fit_one_view_intrinsics),
        "joint, robot trusted": Method(calibrate_trusted),
        "joint, errors estimated": Method(calibrate_estimated),
        "free pose a view": Method(calibrate_trusted, measure=free_pose_errors),
    }
    if camera is not None:
        # These two are about estimating the camera.
        del methods["staged, no distortion"], methods["one view's intrinsics"]
    return methods


def compare(
    data: Dataset,
    methods: Mapping[str, Method | Callable[[Dataset], Any]] | None = None,
    folds: int = 5,
    progress: Callable[[str], None] | None = None,
    by: str = "view",
) -> list[MethodResult]:
    """Fit every method to all views and in every fold; the folds are the same for all methods.

    A fit that corrects the robot's error gets a second row without the correction, for programs
    that use only its transforms. These are the best estimate of the mount, but do not predict best
    without the correction: for this, use a fit that trusts the robot, whose transforms absorb its
    error.

    Args:
        data: all views.
        methods: methods by name: a `Method`, or a fitter as for `held_out`; by default
            `standard_methods()`.
        folds: number of folds; below eight views, as many as there are views.
        progress: called with a line of text for each fit.
        by: `"view"` or `"region"`, as for `held_out`.

    For example:

        >>> def joint(part):
        ...     return sv.fit_joint(part, truth, noise=noise)
        >>> for row in sv.compare(data, {"joint": joint}, folds=4):
        ...     print(row.name, f"{row.held_out.errors.rms:.1f} px")
        joint 1.6 px
    """
    report = progress or (lambda _: None)
    # By fitter: its fits, or the error of its fit to all views.
    fits: dict[Callable, _FoldedFits | ValueError] = {}
    results = []
    for name, method_or_fitter in (standard_methods() if methods is None else methods).items():
        method = (
            method_or_fitter if isinstance(method_or_fitter, Method) else Method(method_or_fitter)
        )
        # Methods with the same fitter are parts of one fit: it runs once per fold for all of them.
        if method.fitter not in fits:
            report(name)
            fits[method.fitter] = _fit_folds(
                data, method.fitter, folds, lambda s, n=name: report(f"{n}: {s}"), by
            )
        method_fits = fits[method.fitter]
        results.append(_method_result(name, method, method_fits, data))
        if isinstance(method_fits, _FoldedFits) and method.measure is reprojection_errors:
            # Only reprojection errors depend on the correction: free poses ignore the robot.
            uncorrected = method._replace(choose=choose_uncorrected(method.choose))
            if any(has_correction(method.choose(fit, data)) for fit in method_fits.all_fits):
                results.append(
                    _method_result(f"{name}, {UNCORRECTED_SUFFIX}", uncorrected, method_fits, data)
                )
    return results


class _FoldedFits(NamedTuple):
    """A fitter's fit to all views, and its refits in every fold."""

    fit: Any
    refits: tuple[FoldFit, ...]

    @property
    def all_fits(self) -> tuple[Any, ...]:
        """The fit to all views, and the fits of all folds that did not fail."""
        return (self.fit, *(fold.fit for fold in self.refits if fold.failure is None))


def _fit_folds(
    data: Dataset,
    fitter: Callable[[Dataset], Any],
    folds: int,
    progress: Callable[[str], None],
    by: str,
) -> _FoldedFits | ValueError:
    """Fit all views and every fold; return the error if the fit of all views fails."""
    try:
        return _FoldedFits(fitter(data), fit_folds(data, fitter, folds, progress, by))
    except ValueError as error:
        return error


def _method_result(
    name: str, method: Method, fits: _FoldedFits | ValueError, data: Dataset
) -> MethodResult:
    """Return one method's row from the fits of its fitter."""
    if isinstance(fits, ValueError):
        return MethodResult(name, None, None, failure=str(fits))
    chosen = method.choose(fits.fit, data)
    fitted = method.measure(predictor_of(chosen), data)
    held_out_errors = score(fits.refits, data, method.choose, method.measure)
    return MethodResult(name, fitted, held_out_errors, rejected_by(chosen))
