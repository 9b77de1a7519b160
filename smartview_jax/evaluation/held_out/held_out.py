"""Cross-validate: estimate the error on views that a fit never used, refitting in each fold."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, overload

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ...calibration import Calibration
from ...dataset import Dataset, PoseDataset, Rig
from ...fit_result import FitResult, Rejection
from ...joint import PoseFit, RigFit, pose_rms, tracked_pose_errors
from ...runtime.array_namespace import to_device
from ..measures import Predictor, ReprojectionErrors, reprojection_errors
from .folds import split_views

RESAMPLE_COUNT = 5000
"""The number of resampled sets of views.

The ends of a 95 % interval are then good to about 2 % of it.
"""


class Interval(NamedTuple):
    """The two ends of an interval, px."""

    low: float
    high: float


class FoldFit(NamedTuple):
    """The fit of one fold, with the views that the fold hides from it.

    Attributes:
        views: indices of the hidden views.
        fit: the fitter's result; None where it failed.
        failure: the reason of the failure.
    """

    views: tuple[int, ...]
    fit: Any
    failure: str | None = None


class HeldOutErrors(NamedTuple):
    """The errors of fits on views that they never used.

    Attributes:
        errors: errors pooled over all folds; NaN for points not seen or in failed folds.
        folds: indices of the views held out in each fold.
        failures: fold and reason, for folds whose fit failed.
        unconverged_folds: fold and message, for folds whose fit stopped early; their predictions
            count.
        extrapolated_views: indices of the views for which `is_inside` of their fold's predictor is
            false; empty if it has no such method. Their predictions count.
    """

    errors: ReprojectionErrors
    folds: tuple[tuple[int, ...], ...]
    failures: tuple[tuple[int, str], ...]
    unconverged_folds: tuple[tuple[int, str], ...] = ()
    extrapolated_views: tuple[int, ...] = ()

    def interval(self, level: float = 0.95) -> Interval:
        """Return the bootstrap interval of the RMS over views, px; see `rms_interval`."""
        return rms_interval(self.errors, level)


@overload
def held_out(
    data: Dataset,
    fitter: Callable[[Dataset], Any],
    folds: int = 5,
    progress: Callable[[str], None] | None = None,
    by: str = "view",
) -> HeldOutErrors: ...


@overload
def held_out(
    data: Rig,
    fitter: Callable[[Rig], RigFit],
    folds: int = 5,
    progress: Callable[[str], None] | None = None,
    by: str = "view",
) -> dict[str, HeldOutErrors]: ...


def held_out(
    data: Dataset | Rig,
    fitter: Callable[[Any], Any],
    folds: int = 5,
    progress: Callable[[str], None] | None = None,
    by: str = "view",
) -> HeldOutErrors | dict[str, HeldOutErrors]:
    """Cross-validate, by view or by region of the workspace.

    Args:
        data: all views. Of a `Rig`, states of the robot are held out for all cameras at once.
        fitter: function from a data set to a fit with a `.calibration`, or to anything with
            `project`, `points_in_camera` and `camera`. It is called with the held-out views masked.
            Of a rig, it returns a `RigFit`, and is called without cameras whose views are all held
            out, which are among the failures of that fold.
        folds: number of folds; by view and below eight views, as many as there are views.
        progress: called with a line of text for each fold.
        by: `"view"` hides views at random; `"region"` hides views with nearby tool positions
            together, so that the fit has to extrapolate.

    Returns:
        The errors on the held-out views; of a rig, by the camera's name.

    Raises:
        ValueError: fewer than two folds, or too few usable views: four, six by region.

    For example:

        >>> def fitter(part):
        ...     return sv.fit_joint(part, truth, noise=noise)
        >>> errors = sv.held_out(data, fitter, folds=4).errors
        >>> print(f"{errors.rms:.1f} px on views that the fit never saw")
        1.6 px on views that the fit never saw
    """
    fits = fit_folds(data, fitter, folds, progress, by)
    if isinstance(data, Dataset):
        return score(fits, data)
    return {
        name: score(folds_of_camera(fits, data, name), data.cameras[name]) for name in data.cameras
    }


class CameraOfRig(NamedTuple):
    """The part of a rig's fit that belongs to one camera, like a fit of this camera.

    Attributes:
        calibration: the camera's calibration.
        rejected: what the fit left out of the camera's observations; None if it does not say.
        result: whether the fit converged; None if it does not say.
    """

    calibration: Calibration
    rejected: tuple[Rejection, ...] | None
    result: FitResult | None


def camera_of_rig(fit: Any, name: str) -> CameraOfRig:
    """Return one camera's part of a `RigFit`, or of anything with `calibrations`."""
    rejected = getattr(fit, "rejected", None)
    if rejected is not None:
        rejected = tuple(entry for camera, entry in rejected if camera == name)
    return CameraOfRig(fit.calibrations[name], rejected, getattr(fit, "result", None))


