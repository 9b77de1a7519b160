"""Covariance matrix of the fitted parameters, from the normal equations at the optimum."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .problem import JointProblem

NULL = 3e-7
"""Singular value, of the Jacobian with unit columns, below which a direction is unobservable.

Normal equations in double precision resolve singular values down to about 1e-8.
"""


class UnitColumns:
    """The singular value decomposition of the shared parameters' Jacobian, scaled to unit columns.

    Attributes:
        lengths: lengths of the columns before scaling; one where a column is zero.
        singular: singular values, largest first; 1 is the best possible.
        directions: right singular vectors, one per row.
    """

    def __init__(self, reduced: Float[np.ndarray, "n n"], lengths: Float[np.ndarray, "n"]):
        """Decompose the reduced normal equations.

        Args:
            reduced: `J^T J` with the views' own parameters eliminated.
            lengths: lengths of the Jacobian's columns before that elimination.
        """
        self.lengths = np.where(lengths > 0.0, lengths, 1.0)
        # D^-1 (J^T J) D^-1 = V diag(s^2) V^T, with D the lengths: s and V are the singular values
        # and the right singular vectors of J D^-1.
        values, vectors = np.linalg.eigh(reduced / np.outer(self.lengths, self.lengths))
        self.singular = np.sqrt(np.maximum(values, 0.0))[::-1]
        self.directions = vectors.T[::-1]


def variance_factor(
    problem: JointProblem, squares: Float[Array, "views points"]
) -> Float[Array, ""]:
    """Estimate the factor by which the assumed pixel variance is wrong, from all residuals.

    It is the sum of squared whitened residuals over the degrees of freedom. With a robust loss it
    is estimated from the median, since outliers must not inflate it.

    Args:
        problem: the problem; a free parameter with a prior takes no degree of freedom from the
            residuals.
        squares: squared whitened residuals of the points, as `JointProblem.squares` returns them.
    """
    visible, weight = problem.observations.visible, problem.prior_weight
    if problem.loss is not None:
        return robust_variance(squares, visible)
    # sum |r|^2 / (2 n - p), with n visible points and p free parameters without a prior.
    shared = weight.shared[problem.chosen] == 0.0
    own = problem.own_free & (weight.corrections == 0.0)
    free = jnp.sum(shared.astype(float)) + jnp.sum(own.astype(float))
    return jnp.sum(squares) / jnp.maximum(2.0 * jnp.sum(visible.astype(float)) - free, 1.0)


def robust_variance(
    squares: Float[Array, "views points"], visible: Bool[Array, "views points"]
) -> Float[Array, ""]:
    """Estimate the variance per component from the median of the squared residuals.

    The result is one if no point is visible.
    """
    # |r|^2 / sigma^2 of a two-component residual is chi-square with 2 degrees of freedom, whose
    # median is 2 log 2: median |r|^2 = 2 log 2 sigma^2.
    middle = jnp.nanmedian(jnp.where(visible, squares, jnp.nan)) / (2.0 * jnp.log(2.0))
    return jnp.where(jnp.isnan(middle), 1.0, jnp.maximum(middle, 1e-24))


def covariance(
    columns: UnitColumns, variance_factor: float
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n"]]:
    """Compute the covariance of the free shared parameters, and their standard deviations.

    The covariance is `variance_factor (J^T J)^-1`. A parameter with a component along an
    unobservable direction has an infinite standard deviation; the covariance of the others is
    computed from the observable directions.

    Args:
        columns: decomposition of the Jacobian at the optimum.
        variance_factor: factor by which the assumed variances are wrong: 1 where they are known.
    """
    seen = columns.singular > NULL
    inverse = np.where(seen, 1.0 / np.where(seen, columns.singular, 1.0), 0.0)
    # (J^T J)^-1 = R R^T with R = D^-1 V diag(1 / s), over the observable directions.
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
    """Compute the standard deviations of each view's own parameters.

    Args:
        own_inverse: inverse of each view's own block of the normal equations.
        gain: that inverse times the view's border block with the shared parameters.
        shared_covariance: covariance of the shared parameters, as `covariance` returns it.
        variance_factor: as in `covariance`.
    """
    # Cov(own) = f D^-1 + K C K^T, with D the view's own block, K = D^-1 B its gain, C the
    # covariance of the shared parameters and f the variance factor.
    alone = variance_factor * np.diagonal(own_inverse, axis1=1, axis2=2)
    through_shared = np.einsum("vki,ij,vkj->vk", gain, shared_covariance, gain)
    return np.sqrt(alone + through_shared)
