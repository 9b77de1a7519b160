"""Covariance matrix of the fitted parameters, from the normal equations at the optimum."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .problem import JointProblem

RANK_TOLERANCE = 3e-7
"""Singular value, of the Jacobian with unit columns, below which a direction is unobservable.

Normal equations in double precision resolve singular values down to about 1e-8.
"""


class ScaledJacobian:
    """The singular value decomposition of the shared parameters' Jacobian, scaled to unit columns.

    Attributes:
        column_norms: lengths of the columns before scaling; one where a column is zero.
        singular_values: singular values, largest first; 1 is the best possible.
        right_singular_vectors: right singular vectors, one per row.
    """

    def __init__(
        self, reduced_matrix: Float[np.ndarray, "n n"], column_norms: Float[np.ndarray, "n"]
    ):
        """Decompose the reduced normal equations.

        Args:
            reduced_matrix: `J^T J` with the views' own parameters eliminated.
            column_norms: lengths of the Jacobian's columns before that elimination.
        """
        self.column_norms = np.where(column_norms > 0.0, column_norms, 1.0)
        # D^-1 (J^T J) D^-1 = V diag(s^2) V^T, with D the column norms: s and V are the singular
        # values and the right singular vectors of J D^-1. `eigh` sorts upwards, hence the reversal.
        values, vectors = np.linalg.eigh(
            reduced_matrix / np.outer(self.column_norms, self.column_norms)
        )
        self.singular_values = np.sqrt(np.maximum(values, 0.0))[::-1]
        self.right_singular_vectors = vectors.T[::-1]


def variance_factor(
    problem: JointProblem, squared_residuals: Float[Array, "views points"]
) -> Float[Array, ""]:
    """Estimate the factor by which the assumed pixel variance is wrong, from all residuals.

    It is the sum of squared whitened residuals over the degrees of freedom. With a robust loss it
    is estimated from the median, since outliers must not inflate it.

    Args:
        problem: the problem; a free parameter with a prior takes no degree of freedom from the
            residuals.
        squared_residuals: squared whitened residuals of the points, as
            `JointProblem.squared_residuals` returns them.
    """
    visible, weight = problem.observations.visible, problem.prior_weight
    if problem.loss is not None:
        return robust_variance(squared_residuals, visible)
    # sum |r|^2 / (2 n - p), with n visible points and p free parameters without a prior.
    shared = weight.shared[problem.free_indices] == 0.0
    per_view = problem.per_view_free & (weight.per_view == 0.0)
    free = jnp.sum(shared.astype(float)) + jnp.sum(per_view.astype(float))
    return jnp.sum(squared_residuals) / jnp.maximum(
        2.0 * jnp.sum(visible.astype(float)) - free, 1.0
    )


def robust_variance(
    squared_residuals: Float[Array, "views points"], visible: Bool[Array, "views points"]
) -> Float[Array, ""]:
    """Estimate the variance per component from the median of the squared residuals.

    The result is one if no point is visible.
    """
    # |r|^2 / sigma^2 of a two-component residual is chi-square with 2 degrees of freedom, whose
    # median is 2 log 2: median |r|^2 = 2 log 2 sigma^2.
    variance = jnp.nanmedian(jnp.where(visible, squared_residuals, jnp.nan)) / (2.0 * jnp.log(2.0))
    return jnp.where(jnp.isnan(variance), 1.0, jnp.maximum(variance, 1e-24))


def covariance(
    jacobian: ScaledJacobian, variance_factor: float
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n"]]:
    """Compute the covariance of the free shared parameters, and their standard deviations.

    The covariance is `variance_factor (J^T J)^-1`. A parameter with a component along an
    unobservable direction has an infinite standard deviation; the covariance of the others is
    computed from the observable directions.

    Args:
        jacobian: decomposition of the Jacobian at the optimum.
        variance_factor: factor by which the assumed variances are wrong: 1 where they are known.
    """
    observable = jacobian.singular_values > RANK_TOLERANCE
    inverse = np.where(observable, 1.0 / np.where(observable, jacobian.singular_values, 1.0), 0.0)
    # (J^T J)^-1 = R R^T with R = D^-1 V diag(1 / s), over the observable directions.
    root = (jacobian.right_singular_vectors.T * inverse) * (1.0 / jacobian.column_norms)[:, None]
    full = variance_factor * root @ root.T
    std = np.sqrt(np.diag(full))
    # Right singular vectors have unit length: 1e-6 is rounding, and more is a real component.
    has_null_component = (
        np.abs(jacobian.right_singular_vectors[~observable]).max(axis=0, initial=0.0) > 1e-6
    )
    return full, np.where(has_null_component, np.inf, std)


def per_view_std(
    per_view_inverse: Float[np.ndarray, "views 6 6"],
    gain: Float[np.ndarray, "views 6 n"],
    shared_covariance: Float[np.ndarray, "n n"],
    variance_factor: float,
) -> Float[np.ndarray, "views 6"]:
    """Compute the standard deviations of each view's own parameters.

    Args:
        per_view_inverse: inverse of each view's own block of the normal equations.
        gain: that inverse times the view's border block with the shared parameters.
        shared_covariance: covariance of the shared parameters, as `covariance` returns it.
        variance_factor: as in `covariance`.
    """
    # Cov(y_v) = f D^-1 + K C K^T for the view's own parameters y_v, with D their block, K = D^-1 B
    # the gain, C the covariance of the shared parameters and f the variance factor.
    conditional_variance = variance_factor * np.diagonal(per_view_inverse, axis1=1, axis2=2)
    shared_contribution = np.einsum("vki,ij,vkj->vk", gain, shared_covariance, gain)
    return np.sqrt(conditional_variance + shared_contribution)
