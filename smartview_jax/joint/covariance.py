"""Covariance of the fitted parameters, from the Jacobian at the optimum."""

import numpy as np


def covariance(
    jacobian: np.ndarray, scale: np.ndarray, variance_factor: float
) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of the free parameters in their own units, and their standard deviations.

    `variance_factor (J^T J)^-1`. A parameter that takes part in a direction the data do not see
    has an infinite standard deviation; the covariance of the others is that of the directions seen.

    Args:
        jacobian: `(rows, free)` of the whitened residuals with respect to scaled parameters.
        scale: `(free,)` size of one unit of each.
        variance_factor: by which the assumed variances are wrong: 1 where they are known.
    """
    lengths = np.linalg.norm(jacobian, axis=0)
    lengths = np.where(lengths > 0.0, lengths, 1.0)
    triangle = np.linalg.qr(jacobian / lengths, mode="r")
    _, singular, Vt = np.linalg.svd(triangle)
    seen = singular > 1e-7
    inverse = np.where(seen, 1.0 / np.where(seen, singular, 1.0), 0.0)
    own = scale / lengths
    root = (Vt.T * inverse) * own[:, None]
    full = variance_factor * root @ root.T
    std = np.sqrt(np.diag(full))
    open_part = np.abs(Vt[~seen]).max(axis=0, initial=0.0) > 1e-6
    return full, np.where(open_part, np.inf, std)