def camera_views(rig: Rig, name: str, states: Sequence[int]) -> tuple[int, ...]:
    """Return the views of one camera that were taken in the given states."""
    return tuple(np.flatnonzero(np.isin(rig.state_index[name], states)).tolist())


def folds_of_camera(fits: Sequence[FoldFit], rig: Rig, name: str) -> tuple[FoldFit, ...]:
    """Return the fits of a rig's folds as fits of one camera, with its own hidden views."""

    def of_camera(fold: FoldFit) -> FoldFit:
        """Return the camera's part of one fold."""
        views = camera_views(rig, name, fold.views)
        if fold.failure is not None:
            return FoldFit(views, None, fold.failure)
        if name not in fold.fit.calibrations:
            return FoldFit(views, None, f"camera {name!r}: no usable view is left to fit it")
        return FoldFit(views, camera_of_rig(fold.fit, name))

    return tuple(map(of_camera, fits))


def fit_folds(
    data: Dataset | Rig,
    fitter: Callable[[Any], Any],
    folds: int = 5,
    progress: Callable[[str], None] | None = None,
    by: str = "view",
) -> tuple[FoldFit, ...]:
    """Return the fits behind `held_out`, so that several parts of one fit can be scored.

    The arguments are as for `held_out`.
    """
    return fit_split(data, fitter, split_views(data, folds, by), progress)


def fit_split(
    data: Dataset | Rig,
    fitter: Callable[[Any], Any],
    split: Sequence[tuple[int, ...]],
    progress: Callable[[str], None] | None = None,
) -> tuple[FoldFit, ...]:
    """Return the fits of folds that hide the given views, or states of a rig's robot."""
    fits = []
    for number, hidden_views in enumerate(split):
        if progress is not None:
            progress(f"fold {number + 1} of {len(split)}")
        try:
            fits.append(FoldFit(hidden_views, fitter(_without_views(data, hidden_views))))
        except ValueError as error:
            # Reported with the results, so that the other folds still count.
            fits.append(FoldFit(hidden_views, None, str(error)))
    return tuple(fits)


def _without_views(data: Dataset | Rig, hidden: Sequence[int]) -> Dataset | Rig:
    """Return the data with views masked, and of a rig the cameras that still see their target."""
    part = data.mask_views(hidden)
    if isinstance(part, Dataset):
        return part
    seeing = {
        name: camera_data
        for name, camera_data in part.cameras.items()
        if len(camera_data.usable_views())
    }
    return part.with_cameras(seeing) if 0 < len(seeing) < len(part.cameras) else part


def predictor_of(fit: Any) -> Predictor:
    """Return a fit's calibration, or the object itself if it is a predictor."""
    return getattr(fit, "calibration", fit)


def whole_fit(fit: Any, data: Dataset) -> Any:
    """Return the fit unchanged: the default choice of `score`."""
    return fit


def has_correction(fit: Any) -> bool:
    """Return whether a fit corrects the robot's error when it predicts."""
    return getattr(predictor_of(fit), "robot_error", None) is not None


def choose_uncorrected(
    choose: Callable[[Any, Dataset], Any] = whole_fit,
) -> Callable[[Any, Dataset], Any]:
    """Return a choice for `score` that takes the same part with the robot's poses as reported."""

    def uncorrected_part(fit: Any, data: Dataset) -> Any:
        chosen = choose(fit, data)
        predictor = predictor_of(chosen)
        return predictor.uncorrected if isinstance(predictor, Calibration) else chosen

    return uncorrected_part


def score(
    fold_fits: Sequence[FoldFit],
    data: Dataset,
    choose: Callable[[Any, Dataset], Any] = whole_fit,
    measure: Callable[[Any, Dataset], ReprojectionErrors] = reprojection_errors,
) -> HeldOutErrors:
    """Return the pooled error of every fold on the views that it never used.

    Args:
        fold_fits: from `fit_folds`, with the same data.
        data: all views.
        choose: function from a fit and the data to the part to score: one of its fits, or a
            predictor.
        measure: function from a predictor and the data to reprojection errors.
    """
    chosen = [
        fold if fold.failure is not None else fold._replace(fit=choose(fold.fit, data))
        for fold in fold_fits
    ]
    pooled_errors = pool_errors(chosen, data, lambda part: measure(predictor_of(part), data))
    unconverged = []
    for number, fold in enumerate(chosen):
        # Predictors that are not fits have no `result`.
        result = getattr(fold.fit, "result", None)
        if result is not None and not result.converged:
            unconverged.append((number, result.message))
    extrapolated = tuple(view for fold in chosen for view in _extrapolated_views(fold, data))
    return pooled_errors._replace(
        unconverged_folds=tuple(unconverged), extrapolated_views=extrapolated
    )


