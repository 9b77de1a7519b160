"""The normal equations of the joint fit as a block arrow matrix, and their solution.

    [ shared   border^T ]
    [ border   per_view ]

A view's own parameters are coupled to the shared parameters, but not to other views' parameters:
`per_view` is block diagonal, with one block per view. They are therefore eliminated view by view
(Schur complement), which leaves one small system in the shared parameters.
With A = shared, B = border, D = per_view and the right-hand side (a, b), the reduced system is

    (A - sum_v B_v^T D_v^-1 B_v) x = a - sum_v B_v^T D_v^-1 b_v,    y_v = D_v^-1 b_v - D_v^-1 B_v x

The work is divided as follows.

- For every step that is tried: one linearisation of all observations (`problem.py`).
- For every value of the damping: the inverse Cholesky factor of each 6 x 6 block D_v, the gains
  D_v^-1 B_v, the Schur complement and its Cholesky factorisation (`SchurCholesky.init`).
- For every right-hand side: products and solves with these factors (`SchurCholesky.compute`).

Reference: Triggs et al., Bundle adjustment: a modern synthesis, 1999, section 6.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax.lax.linalg import triangular_solve
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float
from scipy.linalg import get_lapack_funcs

from ..runtime.array_namespace import AnyArray, array_namespace
from ..runtime.compilation import is_traced, one_program
from .parameters import Step

_cholesky, _invert_triangular = get_lapack_funcs(("potrf", "trtri"))

MAX_SINGLE_FACTORS = 16
"""Largest number of matrices that LAPACK factorises one by one; NumPy takes as long for 20 at once.

It was measured for the 6 x 6 blocks of the views: 6 instead of 29 microseconds for three of them.
"""


class BlockArrow(lx.AbstractLinearOperator):
    """A symmetric positive semidefinite linear operator on `Step`s, with the shape of an arrow.

    Attributes:
        shared: block of the parameters common to all views.
        border: blocks of each view's own parameters (rows) by the shared ones (columns).
        per_view: diagonal block of each view's own parameters; empty without any.
    """

    # As of a `HostModule`, which cannot be a base of Lineax's operators.
    __getattribute__ = object.__getattribute__

    shared: Float[Array, "shared shared"]
    border: Float[Array, "views 6 shared"]
    per_view: Float[Array, "views 6 6"]

    def mv(self, vector: Step) -> Step:
        """Multiply the matrix by a vector."""
        shared, per_view = vector.shared, vector.per_view
        return Step(
            self.shared @ shared + jnp.einsum("vki,vk->i", self.border, per_view),
            jnp.einsum("vki,i->vk", self.border, shared)
            + jnp.einsum("vkl,vl->vk", self.per_view, per_view),
        )

    @one_program
    def as_matrix(self) -> Float[Array, "all all"]:
        """Return the dense matrix, the shared parameters first."""
        n, views = len(self.shared), len(self.per_view)
        border = self.border.reshape(6 * views, n)
        # Views are not coupled: blocks whose row and column belong to different views are zero.
        same_view = jnp.eye(views)[:, None, :, None]
        per_view = (same_view * self.per_view[:, :, None, :]).reshape(6 * views, 6 * views)
        return jnp.block([[self.shared, border.T], [border, per_view]])

    def transpose(self) -> "BlockArrow":
        """Return the operator itself, which is symmetric."""
        return self

    def in_structure(self) -> Any:
        """Return the shapes of the vectors that the operator takes."""
        # Lineax calls this for every new operator, and `jax.eval_shape` would take a millisecond of
        # a fit that takes twenty. Inside a program `eval_shape` is needed for the sharding.
        if is_traced(self.shared, self.per_view):
            return jax.eval_shape(self.diagonal)
        shared, views = self.shared, self.per_view.shape[:-1]
        return Step(
            jax.ShapeDtypeStruct(shared.shape[:-1], shared.dtype),  # pyright: ignore[reportArgumentType]
            jax.ShapeDtypeStruct(views, self.per_view.dtype),  # pyright: ignore[reportArgumentType]
        )

    def out_structure(self) -> Any:
        """Return the shapes of the vectors that the operator returns."""
        return self.in_structure()

    def diagonal(self) -> Step:
        """Return the diagonal as a `Step`."""
        return Step(jnp.diagonal(self.shared), jnp.diagonal(self.per_view, axis1=1, axis2=2))

    def scaled(self, scale: Step) -> "BlockArrow":
        """Return the matrix in other units, `diag(scale) @ self @ diag(scale)`."""
        shared, per_view = scale.shared, scale.per_view
        return BlockArrow(
            self.shared * shared[:, None] * shared[None],
            self.border * per_view[..., None] * shared[None, None],
            self.per_view * per_view[..., None] * per_view[..., None, :],
        )

    def damped(self, damping: Float[Array, ""]) -> "BlockArrow":
        """Return the matrix with a damping added to its diagonal."""
        return BlockArrow(
            self.shared + damping * jnp.eye(len(self.shared)),
            self.border,
            self.per_view + damping * jnp.eye(6)[None],
        )


# Lineax queries the properties of an operator by single dispatch; a custom operator has to register
# each of them.
for _predicate, _answer in (
    (lx.is_symmetric, True),
    (lx.is_positive_semidefinite, True),
    (lx.is_negative_semidefinite, False),
    (lx.is_diagonal, False),
    (lx.is_tridiagonal, False),
    (lx.is_lower_triangular, False),
    (lx.is_upper_triangular, False),
    (lx.has_unit_diagonal, False),
):
    _predicate.register(BlockArrow)(lambda _, answer=_answer: answer)
for _conversion in (lx.linearise, lx.materialise, lx.conj):
    _conversion.register(BlockArrow)(lambda operator: operator)


class Elimination(eqx.Module):
    """A `BlockArrow` from which every view's own parameters are eliminated.

    Attributes:
        schur_complement: Schur complement, the normal equations of the shared parameters alone.
        per_view_whitening: inverse Cholesky factor of each view's own block.
        gain: inverse of each view's own block times its border block.
    """

    schur_complement: Float[Array, "shared shared"]
    per_view_whitening: Float[Array, "views 6 6"]
    gain: Float[Array, "views 6 shared"]


def eliminate(operator: BlockArrow) -> Elimination:
    """Eliminate every view's own parameters from the normal equations.

    A block that is not positive definite gives NaN, not an error.
    """
    # With F_v D_v F_v^T = 1 and E_v = F_v B_v: K_v = F_v^T E_v,  S = A - sum_v E_v^T E_v.
    # Products with the inverses of small factors take a third of the time of triangular solves.
    whitening = jnp.asarray(inverse_cholesky_factor(operator.per_view))
    whitened_border = whitening @ operator.border
    gain = jnp.swapaxes(whitening, 1, 2) @ whitened_border
    schur_complement = operator.shared - jnp.einsum("vki,vkj->ij", whitened_border, whitened_border)
    return Elimination(schur_complement, whitening, gain)


class _State(eqx.Module):
    """The factors of one matrix, for any number of right-hand sides."""

    elimination: Elimination
    factor: Float[Array, "shared shared"]


class SchurCholesky(lx.AbstractLinearSolver):
    """A linear solver for a `BlockArrow`, damped or not: Schur complement and Cholesky."""

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> _State:
        """Factorise the matrix; runs once per value of the damping."""
        del options
        elimination = eliminate(_as_block_arrow(operator))
        return _State(elimination, cho_factor(elimination.schur_complement)[0])

    def compute(
        self, state: _State, vector: Step, options: dict[str, Any]
    ) -> tuple[Step, lx.RESULTS, dict[str, Any]]:
        """Solve for one right-hand side with the factors of `init`."""
        del options
        elimination = state.elimination
        # S x = a - sum_v K_v^T b_v, then y_v = D_v^-1 b_v - K_v x
        reduced_rhs = vector.shared - jnp.einsum("vki,vk->i", elimination.gain, vector.per_view)
        shared = cho_solve((state.factor, False), reduced_rhs)
        whitening = elimination.per_view_whitening
        whitened = jnp.einsum("vkl,vl->vk", whitening, vector.per_view)
        per_view = jnp.einsum("vlk,vl->vk", whitening, whitened)
        per_view = per_view - jnp.einsum("vki,i->vk", elimination.gain, shared)
        return Step(shared, per_view), lx.RESULTS.successful, {}

    def transpose(self, state: _State, options: dict[str, Any]) -> tuple[_State, dict[str, Any]]:
        """Return the same factors, since the operator is symmetric."""
        return state, options

    def conj(self, state: _State, options: dict[str, Any]) -> tuple[_State, dict[str, Any]]:
        """Return the same factors, since the operator is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """Return True: a singular matrix has to be damped first."""
        return True


