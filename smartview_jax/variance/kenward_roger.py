"""Uncertainty of a fit's parameters due to estimated, instead of known, variance components.

References:
    Kackar and Harville, Approximations for standard errors of estimators of fixed and random
    effects in mixed linear models, 1984.
    Kenward and Roger, Small sample inference for fixed effects from restricted maximum likelihood,
    1997.
    Satterthwaite, An approximate distribution of estimates of variance components, 1946.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.special import chdtrc, fdtrc

from .directional_noise import DirectionalNoise, effect_of_directions
from .fisher_scoring import LikelihoodMaximum
from .likelihood import Marginalisation, marginalise
from .linearised_views import LinearisedViews, kinds_of, rows_of_views

VAGUE_PRIOR_LOG_STD = 3.0
"""Prior standard deviation of the logarithm of a standard deviation.

Without information from the views it is the result.
"""


class SmallSampleCorrection(NamedTuple):
    """The contribution of estimated standard deviations of errors to the parameters' uncertainty.

    Attributes:
        relative_std: standard deviations of the logarithms of the errors' standard deviations.
        added_covariance: covariance of the parameters due to the estimated standard deviations.
        degrees_of_freedom: degrees of freedom of each parameter's estimated variance; infinite
            if no estimated standard deviation affects it.
        log_excess_covariance: covariance of the logarithms of the standard deviations' excess over
            their lower bounds.
        covariance_derivatives: derivative of the parameters' covariance by each of these
            logarithms.
    """

    relative_std: Float[np.ndarray, "kinds"]
    added_covariance: Float[np.ndarray, "shared shared"]
    degrees_of_freedom: Float[np.ndarray, "shared"]
    log_excess_covariance: Float[np.ndarray, "kinds kinds"]
    covariance_derivatives: Float[np.ndarray, "kinds shared shared"]

    def subset(self, indices: np.ndarray) -> "SmallSampleCorrection":
        """Return the correction for a subset of the parameters.

        Args:
            indices: indices of these parameters.
        """
        pairs = np.ix_(indices, indices)
        return self._replace(
            added_covariance=self.added_covariance[pairs],
            degrees_of_freedom=self.degrees_of_freedom[indices],
            covariance_derivatives=self.covariance_derivatives[:, *pairs],
        )

    def by_names(
        self,
        named_by_fitted: Float[np.ndarray, "named shared"],
        covariance: Float[np.ndarray, "shared shared"],
    ) -> "SmallSampleCorrection":
        """Return the correction of the parameters as they are named.

        Args:
            named_by_fitted: derivative of the named parameters by the fitted ones.
            covariance: covariance of the fitted parameters without the correction.
        """
        variance = np.diagonal(named_by_fitted @ covariance @ named_by_fitted.T)
        return joined_corrections([(self, named_by_fitted)], variance)


def small_sample_correction(
    views: LinearisedViews,
    maximum: LikelihoodMaximum,
    directions: DirectionalNoise | None = None,
) -> SmallSampleCorrection:
    """Propagate the uncertainty of the errors' standard deviations to the parameters.

    The propagation is to first order in the logarithms of the standard deviations. A standard
    deviation at its lower bound has no effect: it can only grow, and half of the time its true
    value is at the bound. The added covariance is twice Kackar and Harville's, because the
    covariance at estimated standard deviations is too small by the same amount on average (Kenward
    and Roger).

    Args:
        views: the linearised views.
        maximum: the estimated standard deviations and their information matrix.
        directions: the directions in which poses err most, along whose axes the views' own
            parameters are; None if they err alike in all. They are as uncertain as the rest.
    """
    views, maximum = jax.tree.map(np.asarray, (views, maximum))
    sigma_vector = maximum.sigmas.vector
    marginal = marginalise(views, maximum.sigmas)
    # sigma^2 = bound^2 + excess^2: d log(sigma) / d log(excess) = 1 - (bound / sigma)^2
    log_sigma_by_log_excess = np.maximum(
        1.0 - (views.lower_bounds(len(sigma_vector)) / sigma_vector) ** 2, 0.0
    )
    vague_precision = np.eye(len(sigma_vector)) / VAGUE_PRIOR_LOG_STD**2
    log_excess_covariance = np.linalg.inv(
        maximum.information * np.outer(log_sigma_by_log_excess, log_sigma_by_log_excess)
        + vague_precision
    )
    # Chain rule: from derivatives by log(sigma) to derivatives by log(excess).
    step_derivatives, covariance_derivatives = _derivatives_by_log_sigma(
        views, marginal, len(maximum.sigmas.field)
    )
    step_derivatives = log_sigma_by_log_excess[:, None] * step_derivatives
    covariance_derivatives = log_sigma_by_log_excess[:, None, None] * covariance_derivatives
    if directions is not None:
        by_step, by_covariance = _derivatives_by_directions(
            views, marginal, effect_of_directions(directions, maximum.sigmas)
        )
        step_derivatives = np.concatenate([step_derivatives, by_step])
        covariance_derivatives = np.concatenate([covariance_derivatives, by_covariance])
        log_excess_covariance = np.asarray(
            block_diag(log_excess_covariance, directions.uncertainty)
        )

    degrees_of_freedom = _degrees_of_freedom(
        np.diagonal(marginal.shared_covariance), covariance_derivatives, log_excess_covariance
    )
    relative_std = np.sqrt(np.diagonal(np.linalg.inv(maximum.information + vague_precision)))
    # To first order Cov(x) = J^T W J with J = `step_derivatives`; twice that is added.
    return SmallSampleCorrection(
        relative_std,
        2.0 * step_derivatives.T @ log_excess_covariance @ step_derivatives,
        degrees_of_freedom,
        log_excess_covariance,
        covariance_derivatives,
    )


def joined_corrections(
    parts: Sequence[tuple[SmallSampleCorrection, Float[np.ndarray, "joint shared"]]],
    variance: Float[np.ndarray, "joint"],
) -> SmallSampleCorrection:
    """Return the correction of parameters that several independent estimates have in common.

    Args:
        parts: the correction of each estimate, and the effect of its parameters on the common ones.
        variance: variances of the common parameters without the correction.
    """
    log_excess_covariance = np.asarray(
        block_diag(*(part.log_excess_covariance for part, _ in parts))
    )
    covariance_derivatives = np.concatenate(
        [effect[None] @ part.covariance_derivatives @ effect.T[None] for part, effect in parts]
    )
    return SmallSampleCorrection(
        np.concatenate([part.relative_std for part, _ in parts]),
        sum(
            (effect @ part.added_covariance @ effect.T for part, effect in parts),
            np.zeros((len(variance), len(variance))),
        ),
        _degrees_of_freedom(variance, covariance_derivatives, log_excess_covariance),
        log_excess_covariance,
        covariance_derivatives,
    )


def _degrees_of_freedom(
    variance: Float[np.ndarray, "shared"],
    covariance_derivatives: Float[np.ndarray, "kinds shared shared"],
    log_excess_covariance: Float[np.ndarray, "kinds kinds"],
) -> Float[np.ndarray, "shared"]:
    """Return the degrees of freedom of each parameter's estimated variance."""
    # Satterthwaite: Var(log v_i) = a_i^T W a_i for the variance v_i of parameter i, with
    # W = `log_excess_covariance` and a_i = `log_variance_gradient[i]`, the derivatives of log(v_i)
    # by log(excess).
    # What was held has no variance, and so none that was estimated.
    gradient = np.diagonal(covariance_derivatives, axis1=1, axis2=2).T
    log_variance_gradient = np.divide(
        gradient,
        variance[:, None],
        out=np.zeros_like(gradient),
        where=variance[:, None] > 0.0,
    )
    # The logarithm of a variance with n degrees of freedom has variance 2 / n.
    log_variance_variance = np.sum(
        (log_variance_gradient @ log_excess_covariance) * log_variance_gradient, axis=1
    )
    return np.where(
        log_variance_variance > 0.0,
        2.0 / np.where(log_variance_variance > 0.0, log_variance_variance, 1.0),
        np.inf,
    )