def _extrapolated_views(fold: FoldFit, data: Dataset) -> tuple[int, ...]:
    """Return the hidden views that are outside the region of a fold's predictor."""
    is_inside = None if fold.failure else getattr(predictor_of(fold.fit), "is_inside", None)
    if is_inside is None or not fold.views:
        return ()
    views = np.array(fold.views)
    poses = np.asarray(data.base_from_tool.wxyz_xyz)[views]
    return tuple(int(v) for v in views[~is_inside(SE3(to_device(poses)))])


def pool_errors(
    fold_fits: Sequence[FoldFit], data: Dataset, measure: Callable[[Any], ReprojectionErrors]
) -> HeldOutErrors:
    """Return the errors of every fold's fit by a measure, each on its hidden views.

    Args:
        fold_fits: from `fit_folds`, with the same data.
        data: all views.
        measure: function from a fit to errors of every point; a `ValueError` is that fold's
            failure.
    """
    # Each view is hidden in a single fold, so the folds fill separate rows.
    px = np.full(data.visible.shape, np.nan)
    metres = px.copy()
    failures = []
    for number, (hidden_views, fit, failure) in enumerate(fold_fits):
        if failure is None:
            try:
                errors = measure(fit)
            except ValueError as error:
                failure = str(error)
            else:
                rows = list(hidden_views)
                px[rows] = errors.px[rows]
                metres[rows] = errors.metres[rows]
        if failure is not None:
            failures.append((number, failure))
    folds = tuple(fold.views for fold in fold_fits)
    return HeldOutErrors(ReprojectionErrors(px, metres), folds, tuple(failures))


def rms_interval(errors: ReprojectionErrors, level: float = 0.95) -> Interval:
    """Return the bootstrap interval of the RMS reprojection error, px; NaN below two views.

    Errors of points in a view are correlated, so whole views are resampled, not points. Fits are
    not repeated: the interval reflects the choice of test views, not of fitted views.

    Reference: Efron and Tibshirani, An introduction to the bootstrap, 1993, chapter 13
    (percentiles).

    Args:
        errors: of any fit; views without a predicted point do not count.
        level: fraction of the resampled values inside the interval.

    Raises:
        ValueError: a level that is not between 0 and 1.
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"level: expected a number between 0 and 1, found {level}")
    finite = np.isfinite(errors.px)
    counts = finite.sum(axis=1)
    squares = np.sum(np.where(finite, errors.px, 0.0) ** 2, axis=1)
    # A view without predicted points has no error to resample.
    counts, squares = counts[counts > 0], squares[counts > 0]
    if len(counts) < 2:
        return Interval(float("nan"), float("nan"))
    # Views resampled with replacement, with a fixed seed; RMS = sqrt(sum of squares / points).
    resampled_views = np.random.default_rng(0).integers(
        len(counts), size=(RESAMPLE_COUNT, len(counts))
    )
    resampled_rms = np.sqrt(
        squares[resampled_views].sum(axis=1) / counts[resampled_views].sum(axis=1)
    )
    low, high = np.quantile(resampled_rms, [0.5 - 0.5 * level, 0.5 + 0.5 * level])
    return Interval(float(low), float(high))


class HeldOutPoses(NamedTuple):
    """The errors of fits on pairs of poses that they never used.

    Attributes:
        errors: distance (m) and angle (rad) of each tracked pose from its prediction; NaN for
            pairs that were not seen or whose fold failed.
        folds: indices of the views held out in each fold.
        failures: fold and reason, for folds whose fit failed.
    """

    errors: Float[np.ndarray, "views 2"]
    folds: tuple[tuple[int, ...], ...]
    failures: tuple[tuple[int, str], ...]

    @property
    def rms(self) -> tuple[float, float]:
        """RMS distance (m) and angle (rad); NaN if no fold succeeded."""
        scored = self.errors[np.isfinite(self.errors).all(axis=1)]
        return pose_rms(scored) if len(scored) else (float("nan"), float("nan"))


def held_out_poses(
    data: PoseDataset,
    fitter: Callable[[PoseDataset], PoseFit],
    folds: int = 5,
    progress: Callable[[str], None] | None = None,
) -> HeldOutPoses:
    """Cross-validate by view.

    Args:
        data: all pairs, without those that are known to be wrong (`without_rejected_views`).
        fitter: function from a data set to a fit, called with the held-out views masked.
        folds: number of folds; below eight views, as many as there are views.
        progress: called with a line of text for each fold.

    Raises:
        ValueError: fewer than two folds or four usable views.
    """
    fits = fit_folds(data, fitter, folds, progress)
    errors = np.full((data.view_count, 2), np.nan)
    for fold in fits:
        if fold.fit is not None:
            views = list(fold.views)
            errors[views] = tracked_pose_errors(data, fold.fit.calibration)[views]
    failures = tuple((k, fold.failure) for k, fold in enumerate(fits) if fold.failure is not None)
    return HeldOutPoses(errors, tuple(fold.views for fold in fits), failures)
