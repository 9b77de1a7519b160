"""Test whether the uncertainty that a fit states is correct, over many runs with known truth.

If the stated covariance `P` is correct, the normalised estimation error squared (NEES),
`e^T P^-1 e`, is chi-square distributed with as many degrees of freedom as numbers, and a 95 %
interval contains the truth in 95 of 100 runs.

Reference: Bar-Shalom, Li and Kirubarajan, Estimation with applications to tracking and navigation,
2001, section 5.4.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtri, ndtri, stdtrit

from ...schemas.covariances import SMALLEST_EIGENVALUE, smallest_correlation_eigenvalue

CONFIDENCE_LEVEL = 0.95
"""The probability of intervals and bands."""


class ConsistencyStatistic(NamedTuple):
    """A mean over runs, with the band that contains it with probability `CONFIDENCE_LEVEL`.

    The band assumes that the stated uncertainty is correct.
    """

    value: float
    low: float
    high: float

    @property
    def is_consistent(self) -> bool:
        """Whether the mean lies in its band."""
        return self.low <= self.value <= self.high


def nees(
    errors: Float[np.ndarray, "runs numbers"],
    covariances: Float[np.ndarray, "runs numbers numbers"],
) -> Float[np.ndarray, "runs"]:
    """Return every run's normalised estimation error squared.

    Args:
        errors: estimates minus truth, in any units.
        covariances: stated covariances, in the same units.

    Raises:
        ValueError: a covariance is not positive definite; the message names the run.
    """
    definite = smallest_correlation_eigenvalue(covariances) > SMALLEST_EIGENVALUE
    if not definite.all():
        run = int(np.argmin(definite))
        raise ValueError(f"covariances: run {run}: not finite and positive definite")
    # Correlations instead of covariances, because units may differ by many orders of magnitude.
    stds = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    correlations = covariances / (stds[:, :, None] * stds[:, None])
    # e^T P^-1 e = (L^-1 e)^T C^-1 (L^-1 e), with P = L C L, L the stds and C the correlations.
    standardised_errors = errors / stds
    return np.einsum(
        "ri,ri->r",
        standardised_errors,
        np.linalg.solve(correlations, standardised_errors[..., None])[..., 0],
    )


def mean_nees(nees_values: Float[np.ndarray, "runs"], dimension: int) -> ConsistencyStatistic:
    """Return the mean of `nees` with its band.

    The mean is near `dimension` if the covariances are correct.
    """
    tail_probability, runs = 0.5 - 0.5 * CONFIDENCE_LEVEL, len(nees_values)
    # Over n runs the sum is chi-square with n times as many degrees of freedom.
    low, high = (
        float(chdtri(runs * dimension, p)) / runs
        for p in (1.0 - tail_probability, tail_probability)
    )
    return ConsistencyStatistic(float(np.mean(nees_values)), low, high)


def within_interval(
    errors: Float[np.ndarray, "*runs"],
    std: Float[np.ndarray, "*runs"],
    degrees_of_freedom: Float[np.ndarray, "*runs"] | float = np.inf,
) -> Bool[np.ndarray, "*runs"]:
    """Return whether each error lies within its two-sided interval at `CONFIDENCE_LEVEL`.

    Args:
        errors: estimates minus truth.
        std: stated standard deviations.
        degrees_of_freedom: degrees of freedom of the standard deviations (Student's t); infinite
            if they are known exactly.
    """
    nu, p = np.asarray(degrees_of_freedom, dtype=float), 0.5 + 0.5 * CONFIDENCE_LEVEL
    finite = np.isfinite(nu)
    # Student's t quantile with finite degrees of freedom, otherwise the normal one.
    quantile = np.where(finite, stdtrit(np.where(finite, nu, 1.0), p), ndtri(p))
    return np.abs(errors) <= quantile * std


def coverage(is_within: Bool[np.ndarray, "runs"]) -> ConsistencyStatistic:
    """Return the fraction of runs whose interval contains the truth.

    Its band is the normal approximation.
    """
    # The binomial standard deviation sqrt(p (1 - p) / n) at the stated probability p.
    half_width = float(
        ndtri(0.5 + 0.5 * CONFIDENCE_LEVEL)
        * np.sqrt(CONFIDENCE_LEVEL * (1.0 - CONFIDENCE_LEVEL) / len(is_within))
    )
    return ConsistencyStatistic(
        float(np.mean(is_within)), CONFIDENCE_LEVEL - half_width, CONFIDENCE_LEVEL + half_width
    )