def _derivatives_by_log_sigma(
    views: LinearisedViews, marginal: Marginalisation, groups: int
) -> tuple[Float[np.ndarray, "kinds shared"], Float[np.ndarray, "kinds shared shared"]]:
    """Differentiate the shared parameters and their covariance by the log standard deviations."""
    # In the notation of `marginalise`, with C = A^-1 and W_j the prior precisions of kind j,
    # dW_j / d log sigma_j = -2 W_j gives, because A s = -h,
    #     ds / d log sigma_j = 2 C W_j (o + s),   dC / d log sigma_j = 2 C W_j C,
    # and for the pixels, whose information is A - W with W the precision of all priors,
    #     ds / d log sigma = -2 C W (o + s),      dC / d log sigma = 2 (C - C W C).
    # Only rows and columns of the shared parameters are needed: C_ss, and C_vs = -K_v C_ss.
    prior_precision, step, offset = marginal.prior_precision, marginal.step, views.offset_from_prior
    covariance, gain_covariance = marginal.shared_covariance, marginal.gain_covariance
    weighted_shared = prior_precision.shared * (offset.shared + step.shared)
    weighted_per_view = prior_precision.per_view * (offset.per_view + step.per_view)
    by_step, by_covariance = [], []
    for rows in (slice(0, 3), slice(3, 6)):
        covariance_rows = rows_of_views(gain_covariance[:, rows])
        precision = prior_precision.per_view[:, rows].ravel()
        by_step.append(-weighted_per_view[:, rows].ravel() @ covariance_rows)
        by_covariance.append(covariance_rows.T @ (precision[:, None] * covariance_rows))
    has_known_prior = (views.group_index < 0).astype(float)
    for members in (*kinds_of(views, groups).groups, has_known_prior):
        by_step.append(covariance @ (members * weighted_shared))
        by_covariance.append((covariance * (members * prior_precision.shared)) @ covariance)
    pixel_step, pixel_covariance = -sum(by_step), covariance - sum(by_covariance)
    return (
        2.0 * np.stack([pixel_step, *by_step[:-1]]),
        2.0 * np.stack([pixel_covariance, *by_covariance[:-1]]),
    )


