"""Compute how much less the residuals cost without a click, without another fit."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

RELATIVE_EIGENVALUE_FLOOR = 1e-8
"""Smallest eigenvalue, over the trace of the whole matrix, that is not treated as zero."""


class ClickDeletion(NamedTuple):
    """The squared residuals of a click and of the others, over their covariance.

    Attributes:
        chi_square: decrease without the click.
        degrees_of_freedom: numbers of the click that the others predict, up to two.
        rest: what remains.
    """

    chi_square: float
    degrees_of_freedom: int
    rest: float


def deletion_of(
    Q: Float[np.ndarray, "rows rows"], r: Float[np.ndarray, "rows"], click: int
) -> ClickDeletion:
    """Return the effect of leaving out one click, to first order.

    Reference: Cook and Weisberg, Residuals and influence in regression, 1982, section 2.2.

    Args:
        Q: matrix of the least chi-square over all unknowns, `r^T Q r`.
        r: residuals; each click has two rows.
        click: number of the click.
    """
    # Without the rows i of a click r^T Q r is less by (Q r)_i^T Q_ii^-1 (Q r)_i.
    rows = slice(2 * click, 2 * click + 2)
    values, vectors = np.linalg.eigh(Q[rows, rows])
    used = values > RELATIVE_EIGENVALUE_FLOOR * max(np.trace(Q), 1e-300)
    parts = vectors.T @ (Q @ r)[rows]
    chi_square = float(np.sum(parts[used] ** 2 / values[used]))
    rest = max(float(r @ Q @ r) - chi_square, 0.0)
    return ClickDeletion(chi_square, int(used.sum()), rest)
