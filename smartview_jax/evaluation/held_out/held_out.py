"""Estimate the error on views that a fit never used, with everything refitted in each fold."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxlie import SE3

from ...calibration import Calibration
from ...dataset import Dataset
from ..measures import Deviations, Predictor, deviations
from .bootstrap import Interval, rms_interval
from .folds import split_views


class Refit(NamedTuple):
    """One fold: the views that it hides, and the fit to all others.

    Attributes:
        views: indices of the hidden views.
        fit: the fitter's result; None where it failed.
        failure: the reason of the failure.
    """

    views: tuple[int, ...]
    fit: Any
    failure: str | None = None


class HeldOut(NamedTuple):
    """The errors of fits on views that they never used.

    Attributes:
        deviations: pooled over all folds; NaN where not seen or the fold failed.
        folds: indices of the views held out in each fold.
        failures: fold and reason, for folds whose fit failed.
        unconverged: fold and message, for folds whose fit stopped early; their predictions count.
        extrapolated: indices of the views outside the region that their fold's predictor calls
            `inside`; empty where it has no such region. Their predictions count.
    """

    deviations: Deviations
    folds: tuple[tuple[int, ...], ...]
    failures: tuple[tuple[int, str], ...]
    unconverged: tuple[tuple[int, str], ...] = ()
    extrapolated: tuple[int, ...] = ()

    def interval(self, level: float = 0.95) -> Interval:
        """Return the bootstrap interval of the RMS over views, px; see `rms_interval`."""
        return rms_interval(self.deviations, level)


def held_out(
    data: Dataset,
    fitter: Callable[[Dataset], Any],
    folds: int = 5,
    progress: Callable[[str], None] | None = None,
    by: str = "view",
) -> HeldOut:
    """Cross-validate, by view or by region of the workspace.

    Args:
        data: all views.
        fitter: function from a data set to a fit with a `.calibration`, or to anything with
            `project`, `points_in_camera` and `camera`. Held-out views come to it with nothing
            visible.
        folds: number of folds; by view and below eight views, as many as there are views.
        progress: called with a line of text for each fold.
        by: `"view"`, where hidden views have neighbours that are seen, or `"region"`, where views
            with nearby tool positions are hidden together and the fit has to extrapolate.

    Raises:
        ValueError: fewer than two folds, or too few usable views: four, six by region.
    """
    return score(refit(data, fitter, folds, progress, by), data)


def refit(
    data: Dataset,
    fitter: Callable[[Dataset], Any],
    folds: int = 5,
    progress: Callable[[str], None] | None = None,
    by: str = "view",
) -> tuple[Refit, ...]:
    """Return the fits behind `held_out`, so that several parts of one fit can be scored.

    The arguments are those of `held_out`.
    """
    split = split_views(data, folds, by)
    fits = []
    for number, held in enumerate(split):
        if progress is not None:
            progress(f"fold {number + 1} of {len(split)}")
        try:
            fits.append(Refit(held, fitter(data.without(held))))
        except ValueError as error:
            fits.append(Refit(held, None, str(error)))
    return tuple(fits)


def predictor_of(fit: Any) -> Predictor:
    """Return a fit's calibration, or the object itself where it predicts."""
    return getattr(fit, "calibration", fit)


def whole(fit: Any, data: Dataset) -> Any:
    """Return the fit unchanged: the default choice of `score`."""
    return fit


def has_correction(fit: Any) -> bool:
    """Return whether a fit corrects the robot's error when it predicts."""
    return getattr(predictor_of(fit), "robot_error", None) is not None


def without_correction(
    choose: Callable[[Any, Dataset], Any] = whole,
) -> Callable[[Any, Dataset], Any]:
    """Return a choice for `score` that takes the same part with the robot's poses as reported."""

    def bare(fit: Any, data: Dataset) -> Any:
        part = choose(fit, data)
        predictor = predictor_of(part)
        return predictor.uncorrected if isinstance(predictor, Calibration) else part

    return bare


def score(
    refits: Sequence[Refit],
    data: Dataset,
    choose: Callable[[Any, Dataset], Any] = whole,
    measure: Callable[[Any, Dataset], Deviations] = deviations,
) -> HeldOut:
    """Return the pooled error of every fold on the views that it never used.

    Args:
        refits: from `refit`, with the same data.
        data: all views.
        choose: function from a fit and the data to the part of it to score: one of its fits, a
            predictor.
        measure: function from a predictor and the data to reprojection errors.
    """
    parts = [
        fold if fold.failure is not None else fold._replace(fit=choose(fold.fit, data))
        for fold in refits
    ]
    found = pooled(parts, data, lambda part: measure(predictor_of(part), data))
    unconverged = []
    for number, part in enumerate(parts):
        # Predictors other than fits have no `result`: nothing is known of their convergence.
        result = getattr(part.fit, "result", None)
        if result is not None and not result.converged:
            unconverged.append((number, result.message))
    outside = tuple(view for part in parts for view in _extrapolated(part, data))
    return found._replace(unconverged=tuple(unconverged), extrapolated=outside)


def _extrapolated(fold: Refit, data: Dataset) -> tuple[int, ...]:
    """Return the hidden views that are outside the region of a fold's predictor."""
    inside = None if fold.failure else getattr(predictor_of(fold.fit), "inside", None)
    if inside is None:
        return ()
    views = np.array(fold.views)
    return tuple(int(v) for v in views[~inside(SE3(data.base_from_tool.wxyz_xyz[views]))])


def pooled(refits: Sequence[Refit], data: Dataset, measure: Callable[[Any], Deviations]) -> HeldOut:
    """Return the values of a measure of every fold's fit, each on its hidden views.

    Args:
        refits: from `refit`, with the same data.
        data: all views.
        measure: function from a fit to numbers for every point; a `ValueError` is that fold's
            failure.
    """
    # Each view is hidden in one fold only, so the folds fill separate rows.
    px = np.full(data.visible.shape, np.nan)
    metres = px.copy()
    failures = []
    for number, (held, fit, failure) in enumerate(refits):
        if failure is None:
            try:
                found = measure(fit)
            except ValueError as error:
                failure = str(error)
            else:
                index = list(held)
                px[index], metres[index] = found.px[index], found.m[index]
        if failure is not None:
            failures.append((number, failure))
    folds = tuple(fold.views for fold in refits)
    return HeldOut(Deviations(px, metres), folds, tuple(failures))
