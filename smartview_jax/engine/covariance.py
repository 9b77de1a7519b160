"""Covariance matrix of the fitted parameters, from the normal equations at the optimum."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..runtime.array_namespace import AnyArray, AnyScalar, array_namespace

if TYPE_CHECKING:
    from .problem import JointProblem
    from .schur import BlockArrow

RANK_TOLERANCE = 3e-7
"""Singular value, of the Jacobian with unit columns, below which a direction is unobservable.

Normal equations in double precision resolve singular values down to about 1e-8.
"""


KNOWN_VARIANCE = 1e-12
"""Variance of a combination of standardised parameters below which it counts as known exactly.

Smaller ones are rounding in double precision.
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
        self.column_norms: Float[np.ndarray, "free"] = np.where(
            column_norms > 0.0, column_norms, 1.0
        )
        # D^-1 (J^T J) D^-1 = V diag(s^2) V^T, with D the column norms: s and V are the singular
        # values and the right singular vectors of J D^-1. `eigh` sorts upwards, hence the reversal.
        values, vectors = np.linalg.eigh(
            reduced_matrix / np.outer(self.column_norms, self.column_norms)
        )
        self.singular_values: Float[np.ndarray, "free"] = np.sqrt(np.maximum(values, 0.0))[::-1]
        self.right_singular_vectors: Float[np.ndarray, "free free"] = vectors.T[::-1]


class ReducedEquations(NamedTuple):
    """The normal equations of the shared parameters, the views' own eliminated, on the host.

    Attributes:
        schur_complement: matrix of the shared parameters alone.
        per_view_inverse: inverse of each view's own block.
        gain: this inverse times the view's border block with the shared parameters.
    """

    schur_complement: Float[np.ndarray, "n n"]
    per_view_inverse: Float[np.ndarray, "views 6 6"]
    gain: Float[np.ndarray, "views 6 n"]

    def per_view_covariance(
        self, shared_covariance: Float[np.ndarray, "n n"]
    ) -> Float[np.ndarray, "views 6 6"]:
        """Return the covariance of each view's own parameters from the shared parameters'."""
        # Cov(y_v) = D_v^-1 + K_v C K_v^T with the gain K_v = D_v^-1 B_v and C = Cov(x).
        return self.per_view_inverse + self.gain @ shared_covariance @ np.swapaxes(self.gain, 1, 2)


def reduced_equations(matrix: "BlockArrow") -> ReducedEquations:
    """Eliminate every view's own parameters from the normal equations, as `eliminate` does.

    A block without an inverse gives NaN, not an error.
    """
    shared, border, per_view = map(np.asarray, (matrix.shared, matrix.border, matrix.per_view))
    try:
        inverse = np.linalg.inv(per_view)
    except np.linalg.LinAlgError:
        inverse = np.full_like(per_view, np.nan)
    gain = inverse @ border
    return ReducedEquations(shared - np.einsum("vki,vkj->ij", border, gain), inverse, gain)


def variance_factor(
    problem: "JointProblem", squared_residuals: Float[AnyArray, "views points"]
) -> AnyScalar:
    """Estimate the factor by which the assumed pixel variance is wrong, from all residuals.

    It is the sum of squared whitened residuals over the degrees of freedom. With a robust loss it
    is estimated from the median, so that outliers do not inflate it.

    Args:
        problem: the problem; a free parameter with a prior does not reduce the degrees of freedom.
        squared_residuals: squared whitened residuals of the points, as
            `JointProblem.squared_residuals` returns them.
    """
    xp = array_namespace(squared_residuals)
    if problem.loss is not None:
        return robust_variance(squared_residuals, xp.asarray(problem.observations.visible))
    return variance_of_sum(problem, xp.sum(squared_residuals))


def variance_of_sum(problem: "JointProblem", sum_of_squares: AnyScalar) -> AnyScalar:
    """Estimate the `variance_factor` of least squares from the sum of all squared residuals."""
    # sum |r|^2 / (2 n - p), with n visible points and p free parameters without a prior.
    xp, weight = array_namespace(sum_of_squares), problem.prior_weight
    visible = xp.asarray(problem.observations.visible)
    shared = xp.asarray(weight.shared)[xp.asarray(problem.free)] == 0.0
    per_view = xp.asarray(problem.per_view_free) & (xp.asarray(weight.per_view) == 0.0)
    free, seen = (xp.sum(shared) + xp.sum(per_view)).astype(float), xp.sum(visible).astype(float)
    return sum_of_squares / xp.maximum(2.0 * seen - free, 1.0)


