"""Fit a method to all views and in every fold, and collect its errors in rows of a comparison."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from ...dataset import Dataset, Rig
from ...fit_result import Rejection
from ..measures import ReprojectionErrors, reprojection_errors
from ..rejections import rejected_by
from .held_out import (
    FoldFit,
    HeldOutErrors,
    choose_uncorrected,
    fit_split,
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


class FoldedFits(NamedTuple):
    """A fitter's fit to all views, and its refits in every fold."""

    fit: Any
    refits: tuple[FoldFit, ...]

    @property
    def all_fits(self) -> tuple[Any, ...]:
        """The fit to all views, and the fits of all folds that did not fail."""
        return (self.fit, *(fold.fit for fold in self.refits if fold.failure is None))


def folded_fits(
    data: Dataset | Rig,
    fitter: Callable[[Any], Any],
    split: Sequence[tuple[int, ...]],
    progress: Callable[[str], None],
) -> FoldedFits | ValueError:
    """Fit all views and every fold; return the error if the fit of all views fails.

    Args:
        data: all views.
        fitter: function from the data, some of its views masked, to a fit.
        split: the views that each fold hides.
        progress: called with a line of text for each fold.
    """
    try:
        return FoldedFits(fitter(data), fit_split(data, fitter, split, progress))
    except ValueError as error:
        return error


def rows_of_method(
    name: str, method: Method, fits: FoldedFits | ValueError, data: Dataset
) -> list[MethodResult]:
    """Return one method's row, and a row without the correction if a fit corrects the robot."""
    rows = [_method_result(name, method, fits, data)]
    # Only reprojection errors depend on the correction: free poses ignore the robot.
    if isinstance(fits, FoldedFits) and method.measure is reprojection_errors:
        uncorrected = method._replace(choose=choose_uncorrected(method.choose))
        if any(has_correction(method.choose(fit, data)) for fit in fits.all_fits):
            rows.append(_method_result(f"{name}, {UNCORRECTED_SUFFIX}", uncorrected, fits, data))
    return rows


def _method_result(
    name: str, method: Method, fits: FoldedFits | ValueError, data: Dataset
) -> MethodResult:
    """Return one method's row from the fits of its fitter."""
    if isinstance(fits, ValueError):
        return MethodResult(name, None, None, failure=str(fits))
    chosen = method.choose(fits.fit, data)
    fitted = method.measure(predictor_of(chosen), data)
    held_out_errors = score(fits.refits, data, method.choose, method.measure)
    return MethodResult(name, fitted, held_out_errors, rejected_by(chosen))
