"""Error on views that a fit never saw, everything refitted in each fold."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..dataset import Dataset
from .measures import Deviations, Predictor, deviations

LEAVE_ONE_OUT_BELOW = 8
"""Views below which every view is its own fold."""


class HeldOut(NamedTuple):
    """What a fit predicts of views it never saw.

    Attributes:
        deviations: pooled over all folds; NaN where not seen or the fold failed.
        folds: indices of the views held out in each fold.
        failures: fold and reason, for folds whose fit failed.
    """

    deviations: Deviations
    folds: tuple[tuple[int, ...], ...]
    failures: tuple[tuple[int, str], ...]


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
    if folds < 2:
        raise ValueError(f"folds: expected at least 2, found {folds}")
    views = data.usable_views()
    if len(views) < 4:
        raise ValueError(f"held-out error needs at least 4 usable views, found {len(views)}")
    split = view_folds(views, folds)
    px = np.full(data.visible.shape, np.nan)
    metres = px.copy()
    failures = []
    for number, held in enumerate(split):
        if progress is not None:
            progress(f"fold {number + 1} of {len(split)}")
        try:
            predictor = fit_without(data, held, fitter)
        except ValueError as error:
            failures.append((number, str(error)))
            continue
        found = deviations(predictor, data)
        index = list(held)
        px[index], metres[index] = found.px[index], found.m[index]
    return HeldOut(Deviations(px, metres), split, tuple(failures))


def fit_without(
    data: Dataset, held: tuple[int, ...], fitter: Callable[[Dataset], Any]
) -> Predictor:
    """The fit to all but some views, which are hidden rather than cut out: the shape stays."""
    shown = np.ones(data.view_count, dtype=bool)
    shown[list(held)] = False
    visible = data.visible & jnp.asarray(shown)[:, None]
    pixels = jnp.where(visible[..., None], data.pixels, jnp.nan)
    fit = fitter(eqx.tree_at(lambda d: (d.visible, d.pixels), data, (visible, pixels)))
    return getattr(fit, "calibration", fit)
