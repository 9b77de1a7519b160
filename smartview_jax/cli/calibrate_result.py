"""Fit a data set for `smartview calibrate`, and compute held-out errors and a diagnosis."""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from ..calibration_pipeline import CalibrationFit
    from ..dataset import Dataset
    from ..evaluation import ErrorBudget, HeldOutReport, SplitHalfDifference

    Fitter = Callable[[Dataset, Callable[[str], None] | None], CalibrationFit]


class CalibrateResult(NamedTuple):
    """A fit and what was computed about it.

    Attributes:
        data: the data set.
        name: its name.
        fit: the staged and the joint fit to all views.
        held_out_reports: held-out errors by method; empty where they were not computed.
        split_half: difference between halves of the views; None where it was not computed.
        budget: causes of the error; None where they were not computed.
        notes: remarks on the data, and on what could not be computed.
        warnings: reasons to doubt the result.
    """

    data: "Dataset"
    name: str
    fit: "CalibrationFit"
    held_out_reports: "dict[str, HeldOutReport]"
    split_half: "SplitHalfDifference | None"
    budget: "ErrorBudget | None"
    notes: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def remarks(self) -> tuple[str, ...]:
        """Notes and warnings as lines for people."""
        return (*self.notes, *(f"warning: {text}" for text in self.warnings))


def fit_and_judge(
    data: "Dataset",
    name: str,
    fitter: "Fitter",
    held_out: bool,
    diagnose: bool,
    progress: Callable[[str], None],
) -> CalibrateResult:
    """Fit all views; compute held-out errors and a diagnosis if requested.

    Args:
        data: the data set.
        name: its name.
        fitter: function from a data set and a progress function, or None, to a fit.
        held_out: whether to refit without some views and predict those.
        diagnose: whether to compare halves of the views and to find the causes of the error.
        progress: called with a line of text for each stage.
    """
    from ..evaluation import without_rejected_views

    fit, notes = fitter(data, progress), list(data.notes)
    warnings = fit.warnings
    # Views that the joint fit rejected are outliers, not a measure of the calibration.
    inlier_data = without_rejected_views(data, fit)
    reports = _held_out_reports(inlier_data, fitter, diagnose, progress, notes) if held_out else {}
    split_half = budget = None
    if diagnose:
        split_half, budget = _diagnosis(fit, inlier_data, fitter, progress, notes)
        warnings += () if split_half is None else split_half.warnings
    return CalibrateResult(
        data, name, fit, reports, split_half, budget, tuple(notes), tuple(warnings)
    )


def _held_out_reports(
    data: "Dataset",
    fitter: "Fitter",
    thorough: bool,
    progress: Callable[[str], None],
    notes: list[str],
) -> "dict[str, HeldOutReport]":
    """Return the held-out errors of both fits, refitting each fold once, or add a note why not."""
    from ..evaluation import MIN_HELD_OUT_VIEWS, held_out_reports

    if len(data.usable_views()) < MIN_HELD_OUT_VIEWS:
        notes.append(f"held-out error needs at least {MIN_HELD_OUT_VIEWS} usable views: left out")
        return {}
    # Progress is reported by fold; the stages of each fit would hide it.
    return held_out_reports(
        data, lambda part: fitter(part, None), thorough=thorough, progress=progress
    )


def _diagnosis(
    fit: "CalibrationFit",
    data: "Dataset",
    fitter: "Fitter",
    progress: Callable[[str], None],
    notes: list[str],
) -> "tuple[SplitHalfDifference | None, ErrorBudget | None]":
    """Compare halves of the views and compute the error budget; note what cannot be computed."""
    from ..evaluation import error_budget, split_half_difference

    def fit_half(half_data: "Dataset"):
        progress("half of the views")
        return fitter(half_data, None).joint

    # Either may be impossible, for example with too few views, while the other can be computed.
    split_half = budget = None
    try:
        split_half = split_half_difference(data, fit_half)
    except ValueError as error:
        notes.append(f"no split-half comparison: {error}")
    try:
        budget = error_budget(data, fit.joint, progress, held_out_by_region=True)
    except ValueError as error:
        notes.append(f"no error budget: {error}")
    return split_half, budget
