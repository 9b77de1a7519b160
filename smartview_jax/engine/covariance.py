"""Covariance of the fitted parameters, from the normal equations at the optimum."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .problem import JointProblem

NULL = 3e-7
"""Singular value, of a Jacobian with unit columns, under which a direction is not seen at all.

Normal equations in double precision resolve singular values down to about 1e-8.
"""


class UnitColumns:
    """The Jacobian of the shared parameters, with unit columns, by its singular values.

    Attributes:
        lengths: of the columns; one where a column is zero.
        singular: values, largest first; 1 is as good as it gets.
        directions: a row each.
    """

    def __init__(self, reduced: Float[np.ndarray, "n n"], lengths: Float[np.ndarray, "n"]):
        """From `J^T J` with the views' own numbers eliminated, and its columns' lengths before."""
        self.lengths = np.where(lengths > 0.0, lengths, 1.0)
        values, vectors = np.linalg.eigh(reduced / np.outer(self.lengths, self.lengths))
        self.singular = np.sqrt(np.maximum(values, 0.0))[::-1]
        self.directions = vectors.T[::-1]


def variance_factor(
    problem: JointProblem, squares: Float[Array, "views points"]
) -> Float[Array, ""]:
    """By how much the assumed variance of a pixel is wrong, from all residuals.

    With a robust loss by the median: what the loss makes little of must not count here.

    Args:
        problem: a free parameter with a prior takes no degree of freedom from the residuals.
        squares: of its whitened residuals, as `JointProblem.squares` has them.
    """
    visible, weight = problem.observations.visible, problem.prior_weight
    if problem.loss is not None:
        return robust_variance(squares, visible)
    shared = weight.shared[problem.chosen] == 0.0
    own = problem.own_free & (weight.corrections == 0.0)
    free = jnp.sum(shared.astype(float)) + jnp.sum(own.astype(float))
    return jnp.sum(squares) / jnp.maximum(2.0 * jnp.sum(visible.astype(float)) - free, 1.0)


def robust_variance(
    squares: Float[Array, "views points"], visible: Bool[Array, "views points"]
) -> Float[Array, ""]:
    """Variance per component from the median: half the points lie within 2 log 2 of it.

    One where nothing was seen.
    """
    middle = jnp.nanmedian(jnp.where(visible, squares, jnp.nan)) / (2.0 * jnp.log(2.0))
    return jnp.where(jnp.isnan(middle), 1.0, jnp.maximum(middle, 1e-24))


def covariance(
    columns: UnitColumns, variance_factor: float
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n"]]:
    """Covariance of the shared parameters that are free, and their standard deviations.

    `variance_factor (J^T J)^-1`. A parameter that takes part in a direction the data do not see
    has an infinite standard deviation; the covariance of the others is that of the directions seen.

    Args:
        columns: of the Jacobian at the optimum.
        variance_factor: by which the assumed variances are wrong: 1 where they are known.
    """
    seen = columns.singular > NULL
    inverse = np.where(seen, 1.0 / np.where(seen, columns.singular, 1.0), 0.0)
    root = (columns.directions.T * inverse) * (1.0 / columns.lengths)[:, None]
    full = variance_factor * root @ root.T
    std = np.sqrt(np.diag(full))
    open_part = np.abs(columns.directions[~seen]).max(axis=0, initial=0.0) > 1e-6
    return full, np.where(open_part, np.inf, std)


def own_std(
    own_inverse: Float[np.ndarray, "views 6 6"],
    gain: Float[np.ndarray, "views 6 n"],
    shared_covariance: Float[np.ndarray, "n n"],
    variance_factor: float,
) -> Float[np.ndarray, "views 6"]:
    """Standard deviations of each view's own numbers.

    Args:
        own_inverse: of each view's own block.
        gain: that times its border with the shared parameters.
        shared_covariance: as `covariance` has it.
        variance_factor: as in `covariance`.
    """
    alone = variance_factor * np.diagonal(own_inverse, axis1=1, axis2=2)
    through_shared = np.einsum("vki,ij,vkj->vk", gain, shared_covariance, gain)
    return np.sqrt(alone + through_shared)