def robust_variance(
    squared_residuals: Float[AnyArray, "views points"], visible: Bool[AnyArray, "views points"]
) -> AnyScalar:
    """Estimate the variance per component from the median of the squared residuals.

    The result is one if no point is visible.
    """
    # |r|^2 / sigma^2 of a two-component residual is chi-square with 2 degrees of freedom, whose
    # median is 2 log 2: median |r|^2 = 2 log 2 sigma^2.
    xp = array_namespace(squared_residuals)
    if xp is np and not np.any(visible):
        return np.asarray(1.0)
    variance = xp.nanmedian(xp.where(visible, squared_residuals, xp.nan)) / (2.0 * np.log(2.0))
    return xp.where(xp.isnan(variance), 1.0, xp.maximum(variance, 1e-24))


def covariance(
    jacobian: ScaledJacobian, variance_factor: float
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n"]]:
    """Compute the covariance of the free shared parameters, and their standard deviations.

    The covariance is `variance_factor (J^T J)^-1`. A parameter with a component along an
    unobservable direction has an infinite standard deviation; the covariance of the others is
    computed from the observable directions.

    Args:
        jacobian: decomposition of the Jacobian at the optimum.
        variance_factor: factor by which the assumed variances are wrong; 1 if they are known.
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


def covariance_by_names(
    covariance: Float[np.ndarray, "n n"],
    std: Float[np.ndarray, "n"],
    named_by_fitted: Float[np.ndarray, "n n"] | None,
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n"]]:
    """Return the covariance of parameters as they are named, and their standard deviations.

    Args:
        covariance: covariance of the parameters that were fitted.
        std: their standard deviations; infinite where nothing determines them.
        named_by_fitted: as `AbstractProblem.host_named_by_fitted` returns it.
    """
    if named_by_fitted is None:
        return covariance, std
    named = named_by_fitted @ covariance @ named_by_fitted.T
    is_open = (named_by_fitted != 0.0) @ np.isinf(std)
    return named, np.where(is_open, np.inf, np.sqrt(np.diagonal(named)))


def per_view_std(
    equations: ReducedEquations,
    shared_covariance: Float[np.ndarray, "n n"],
    variance_factor: float,
    roots: Float[np.ndarray, "views 6 6"] | None = None,
) -> Float[np.ndarray, "views 6"]:
    """Compute the standard deviations of each view's own parameters, or of their twists.

    Args:
        equations: the reduced normal equations.
        shared_covariance: covariance of the shared parameters, as `covariance` returns it.
        variance_factor: as in `covariance`.
        roots: twists by the views' own parameters, if those are asked for.
    """
    # Cov(y_v) = f D^-1 + K C K^T for the view's own parameters y_v, with D their block, K = D^-1 B
    # the gain, C the covariance of the shared parameters and f the variance factor.
    inverse, gain = equations.per_view_inverse, equations.gain
    if roots is not None:
        inverse, gain = roots @ inverse @ roots.swapaxes(1, 2), roots @ gain
    conditional_variance = variance_factor * np.diagonal(inverse, axis1=1, axis2=2)
    return np.sqrt(conditional_variance + np.sum((gain @ shared_covariance) * gain, axis=2))


def inverse_of_covariance(covariance: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return the information matrix of a covariance; not finite if the covariance is not.

    A combination of parameters that is known exactly counts as one with the variance
    `KNOWN_VARIANCE`.
    """
    # Pixels and radians differ by many orders of magnitude: invert the correlations instead.
    scale = np.sqrt(np.diagonal(covariance))
    correlations = covariance / np.outer(scale, scale)
    if not np.isfinite(correlations).all():
        return np.full(covariance.shape, np.nan)
    values, vectors = np.linalg.eigh(correlations)
    if values[0] > KNOWN_VARIANCE:
        return np.linalg.inv(correlations) / np.outer(scale, scale)
    # The focal lengths of square pixels are one number, and their difference is known exactly.
    inverse = (vectors / np.maximum(values, KNOWN_VARIANCE)) @ vectors.T
    return inverse / np.outer(scale, scale)


def covariance_factor(
    covariance: Float[np.ndarray, "*batch n n"],
) -> Float[np.ndarray, "*batch n n"]:
    """Return a matrix R with R R^T equal to a covariance, which may be singular."""
    # Not a Cholesky factor, because averaged models can have a covariance without full rank. From
    # correlations, because metres, radians and pixels differ by many orders of magnitude. Rounding
    # may make the smallest eigenvalues slightly negative.
    scale = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1).clip(0.0))
    safe = np.where(scale > 0.0, scale, 1.0)
    correlations = covariance / (safe[..., :, None] * safe[..., None, :])
    eigenvalues, vectors = np.linalg.eigh(correlations)
    return scale[..., :, None] * vectors * np.sqrt(eigenvalues.clip(0.0))[..., None, :]
