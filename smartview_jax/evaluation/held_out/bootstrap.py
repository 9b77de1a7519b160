"""How far a pooled error may be trusted: the bootstrap over views.

Points of one view err together, so views are drawn anew, not points. The fits stay as they are: the
interval says how much depends on which views the error was measured on, not on which it was fitted
to.

Reference: Efron and Tibshirani, An introduction to the bootstrap, 1993, chapter 13 (percentiles).
"""

from typing import NamedTuple

import numpy as np

from ..measures import Deviations

RESAMPLES = 5000
"""Sets of views that are drawn; the ends of a 95 % interval are then good to some 2 % of it."""


class Interval(NamedTuple):
    """Ends of an interval, px."""

    low: float
    high: float


def rms_interval(deviations: Deviations, level: float = 0.95) -> Interval:
    """Bootstrap interval of the RMS deviation, px; NaN with fewer than two views.

    Args:
        deviations: of any fit; views without a predicted point do not count.
        level: share of the resampled figures that lies inside.

    Raises:
        ValueError: a level that is not between 0 and 1.
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"level: expected a number between 0 and 1, found {level}")
    finite = np.isfinite(deviations.px)
    counts = finite.sum(axis=1)
    squares = np.sum(np.where(finite, deviations.px, 0.0) ** 2, axis=1)
    counts, squares = counts[counts > 0], squares[counts > 0]
    if len(counts) < 2:
        return Interval(float("nan"), float("nan"))
    drawn = np.random.default_rng(0).integers(len(counts), size=(RESAMPLES, len(counts)))
    drawn_rms = np.sqrt(squares[drawn].sum(axis=1) / counts[drawn].sum(axis=1))
    low, high = np.quantile(drawn_rms, [0.5 - 0.5 * level, 0.5 + 0.5 * level])
    return Interval(float(low), float(high))
