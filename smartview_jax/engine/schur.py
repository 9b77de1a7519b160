"""The normal equations of the joint fit as a matrix with an arrow's shape, and their solution.

    [ shared   border^T ]
    [ border   own      ]

Every view's own numbers meet those that all views share and no other view's, so they are eliminated
view by view (Schur complement) and one small system is left.

Reference: Triggs et al., Bundle adjustment: a modern synthesis, 1999, section 6.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float

from .parameters import Step


class BlockArrow(lx.AbstractLinearOperator):
    """A symmetric positive semidefinite operator on `Step`s.

    Attributes:
        shared: of the numbers that all views share.
        border: each view's own by the shared.
        own: each view's own; no views where there are none.
    """

    shared: Float[Array, "shared shared"]
    border: Float[Array, "views 6 shared"]
    own: Float[Array, "views 6 6"]

    def mv(self, vector: Step) -> Step:
        shared, own = vector.shared, vector.corrections
        return Step(
            self.shared @ shared + jnp.einsum("vki,vk->i", self.border, own),
            jnp.einsum("vki,i->vk", self.border, shared) + jnp.einsum("vkl,vl->vk", self.own, own),
        )

    def as_matrix(self) -> Float[Array, "all all"]:
        n, views = len(self.shared), len(self.own)
        dense = jnp.zeros((n + 6 * views, n + 6 * views)).at[:n, :n].set(self.shared)
        border = self.border.reshape(6 * views, n)
        dense = dense.at[n:, :n].set(border).at[:n, n:].set(border.T)
        for k in range(views):
            i = n + 6 * k
            dense = dense.at[i : i + 6, i : i + 6].set(self.own[k])
        return dense

    def transpose(self) -> "BlockArrow":
        return self

    def in_structure(self) -> Any:
        return jax.eval_shape(self.diagonal)

    def out_structure(self) -> Any:
        return self.in_structure()

    def diagonal(self) -> Step:
        """The diagonal, as a `Step`."""
        return Step(jnp.diagonal(self.shared), jnp.diagonal(self.own, axis1=1, axis2=2))

    def scaled(self, scale: Step) -> "BlockArrow":
        """In other units: `diag(scale) @ self @ diag(scale)`."""
        shared, own = scale.shared, scale.corrections
        return BlockArrow(
            self.shared * shared[:, None] * shared[None],
            self.border * own[..., None] * shared[None, None],
            self.own * own[..., None] * own[..., None, :],
        )

    def damped(self, damping: Float[Array, ""]) -> "BlockArrow":
        """With a number added to the diagonal."""
        return BlockArrow(
            self.shared + damping * jnp.eye(len(self.shared)),
            self.border,
            self.own + damping * jnp.eye(6)[None],
        )


for _asked, _answer in (
    (lx.is_symmetric, True),
    (lx.is_positive_semidefinite, True),
    (lx.is_negative_semidefinite, False),
    (lx.is_diagonal, False),
    (lx.is_tridiagonal, False),
    (lx.is_lower_triangular, False),
    (lx.is_upper_triangular, False),
    (lx.has_unit_diagonal, False),
):
    _asked.register(BlockArrow)(lambda _, answer=_answer: answer)
for _same in (lx.linearise, lx.materialise, lx.conj):
    _same.register(BlockArrow)(lambda operator: operator)


class Elimination(eqx.Module):
    """A `BlockArrow` with every view's own numbers eliminated.

    Attributes:
        reduced: Schur complement of the views' own blocks.
        own_factor: Cholesky factor of each view's own block.
        gain: each view's own block inverse times its border.
    """

    reduced: Float[Array, "shared shared"]
    own_factor: Float[Array, "views 6 6"]
    gain: Float[Array, "views 6 shared"]

    @property
    def own_inverse(self) -> Float[Array, "views 6 6"]:
        """Inverse of each view's own block."""
        each = jnp.broadcast_to(jnp.eye(6)[None], self.own_factor.shape)
        return cho_solve((self.own_factor, False), each)

    def own_covariance(
        self, shared_covariance: Float[Array, "shared shared"]
    ) -> Float[Array, "views 6 6"]:
        """Of each view's own numbers: by themselves, and through the shared parameters."""
        carried = self.gain @ shared_covariance
        return self.own_inverse + jnp.einsum("vki,vli->vkl", carried, self.gain)


def eliminate(operator: BlockArrow) -> Elimination:
    """Eliminate every view's own numbers; a block that is not positive definite gives NaN."""
    factor, _ = cho_factor(operator.own)
    gain = cho_solve((factor, False), operator.border)
    reduced = operator.shared - jnp.einsum("vki,vkj->ij", operator.border, gain)
    return Elimination(reduced, factor, gain)


class _State(eqx.Module):
    elimination: Elimination
    factor: Float[Array, "shared shared"]


class SchurCholesky(lx.AbstractLinearSolver):
    """Solve a `BlockArrow`, also one with a multiple of the identity added, by Cholesky."""

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> _State:
        del options
        elimination = eliminate(_as_block_arrow(operator))
        return _State(elimination, cho_factor(elimination.reduced)[0])

    def compute(
        self, state: _State, vector: Step, options: dict[str, Any]
    ) -> tuple[Step, lx.RESULTS, dict[str, Any]]:
        del options
        parts = state.elimination
        left = vector.shared - jnp.einsum("vki,vk->i", parts.gain, vector.corrections)
        shared = cho_solve((state.factor, False), left)
        own = cho_solve((parts.own_factor, False), vector.corrections[..., None])[..., 0]
        own = own - jnp.einsum("vki,i->vk", parts.gain, shared)
        return Step(shared, own), lx.RESULTS.successful, {}

    def transpose(self, state: _State, options: dict[str, Any]) -> tuple[_State, dict[str, Any]]:
        return state, options

    def conj(self, state: _State, options: dict[str, Any]) -> tuple[_State, dict[str, Any]]:
        return state, options

    def assume_full_rank(self) -> bool:
        return True


def _as_block_arrow(operator: lx.AbstractLinearOperator) -> BlockArrow:
    """What optimistix's damped descents make of a `BlockArrow`, as one again."""
    if isinstance(operator, BlockArrow):
        return operator
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
