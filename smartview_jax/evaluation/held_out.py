"""Error on views that a fit never saw, everything refitted in each fold."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..dataset import Dataset
from .measures import Deviations, Predictor, deviations

LEAVE_ONE_OUT_BELOW = 8
"""Views below which every view is its own fold."""


class Refit(NamedTuple):
    """One fold: the views it hides, and the fit to all others.

    Attributes:
        views: indices of the hidden views.
        fit: whatever the fitter returned; None where it failed.
        failure: why it failed.
    """

    views: tuple[int, ...]
    fit: Any
    failure: str | None = None


class HeldOut(NamedTuple):
    """What a fit predicts of views it never saw.

    Attributes:
        deviations: pooled over all folds; NaN where not seen or the fold failed.
        folds: indices of the views held out in each fold.
        failures: fold and reason, for folds whose fit failed.
        unconverged: fold and message, for folds whose fit stopped early; their predictions count.
    """

    deviations: Deviations
    folds: tuple[tuple[int, ...], ...]
    failures: tuple[tuple[int, str], ...]
    unconverged: tuple[tuple[int, str], ...] = ()


def view_folds(views: np.ndarray, folds: int) -> tuple[tuple[int, ...], ...]:
    """Every fold's views: a fixed permutation dealt out, or one view each below eight views."""
    count = len(views)
    number = count if count < LEAVE_ONE_OUT_BELOW else min(folds, count)
    order = np.random.default_rng(0).permutation(count)
    return tuple(tuple(int(views[k]) for k in order[i::number]) for i in range(number))


def held_out(
    data: Dataset,
    fitter: Callable[[Dataset], Any],
    folds: int = 5,
    progress: Callable[[str], None] | None = None,
) -> HeldOut:
    """Cross-validate by view.

    Args:
        data: all views.
        fitter: from a data set to a fit with a `.calibration`, or to anything with `project`,
            `points_in_camera` and `camera`. Held-out views come to it with nothing visible.
        folds: number of folds; below eight views, as many as there are views.
        progress: told which fold is fitted.

    Raises:
        ValueError: fewer than two folds, or fewer than four usable views.
    """
    return score(refit(data, fitter, folds, progress), data)


def refit(
    data: Dataset,
    fitter: Callable[[Dataset], Any],
    folds: int = 5,
    progress: Callable[[str], None] | None = None,
) -> tuple[Refit, ...]:
    """The fits behind `held_out`, so that several parts of one fit can be scored; see there."""
    if folds < 2:
        raise ValueError(f"folds: expected at least 2, found {folds}")
    views = data.usable_views()
    if len(views) < 4:
        raise ValueError(f"held-out error needs at least 4 usable views, found {len(views)}")
    split = view_folds(views, folds)
    fits = []
    for number, held in enumerate(split):
        if progress is not None:
            progress(f"fold {number + 1} of {len(split)}")
        try:
            fits.append(Refit(held, fitter(without(data, held))))
        except ValueError as error:
            fits.append(Refit(held, None, str(error)))
    return tuple(fits)


def without(data: Dataset, views: Sequence[int]) -> Dataset:
    """The data with some views hidden, not cut out: the shape stays, and so what is compiled."""
    shown = np.ones(data.view_count, dtype=bool)
    shown[list(views)] = False
    visible = data.visible & jnp.asarray(shown)[:, None]
    pixels = jnp.where(visible[..., None], data.pixels, jnp.nan)
    return eqx.tree_at(lambda d: (d.visible, d.pixels), data, (visible, pixels))


def predictor_of(fit: Any) -> Predictor:
    """A fit's calibration, or the thing itself where it predicts."""
    return getattr(fit, "calibration", fit)


def whole(fit: Any, data: Dataset) -> Any:
    """The choice of `score` that takes a fit as it is."""
    return fit


def score(
    refits: Sequence[Refit],
    data: Dataset,
    choose: Callable[[Any, Dataset], Any] = whole,
    measure: Callable[[Any, Dataset], Deviations] = deviations,
) -> HeldOut:
    """The error of every fold on the views it never saw, pooled.

    Args:
        refits: from `refit`, with the same data.
        data: all views.
        choose: from a fit and the data to the part of it to score: one of its fits, a predictor.
        measure: from a predictor and the data to deviations.
    """
    px = np.full(data.visible.shape, np.nan)
    metres = px.copy()
    failures, unconverged = [], []
    for number, (held, fit, failure) in enumerate(refits):
        if failure is not None:
            failures.append((number, failure))
            continue
        part = choose(fit, data)
        result = getattr(part, "result", None)
        if result is not None and not result.converged:
            unconverged.append((number, result.message))
        found = measure(predictor_of(part), data)
        index = list(held)
        px[index], metres[index] = found.px[index], found.m[index]
    folds = tuple(fold.views for fold in refits)
    return HeldOut(Deviations(px, metres), folds, tuple(failures), tuple(unconverged))
