"""Test whether the uncertainty that a fit states is true, over many runs with a known truth.

The normalised estimation error squared (NEES), `e^T P^-1 e`, is chi-square distributed with as many
degrees of freedom as numbers if the stated covariance `P` is true; and a 95 % interval contains the
truth in 95 runs of a hundred.

Reference: Bar-Shalom, Li and Kirubarajan, Estimation with applications to tracking and navigation,
2001, section 5.4.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtri, ndtri, stdtrit

LEVEL = 0.95
"""The probability of intervals and bands."""


class Measured(NamedTuple):
    """A mean over runs, with the band that contains it with probability `LEVEL`.

    The band holds if all uncertainty is as stated.
    """

    value: float
    low: float
    high: float

    @property
    def within(self) -> bool:
        """Whether the mean lies in its band."""
        return self.low <= self.value <= self.high


def nees(
    errors: Float[np.ndarray, "runs numbers"],
    covariances: Float[np.ndarray, "runs numbers numbers"],
) -> Float[np.ndarray, "runs"]:
    """Return every run's normalised estimation error squared.

    Args:
        errors: estimates minus truth, in any units.
        covariances: stated, in the same units.

    Raises:
        ValueError: a covariance is not positive definite; the message names the run.
    """
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    sound = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
    sound &= np.asarray((variances > 0.0).all(axis=1))
    # Correlations instead of covariances: numbers of very different units keep their precision.
    lengths = np.sqrt(np.where(sound[:, None], variances, 1.0))
    unit = covariances / (lengths[:, :, None] * lengths[:, None])
    unit = np.where(sound[:, None, None], unit, np.eye(variances.shape[1]))
    sound &= np.linalg.eigvalsh(unit)[:, 0] > 0.0
    if not sound.all():
        run = int(np.argmin(sound))
        raise ValueError(f"covariances: that of run {run} is not finite and positive definite")
    scaled = errors / lengths
    return np.einsum("ri,ri->r", scaled, np.linalg.solve(unit, scaled[..., None])[..., 0])


def mean_nees(squares: Float[np.ndarray, "runs"], numbers: int) -> Measured:
    """Return the mean of `nees` and its band; it is near `numbers` if the covariances are true."""
    tail, runs = 0.5 - 0.5 * LEVEL, len(squares)
    # Over n runs the sum is chi-square with n times as many degrees of freedom.
    low, high = (float(chdtri(runs * numbers, p)) / runs for p in (1.0 - tail, tail))
    return Measured(float(np.mean(squares)), low, high)


def covered(
    errors: Float[np.ndarray, "*runs"],
    std: Float[np.ndarray, "*runs"],
    degrees_of_freedom: Float[np.ndarray, "*runs"] | float = np.inf,
) -> Bool[np.ndarray, "*runs"]:
    """Return whether each error lies within its two-sided interval at `LEVEL`.

    Args:
        errors: estimates minus truth.
        std: stated standard deviations.
        degrees_of_freedom: degrees of freedom of the standard deviations (Student's t); infinite
            where they are known.
    """
    degrees, p = np.asarray(degrees_of_freedom, dtype=float), 0.5 + 0.5 * LEVEL
    finite = np.isfinite(degrees)
    # Student's t quantile with finite degrees of freedom, otherwise the normal one.
    times = np.where(finite, stdtrit(np.where(finite, degrees, 1.0), p), ndtri(p))
    return np.abs(errors) <= times * std


def coverage(held: Bool[np.ndarray, "runs"]) -> Measured:
    """Return the fraction of runs whose interval contains the truth.

    Its band is that of the normal approximation.
    """
    # The binomial standard deviation sqrt(p (1 - p) / n) at the stated probability p.
    half = float(ndtri(0.5 + 0.5 * LEVEL) * np.sqrt(LEVEL * (1.0 - LEVEL) / len(held)))
    return Measured(float(np.mean(held)), LEVEL - half, LEVEL + half)
