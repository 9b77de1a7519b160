"""Compare calibration methods: those of the paper, and the joint fit."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from ...calibrate_data import LENS, calibrate
from ...cameras import AbstractLens
from ...dataset import Dataset
from ...fit_result import Rejection
from ...staged import fit_one_view_intrinsics, fit_staged
from ..free_poses import free_pose_deviations
from ..measures import Deviations, deviations
from ..rejections import rejected_by
from .held_out import (
    HeldOut,
    Refit,
    has_correction,
    predictor_of,
    refit,
    score,
    whole,
    without_correction,
)

UNCORRECTED = "correction left out"
"""The suffix of a method's name for its row without the correction of the robot's error."""


class Method(NamedTuple):
    """One method of the comparison.

    Attributes:
        fitter: function from a data set to a fit. Methods with the same fitter use the same fits.
        choose: function from a fit and the data to the part of it that is this method.
        measure: function from a predictor and the data to reprojection errors.
    """

    fitter: Callable[[Dataset], Any]
    choose: Callable[[Any, Dataset], Any] = whole
    measure: Callable[[Any, Dataset], Deviations] = deviations


class Row(NamedTuple):
    """The results of one method on one data set.

    Attributes:
        name: the method's name.
        fitted: reprojection errors on the views that were fitted; None where the fit failed.
        held_out: held-out errors; None where the fit failed.
        rejected: observations that the method left out; None where it failed or does not report
            them.
        failure: the reason of a failure.
    """

    name: str
    fitted: Deviations | None
    held_out: HeldOut | None
    rejected: tuple[Rejection, ...] | None = None
    failure: str | None = None


def standard_methods(lens: str | AbstractLens = LENS) -> dict[str, Method]:
    """Return the paper's methods, the joint fit, and the lower bound of a free pose per view."""

    def both(data: Dataset) -> Any:
        return calibrate(data, lens, noise="trusted")

    return {
        "staged": Method(both, lambda fit, _: fit.staged),
        "staged, no distortion": Method(lambda data: fit_staged(data, lens="pinhole")),
        "linear interpolation": Method(both, lambda fit, data: fit.staged.interpolation(data)),
        "one view's intrinsics": Method(fit_one_view_intrinsics),
        "joint, robot trusted": Method(both),
        "joint, errors estimated": Method(lambda data: calibrate(data, lens)),
        "free pose a view": Method(both, measure=free_pose_deviations),
    }


def compare(
    data: Dataset,
    methods: Mapping[str, Method | Callable[[Dataset], Any]] | None = None,
    folds: int = 5,
    progress: Callable[[str], None] | None = None,
    by: str = "view",
) -> list[Row]:
    """Fit every method to all views and in every fold; the folds are the same for all methods.

    A fit that corrects the robot's error has a second row without the correction: the error of a
    program that uses its transforms alone. These transforms are the best estimate of the mount, but
    not of the chain without a correction; for that, a fit that trusts the robot has transforms that
    absorb the robot's error.

    Args:
        data: all views.
        methods: by the name to report them under: a `Method`, or a fitter as `held_out` takes it;
            by default `standard_methods()`.
        folds: number of folds; below eight views, as many as there are views.
        progress: called with a line of text for each fit.
        by: `"view"` or `"region"`: which views are hidden together, as for `held_out`.
    """
    say = progress or (lambda _: None)
    fits: dict[Callable, _Fits | ValueError] = {}
    rows = []
    for name, given in (standard_methods() if methods is None else methods).items():
        method = given if isinstance(given, Method) else Method(given)
        # Methods with the same fitter are parts of one fit: it runs once per fold for all of them.
        if method.fitter not in fits:
            say(name)
            fits[method.fitter] = _fit(
                data, method.fitter, folds, lambda s, n=name: say(f"{n}: {s}"), by
            )
        found = fits[method.fitter]
        rows.append(_row(name, method, found, data))
        if isinstance(found, _Fits) and method.measure is deviations:
            # Only reprojection errors depend on the correction: a free pose per view ignores the
            # robot.
            bare = method._replace(choose=without_correction(method.choose))
            if any(has_correction(method.choose(fit, data)) for fit in found.every):
                rows.append(_row(f"{name}, {UNCORRECTED}", bare, found, data))
    return rows


class _Fits(NamedTuple):
    """A fitter's fit to all views, and its refits in every fold."""

    fit: Any
    refits: tuple[Refit, ...]

    @property
    def every(self) -> tuple[Any, ...]:
        """The fit to all views, and those of the folds that did not fail."""
        return (self.fit, *(fold.fit for fold in self.refits if fold.failure is None))


def _fit(
    data: Dataset,
    fitter: Callable[[Dataset], Any],
    folds: int,
    progress: Callable[[str], None],
    by: str,
) -> _Fits | ValueError:
    """Fit all views and every fold; return the error if the fit of all views fails."""
    try:
        return _Fits(fitter(data), refit(data, fitter, folds, progress, by))
    except ValueError as error:
        return error


def _row(name: str, method: Method, fits: _Fits | ValueError, data: Dataset) -> Row:
    """Return one method's row from the fits of its fitter."""
    if isinstance(fits, ValueError):
        return Row(name, None, None, failure=str(fits))
    part = method.choose(fits.fit, data)
    fitted = method.measure(predictor_of(part), data)
    unseen = score(fits.refits, data, method.choose, method.measure)
    return Row(name, fitted, unseen, rejected_by(part))
