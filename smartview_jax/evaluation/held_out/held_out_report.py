"""Collect the held-out errors of a calibration's staged and joint fits, from the same refits."""

from collections.abc import Callable
from typing import NamedTuple

from ...calibration_pipeline import CalibrationFit
from ...dataset import Dataset
from ..free_poses import free_pose_errors
from .folds import MIN_VIEWS_BY_REGION
from .held_out import FoldFit, HeldOutErrors, choose_uncorrected, fit_folds, has_correction, score
from .methods import UNCORRECTED_SUFFIX
from .predicted_error import PredictedError, predicted_error


class HeldOutReport(NamedTuple):
    """The held-out errors of one fit; None where they were not requested.

    Attributes:
        held_out: by view.
        by_region: by region of the workspace.
        free_pose: by view, with a free pose for every hidden view: the error of the camera alone.
        predicted_error: by view, with the errors that the fits predicted.
        error_models: name of the robot error model of each fold by view; empty if not estimated.
    """

    held_out: HeldOutErrors
    by_region: HeldOutErrors | None = None
    free_pose: HeldOutErrors | None = None
    predicted_error: PredictedError | None = None
    error_models: tuple[str, ...] = ()


def held_out_reports(
    data: Dataset,
    fitter: Callable[[Dataset], CalibrationFit],
    thorough: bool = False,
    progress: Callable[[str], None] | None = None,
) -> dict[str, HeldOutReport]:
    """Return the held-out errors of the parts of a calibration, by the name of the part.

    Args:
        data: all views.
        fitter: such as `calibrate`.
        thorough: also compute errors by region (if there are enough views), free-pose errors and
            the errors that the joint fits predicted; doubles the number of fits.
        progress: called with a line of text for each fit.

    Raises:
        ValueError: fewer than four usable views.
    """
    report = progress or (lambda _: None)
    by_view = fit_folds(data, fitter, progress=lambda text: report(f"held-out: {text}"))
    by_region = None
    # Hiding a region of few views leaves too few to fit.
    if thorough and len(data.usable_views()) >= MIN_VIEWS_BY_REGION:
        by_region = fit_folds(
            data, fitter, progress=lambda text: report(f"held-out by region: {text}"), by="region"
        )
    reports = {
        name: _scores(by_view, by_region, data, choose, thorough)
        for name, choose in (("staged", _choose_staged), ("joint", _choose_joint))
    }
    # Only the joint fit estimates a robot error model and predicts its own error.
    joint_fits = [fold.fit.joint for fold in by_view if fold.failure is None]
    reports["joint"] = reports["joint"]._replace(
        predicted_error=predicted_error(by_view, data, _choose_joint) if thorough else None,
        error_models=tuple(
            fit.noise_estimate.name for fit in joint_fits if fit.noise_estimate is not None
        ),
    )
    if any(map(has_correction, joint_fits)):
        reports[f"joint, {UNCORRECTED_SUFFIX}"] = _scores(
            by_view, by_region, data, choose_uncorrected(_choose_joint), False
        )
    return reports


def _choose_staged(fit: CalibrationFit, _: Dataset):
    """Return the staged fit of a calibration."""
    return fit.staged


def _choose_joint(fit: CalibrationFit, _: Dataset):
    """Return the joint fit of a calibration."""
    return fit.joint


def _scores(
    by_view: tuple[FoldFit, ...],
    by_region: tuple[FoldFit, ...] | None,
    data: Dataset,
    choose: Callable,
    with_free_poses: bool,
) -> HeldOutReport:
    """Return the held-out errors of one part of a calibration."""
    return HeldOutReport(
        score(by_view, data, choose),
        None if by_region is None else score(by_region, data, choose),
        score(by_view, data, choose, free_pose_errors) if with_free_poses else None,
    )