def _as_block_arrow(operator: lx.AbstractLinearOperator) -> BlockArrow:
    """Return the operator that optimistix makes of a damped `BlockArrow` as a `BlockArrow` again.

    Raises:
        ValueError: the operator is not a `BlockArrow`, with or without a multiple of the identity.
    """
    if isinstance(operator, BlockArrow):
        return operator
    # Optimistix builds H + lambda I as tagged(H + lambda * identity): take these layers off again.
    if isinstance(operator, lx.TaggedLinearOperator):
        return _as_block_arrow(operator.operator)
    if isinstance(operator, lx.AddLinearOperator):
        scaled = operator.operator2
        if isinstance(scaled, lx.MulLinearOperator) and isinstance(
            scaled.operator, lx.IdentityLinearOperator
        ):
            return _as_block_arrow(operator.operator1).damped(scaled.scalar)
    raise ValueError(
        f"SchurCholesky solves a BlockArrow, damped or not; found {type(operator).__name__}"
    )


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
    if 0 < matrix.size <= MAX_SINGLE_FACTORS * matrix.shape[-1] ** 2:
        blocks = matrix.reshape(-1, *matrix.shape[-2:])
        return np.array([inverse_cholesky_factor(x) for x in blocks]).reshape(matrix.shape)
    # In units with a diagonal of one, pivoting does not depend on the units of the matrix.
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = 1.0 / np.sqrt(np.diagonal(matrix, axis1=-2, axis2=-1))
    try:
        factor = np.linalg.cholesky(matrix * unit[..., None] * unit[..., None, :])
    except np.linalg.LinAlgError:
        if matrix.ndim == 2:
            return np.full_like(matrix, np.nan)
        # NumPy does not say which one it was.
        return np.array([inverse_cholesky_factor(x) for x in matrix])
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
