"""Tell which matrices are covariances, in files and in arguments alike."""

from collections.abc import Sequence

import numpy as np

SMALLEST_EIGENVALUE = 1e-12
"""Smallest eigenvalue of the correlations of a covariance that is to be inverted."""

MAX_ASYMMETRY = 1e-9
"""Largest difference of an entry from the one across the diagonal, over their standard deviations.
"""

ROUNDING = 1e-9
"""Largest negative eigenvalue of a correlation matrix for each parameter, by rounding alone.

Covariances are written with all digits; the solver's rounding is below `MAX_ASYMMETRY`.
"""


def smallest_correlation_eigenvalue(covariances: np.ndarray) -> np.ndarray:
    """Return the smallest eigenvalue of each covariance's correlation matrix, `(*batch)`.

    The covariances are `(*batch, n, n)`. The eigenvalue is the same whatever the units; variances
    in m and px differ by many powers of ten. It is NaN where an entry is not finite or a variance
    is not positive.
    """
    variances = np.diagonal(covariances, axis1=-2, axis2=-1)
    finite = np.asarray(np.isfinite(covariances).all(axis=(-2, -1)))
    valid = finite & np.asarray((variances > 0.0).all(axis=-1))
    stds = np.sqrt(np.where(valid[..., None], variances, 1.0))
    correlations = covariances / (stds[..., :, None] * stds[..., None, :])
    correlations = np.where(valid[..., None, None], correlations, np.eye(stds.shape[-1]))
    return np.where(valid, np.linalg.eigvalsh(correlations)[..., 0], np.nan)


def check_covariance(covariance: Sequence[Sequence[float]], names: Sequence[str]) -> None:
    """Raise a ValueError for a matrix that is not a covariance of the named numbers."""
    count = len(names)
    if len(covariance) != count or any(len(row) != count for row in covariance):
        raise ValueError(f"covariance: expected {count} rows of {count} numbers")
    for i, name in enumerate(names):
        if not covariance[i][i] > 0.0:
            raise ValueError(f"covariance: the variance of {name} is not positive")
        for j in range(i):
            scale = (covariance[i][i] * covariance[j][j]) ** 0.5
            if abs(covariance[i][j] - covariance[j][i]) > MAX_ASYMMETRY * scale:
                raise ValueError(f"covariance: not symmetric in row {i + 1}, column {j + 1}")
    # The rounding error of a computed covariance's eigenvalues scales with the largest.
    if count and smallest_correlation_eigenvalue(np.array(covariance, float)) < -ROUNDING * count:
        raise ValueError(
            "covariance: not positive semidefinite: some combination of the parameters has a "
            "negative variance"
        )
