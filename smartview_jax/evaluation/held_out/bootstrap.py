"""Estimate confidence intervals of a pooled error by the bootstrap over views.

Errors of points in a view are correlated, so whole views are resampled, not points. Fits are not
repeated: the interval reflects the choice of test views, not of fitted views.

Reference: Efron and Tibshirani, An introduction to the bootstrap, 1993, chapter 13 (percentiles).
"""

from typing import NamedTuple

import numpy as np

from ..measures import ReprojectionErrors

RESAMPLE_COUNT = 5000
"""The number of resampled sets of views.

The ends of a 95 % interval are then good to about 2 % of it.
"""


class Interval(NamedTuple):
    """The two ends of an interval, px."""

    low: float
    high: float


def rms_interval(errors: ReprojectionErrors, level: float = 0.95) -> Interval:
    """Return the bootstrap interval of the RMS reprojection error, px; NaN below two views.

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
