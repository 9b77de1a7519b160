"""Compute how much of the remaining errors a change at each view would explain, to first order.

A change at a view adds columns to a linear model that are zero before it. With errors r and columns
A and K of the model and of the change, all in standard deviations of the errors, the change lowers
the sum of squares by

    s^T (K^T K - K^T A (A^T A)^-1 A^T K)^-1 s,    s = K^T r

where r is what A leaves over. The sums over the later views are running sums, so that all places
cost as much as one.
"""

import numpy as np
from jaxtyping import Float

from .misfit_evidence import error_variances, in_parts

MIN_EIGENVALUE = 1e-9
"""Smallest eigenvalue of normal equations, over the largest, that counts as determined."""


def step_gains(
    errors: Float[np.ndarray, "views 6"],
    model: Float[np.ndarray, "views 6 numbers"],
    step: Float[np.ndarray, "views 6 added"],
) -> Float[np.ndarray, "views"]:
    """Return by how much a step from each view on lowers minus twice the log-likelihood.

    Args:
        errors: what the likeliest numbers of the model leave over, m and rad.
        model: derivatives of the errors by the numbers of the model.
        step: derivatives by the numbers of the step, in the views after it.
    """
    sigmas = np.repeat(np.sqrt(error_variances(in_parts(errors))), 3)
    scaled = errors / sigmas
    A, K = (_of_unit_length(columns / sigmas[:, None]) for columns in (model, step))
    inverse = _inverses(np.einsum("vin,vim->nm", A, A))
    along, squares, shared = (
        np.cumsum(products[::-1], axis=0)[::-1]
        for products in (
            np.einsum("vik,vi->vk", K, scaled),
            K.swapaxes(1, 2) @ K,
            K.swapaxes(1, 2) @ A,
        )
    )
    information = squares - shared @ inverse @ shared.swapaxes(1, 2)
    explained = np.einsum("vk,vkl,vl->v", along, _inverses(information), along) / errors.size
    return -errors.size * np.log1p(-np.clip(explained, 0.0, 1.0 - 1e-12))


def _of_unit_length(columns: Float[np.ndarray, "views 6 numbers"]) -> np.ndarray:
    """Return columns whose units do not differ by orders."""
    return columns / np.maximum(np.linalg.norm(columns, axis=(0, 1)), 1e-300)


def _inverses(matrices: Float[np.ndarray, "*batch n n"]) -> Float[np.ndarray, "*batch n n"]:
    """Return inverses of normal equations, zero along what they do not determine."""
    return np.linalg.pinv(matrices, rcond=MIN_EIGENVALUE, hermitian=True)
