"""Compute the slopes of a random walk's restricted likelihood by the sizes of all errors.

With the covariance R of an error, its best estimate r and the covariance P of the prediction, which
is uncertain because unknowns, field and drift are, the deviance changes by

    tr(R^-1 V) - tr(R^-1 V R^-1 P) - r' R^-1 V R^-1 r

for a change V of R (Patterson and Thompson, 1971; the envelope theorem for r). It is the same for
the new errors of the drift and for the field's coefficients, whose covariances are their priors.
The blocks of the inverse of a block tridiagonal matrix that P takes follow from its Cholesky
factor, from the last one to the first.

References: Harville, Maximum likelihood approaches to variance component estimation and to related
problems, 1977 (slopes); Takahashi, Fagan and Chen, Formation of a sparse bus impedance matrix and
its application to short circuit study, 1973 (blocks of the inverse).
"""

import numpy as np
from jaxtyping import Float

from .tracker_drift import SolvedWalk


def deviance_slopes(solved: SolvedWalk) -> Float[np.ndarray, "kinds"]:
    """Return the slopes of the deviance by the logarithms of all standard deviations."""
    walk, used, count = solved.walk, solved.walk.used, len(solved.walk.pairs.parts)
    slopes = np.zeros(len(solved.logarithms))
    numbers, covariances = solved.numbers, None
    if walk.drifts:
        covariances = _drift_covariances(solved)
        # What is left of each column when the drift follows it.
        numbers = numbers - walk.by_drift[used] @ solved.eliminated[used]
        slopes[count + 1 :] = _slopes_by_drift(solved, *covariances)
    columns = numbers[:, :, :-1]
    left_over = numbers[:, :, -1] - columns @ solved.coefficients
    explained = columns @ solved.inverse @ columns.swapaxes(1, 2)
    if covariances is not None:
        by_drift = walk.by_drift[used]
        explained = explained + by_drift @ covariances[0][used] @ by_drift.swapaxes(1, 2)
    explained = explained + left_over[:, :, None] * left_over[:, None]
    by_covariance = solved.information - solved.information @ explained @ solved.information
    traces = walk.pairs.parts[:, used].reshape(count, -1) @ by_covariance.ravel()
    slopes[:count] = 2.0 * np.exp(2.0 * solved.logarithms[:count]) * traces
    told = walk.told.shape[1]
    of_field = solved.coefficients[told:] ** 2 + np.diagonal(solved.inverse)[told:]
    slopes[count] = 2.0 * np.sum(1.0 - of_field)
    return slopes


def _slopes_by_drift(
    solved: SolvedWalk,
    covariances: Float[np.ndarray, "views drifts drifts"],
    with_next: Float[np.ndarray, "steps drifts drifts"],
) -> Float[np.ndarray, "drift_kinds"]:
    """Return the slopes by the sizes of the errors that are new in a view.

    Args:
        solved: the fit.
        covariances, with_next: as of `_drift_covariances`.
    """
    walk, to_step = solved.walk, solved.walk.to_step[1:]
    stds = walk.drift_stds(solved.logarithms)
    new = to_step @ np.diff(solved.eliminated, axis=0)
    errors = new[:, :, -1] - new[:, :, :-1] @ solved.coefficients
    of_columns = np.sum((new[:, :, :-1] @ solved.inverse) * new[:, :, :-1], axis=2)
    given_columns = covariances[1:] + covariances[:-1] - with_next - with_next.swapaxes(1, 2)
    of_drift = np.sum((to_step @ given_columns) * to_step, axis=2)
    by_component = 2.0 * np.sum(1.0 - (errors**2 + of_columns + of_drift) / stds**2, axis=0)
    counts = [count for _, count in walk.drift_units]
    return np.add.reduceat(by_component, np.cumsum([0, *counts[:-1]]))


def _drift_covariances(
    solved: SolvedWalk,
) -> tuple[Float[np.ndarray, "views drifts drifts"], Float[np.ndarray, "steps drifts drifts"]]:
    """Return the covariance of the drift in each view, and its covariance with the next view's.

    All other unknowns are taken as known. The first view has no drift.
    """
    assert solved.factor is not None
    size = solved.walk.by_drift.shape[2]
    count = solved.factor.shape[1] // size
    diagonal, below = _blocks(solved.factor, size)
    inverse = np.linalg.inv(diagonal)
    alone = inverse.swapaxes(1, 2) @ inverse
    back = below @ inverse[:-1]
    covariances = np.zeros((count + 1, size, size))
    with_next = np.zeros((count, size, size))
    covariances[count] = alone[-1]
    # With A = L L', each block follows from the next: L_k' (A^-1)_k,l = -L_l' (A^-1)_l,l by the
    # blocks L_k on the diagonal and L_l below it.
    for k in range(count - 1, 0, -1):
        across = back[k - 1].T @ covariances[k + 1]
        with_next[k] = -across
        covariances[k] = alone[k - 1] + across @ back[k - 1]
    return covariances, with_next


def _blocks(
    factor: Float[np.ndarray, "band drift"], size: int
) -> tuple[Float[np.ndarray, "steps n n"], Float[np.ndarray, "others n n"]]:
    """Return the blocks of a lower band on the diagonal and below it."""
    by_column = factor.reshape(2 * size, -1, size)
    rows, columns = np.indices((size, size))
    below = np.moveaxis(by_column[size + rows - columns, :-1, columns], -1, 0)
    diagonal = np.moveaxis(by_column[np.abs(rows - columns), :, columns], -1, 0)
    return np.tril(diagonal), below
