"""Is what a fit states about its own errors true? Over many runs with a known truth.

NEES, the normalised estimation error squared `e^T P^-1 e`, is chi-square distributed with as many
degrees of freedom as numbers if the stated covariance `P` is true; and an interval of 95 % holds
the truth in 95 runs of a hundred.

Reference: Bar-Shalom, Li and Kirubarajan, Estimation with applications to tracking and navigation,
2001, section 5.4.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtri, ndtri, stdtrit

LEVEL = 0.95
"""Of intervals, and of bands."""


class Measured(NamedTuple):
    """A mean over runs, and the band in which it lies `LEVEL` of the time if all is as stated."""

    value: float
    low: float
    high: float

    @property
    def within(self) -> bool:
        """Whether it lies in its band."""
        return self.low <= self.value <= self.high


def nees(
    errors: Float[np.ndarray, "runs numbers"],
    covariances: Float[np.ndarray, "runs numbers numbers"],
) -> Float[np.ndarray, "runs"]:
    """Every run's squared error in the metric of its stated covariance.

    Args:
        errors: estimates minus truth, in any units.
        covariances: stated, in the same units.

    Raises:
        ValueError: a covariance is not positive definite; the message names the run.
    """
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    sound = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
    sound &= np.asarray((variances > 0.0).all(axis=1))
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
    """The mean of `nees`: the count of numbers, up to chance, where the covariances are true."""
    tail, runs = 0.5 - 0.5 * LEVEL, len(squares)
    low, high = (float(chdtri(runs * numbers, p)) / runs for p in (1.0 - tail, tail))
    return Measured(float(np.mean(squares)), low, high)


def covered(
    errors: Float[np.ndarray, "*runs"],
    std: Float[np.ndarray, "*runs"],
    degrees_of_freedom: Float[np.ndarray, "*runs"] | float = np.inf,
) -> Bool[np.ndarray, "*runs"]:
    """Whether each error lies within its two-sided interval of `LEVEL`.

    Args:
        errors: estimates minus truth.
        std: stated.
        degrees_of_freedom: that the deviations rest on (Student's t); infinite where they are
            known.
    """
    degrees, p = np.asarray(degrees_of_freedom, dtype=float), 0.5 + 0.5 * LEVEL
    finite = np.isfinite(degrees)
    times = np.where(finite, stdtrit(np.where(finite, degrees, 1.0), p), ndtri(p))
    return np.abs(errors) <= times * std


def coverage(held: Bool[np.ndarray, "runs"]) -> Measured:
    """The share of runs that hold the truth; the band is the normal approximation's."""
    half = float(ndtri(0.5 + 0.5 * LEVEL) * np.sqrt(LEVEL * (1.0 - LEVEL) / len(held)))
    return Measured(float(np.mean(held)), LEVEL - half, LEVEL + half)
