"""Invert the Cholesky factors of symmetric matrices, with NumPy or with JAX."""

import jax.numpy as jnp
import numpy as np
from jax.lax.linalg import triangular_solve
from jaxtyping import Float
from scipy.linalg import get_lapack_funcs

from ..runtime.array_namespace import AnyArray, array_namespace

_cholesky, _invert_triangular = get_lapack_funcs(("potrf", "trtri"))


def inverse_cholesky_factor(matrix: Float[AnyArray, "*batch n n"]) -> Float[AnyArray, "*batch n n"]:
    """Return the inverse F of the lower Cholesky factor of a matrix A, so that `F A F^T = 1`.

    NaN, without an error, if a matrix is not positive definite.
    """
    xp = array_namespace(matrix)
    if xp is jnp:
        factor = jnp.linalg.cholesky(matrix)
        identity = jnp.broadcast_to(jnp.eye(factor.shape[-1]), factor.shape)
        return triangular_solve(factor, identity, left_side=True, lower=True)
    if matrix.ndim == 2 and matrix.size:
        # NumPy does not use that the matrix is triangular, which takes four times as long.
        factor, info = _cholesky(matrix, lower=1)
        return _invert_triangular(factor, lower=1)[0] if info == 0 else np.full_like(matrix, np.nan)
    # In units with a diagonal of one, pivoting does not depend on the units of the matrix.
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = 1.0 / np.sqrt(np.diagonal(matrix, axis1=-2, axis2=-1))
    try:
        factor = np.linalg.cholesky(matrix * unit[..., None] * unit[..., None, :])
    except np.linalg.LinAlgError:
        return np.full_like(matrix, np.nan)
    return _inverse_of_lower(factor) * unit[..., None, :]


def _inverse_of_lower(factor: Float[np.ndarray, "*batch n n"]) -> Float[np.ndarray, "*batch n n"]:
    """Return the inverses of many small lower triangular matrices, row by row."""
    # NumPy does not use that the matrices are triangular, which takes three times as long.
    inverse = np.zeros_like(factor)
    for k in range(factor.shape[-1]):
        row = factor[..., k : k + 1, :k] @ inverse[..., :k, :k]
        inverse[..., k, k] = 1.0 / factor[..., k, k]
        inverse[..., k, :k] = -row[..., 0, :] * inverse[..., k, k, None]
    return inverse