def _derivatives_by_directions(
    views: LinearisedViews,
    marginal: Marginalisation,
    changes: Float[np.ndarray, "directions views 6 6"],
) -> tuple[Float[np.ndarray, "directions shared"], Float[np.ndarray, "directions shared shared"]]:
    """Differentiate the shared parameters and their covariance by the directions of the errors.

    Args:
        views: the linearised views.
        marginal: result of `marginalise`.
        changes: change of the prior precision of the views' own parameters.
    """
    # As above, ds = -C dW (o + s) and dC = -C dW C, with C_vs = -`gain_covariance`.
    covariance = marginal.gain_covariance
    offset = views.offset_from_prior.per_view + marginal.step.per_view
    pulled = (changes @ offset[None, :, :, None])[..., 0].reshape(len(changes), -1)
    rows = (changes @ covariance[None]).reshape(len(changes), -1, covariance.shape[2])
    columns = rows_of_views(covariance)
    return np.asarray(pulled @ columns), np.asarray(-(columns.T[None] @ rows))


def p_value(
    offset: Float[np.ndarray, "parameters"],
    covariance: Float[np.ndarray, "parameters parameters"],
    correction: SmallSampleCorrection | None = None,
) -> float:
    """Compute the probability of estimates at least as far from the truth as `offset`, jointly.

    From the chi-square distribution or, if the standard deviations of errors were estimated, from
    an F distribution scaled according to Kenward and Roger.

    Args:
        offset: difference of the estimates from the hypothetical true values.
        covariance: covariance of these estimates, as reported.
        correction: their uncertainty due to estimated standard deviations of errors; None if these
            are known.
    """
    count, square = len(offset), float(offset @ np.linalg.solve(covariance, offset))
    scale, degrees_of_freedom = (
        (1.0, np.inf) if correction is None else _scaled_f_statistic(covariance, correction)
    )
    if np.isinf(degrees_of_freedom):
        return float(chdtrc(count, square))
    return float(fdtrc(count, degrees_of_freedom, scale * square / count))


def _scaled_f_statistic(
    covariance: Float[np.ndarray, "parameters parameters"], correction: SmallSampleCorrection
) -> tuple[float, float]:
    """Compute scale and denominator degrees of freedom of Kenward and Roger's F statistic.

    An infinite number of degrees of freedom means that the standard deviations do not matter.
    """
    count = len(covariance)
    # Kenward and Roger's A1 = sum_jk W_jk tr(F_j) tr(F_k) and A2 = sum_jk W_jk tr(F_j F_k), with
    # F_j = C^-1 dC/dj the relative derivatives of the covariance C without its correction, and
    # W = `log_excess_covariance`.
    unadjusted = np.asarray(covariance) - correction.added_covariance
    relative_derivatives = np.linalg.solve(unadjusted[None], correction.covariance_derivatives)
    traces = np.trace(relative_derivatives, axis1=1, axis2=2)
    log_excess_covariance = correction.log_excess_covariance
    a1 = float(traces @ log_excess_covariance @ traces)
    a2 = float(
        np.einsum("jk,jab,kba->", log_excess_covariance, relative_derivatives, relative_derivatives)
    )
    if a2 < 1e-9 * count:
        return 1.0, np.inf

    # For l = `count` parameters and B = (A1 + 6 A2) / (2 l), with c1, c2, c3 as in the paper, F has
    # expectation E = 1 / (1 - A2 / l),
    # variance V = (2 / l) (1 + c1 B) / ((1 - c2 B)^2 (1 - c3 B)),
    # degrees of freedom m = 4 + (l + 2) / (l rho - 1) with rho = V / (2 E^2),
    # and scale m / (E (m - 2)).
    g = ((count + 1) * a1 - (count + 4) * a2) / ((count + 2) * a2)
    c = np.array([g, count - g, count + 2 - g]) / (3 * count + 2 * (1 - g))
    b = (a1 + 6.0 * a2) / (2.0 * count)
    mean = 1.0 - a2 / count
    # Beyond the poles of V no F distribution has these moments. The fallback, 2 l / A2, is
    # Satterthwaite's for a single parameter.
    pole2, pole3 = 1.0 - c[1] * b, 1.0 - c[2] * b
    if min(mean, pole2, pole3) > 0.0:
        l_rho = (1.0 + c[0] * b) / (pole2**2 * pole3) * mean**2
        if l_rho > 1.0:
            degrees_of_freedom = 4.0 + (count + 2) / (l_rho - 1.0)
            return degrees_of_freedom * mean / (degrees_of_freedom - 2.0), degrees_of_freedom
    return 1.0, 2.0 * count / a2
