"""Maximise the restricted likelihood over the standard deviations of errors, by Fisher scoring.

Fisher scoring is Newton's method with the expected Hessian (the information matrix) instead of the
actual one. The expected Hessian is never indefinite and needs no derivative beyond the first.

Reference: Patterson and Thompson, Recovery of inter-block information when block sizes are unequal,
1971; Searle, Casella and McCulloch, Variance components, 1992, section 8.3.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .likelihood import (
    LinearisedViews,
    Marginalisation,
    StandardDeviations,
    counts,
    gradient,
    group_indicator,
    marginalise,
)

MAX_LOG_CHANGE = 15.0
"""Largest change of the logarithm of a standard deviation, from the start of the search."""

MAX_LOG_STEP = 3.0
"""Largest step of the logarithm of a standard deviation: a factor of twenty."""

MIN_RELATIVE_EXCESS = 0.01
"""Smallest excess over a lower bound at which a search starts, as a fraction of the bound.

The excess of a standard deviation s over its lower bound b is `sqrt(s^2 - b^2)`.
"""

LOG_LIKELIHOOD_TOLERANCE = 1e-4
"""Increase of the log-likelihood that a further step predicts, below which the search ends."""

MAX_SCORING_STEPS = 100
"""Largest number of steps of the search."""

INITIAL_DAMPING, DAMPING_BOUNDS = 1e-2, (1e-6, 1e8)
"""Damping of the first step (INITIAL_DAMPING), and its lower and upper limit (DAMPING_BOUNDS)."""


class StandardDeviationPrior(NamedTuple):
    """Independent prior distributions of the standard deviations of errors.

    Attributes:
        median: medians of the log-normal priors of the robot's errors: translation, rotation, each
            group of the field.
        log_std: standard deviations of their logarithms.
        pixel_rate: rate of the exponential prior of log(effective pixel sigma / white pixel sigma).
    """

    median: Float[Array, "robot"]
    log_std: Float[Array, "robot"]
    pixel_rate: Float[Array, ""]


class LikelihoodMaximum(NamedTuple):
    """The result of maximising the restricted likelihood, or the posterior.

    Attributes:
        sigmas: the standard deviations of all errors at the maximum.
        deviance: -2 log of the restricted likelihood there; with a prior, plus twice the prior's
            negative logarithm.
        deviance_decrease: decrease of the deviance from the start of the search.
        information: Fisher information of the log standard deviations, plus the prior's precision.
        steps: number of steps tried.
    """

    sigmas: StandardDeviations
    deviance: Float[Array, ""]
    deviance_decrease: Float[Array, ""]
    information: Float[Array, "kinds kinds"]
    steps: Int[Array, ""]


def fisher_information(
    views: LinearisedViews, marginal: Marginalisation, groups: int
) -> Float[Array, "kinds kinds"]:
    """Compute the Fisher information matrix of the logarithms of the standard deviations.

    With P_j the prior precisions of one kind of random number j, n_j their count, and C the
    covariance of all marginalised parameters, the information of the logarithms of two precisions
    is half of

        tr(C P_j C P_k) + [j = k] (n_j - 2 tr(C P_j))

    The entries of the pixels follow, because the precisions of the pixels and of all priors add up
    to the inverse of C.

    Args:
        views: the linearised views.
        marginal: result of `marginalise` at the standard deviations in question.
        groups: number of groups of the field.
    """
    # Blocks of C, with K_v the gain of a view and D_v its own block: C_ss (shared),
    # C_vs = -K_v C_ss, C_vw = K_v C_ss K_w^T, and D_v^-1 + K_v C_ss K_v^T for a view with itself.
    elimination, prior_precision = marginal.elimination, marginal.prior_precision
    covariance = marginal.shared_covariance
    gain_covariance = elimination.gain @ covariance
    per_view_covariance = elimination.per_view_covariance(covariance)
    shared_contribution = per_view_covariance - elimination.per_view_inverse

    # P_j as rows of weights: translation, rotation; then the groups of the field, and last the
    # parameters with a known prior.
    pose_precisions = jnp.repeat(jnp.eye(2), 3, axis=1)[None] * prior_precision.per_view[:, None]
    has_known_prior = (views.group_index < 0).astype(float)
    shared_precisions = (
        jnp.concatenate([group_indicator(views, groups), has_known_prior[None]])
        * prior_precision.shared[None]
    )

    # P_j are diagonal: tr(C P_j C P_k) = sum_ab P_j,a C_ab^2 P_k,b, summed block by block.
    shared_traces = shared_precisions @ covariance**2 @ shared_precisions.T
    cross_traces = (
        jnp.einsum("vak,vki->ai", pose_precisions, gain_covariance**2) @ shared_precisions.T
    )
    # Over all pairs of views, tr((C_ss sum_v K_v^T P_j K_v) (C_ss sum_w K_w^T P_k K_w)); the second
    # line corrects the pairs of a view with itself, which have D_v^-1 besides.
    weighted_gains = covariance[None] @ jnp.einsum(
        "vak,vki,vkj->aij", pose_precisions, elimination.gain, elimination.gain
    )
    per_view_traces = jnp.einsum("aij,bji->ab", weighted_gains, weighted_gains)
    per_view_traces += jnp.einsum(
        "vak,vbl,vkl->ab",
        pose_precisions,
        pose_precisions,
        per_view_covariance**2 - shared_contribution**2,
    )
    product_traces = jnp.block([[per_view_traces, cross_traces], [cross_traces.T, shared_traces]])
    diagonal = jnp.diagonal(per_view_covariance, axis1=1, axis2=2)
    traces = jnp.concatenate(
        [
            jnp.einsum("vak,vk->a", pose_precisions, diagonal),
            shared_precisions @ jnp.diagonal(covariance),
        ]
    )

    count = counts(views, groups)
    parameter_count = jnp.sum(views.per_view_free.astype(float)) + len(marginal.factor)
    # C^-1 = P_0 + sum_j P_j with P_0 the information of the pixels. C P_0 = 1 - sum_j C P_j in the
    # formula above, with N the number of marginalised parameters, gives
    # (0, 0): n_0 - N + sum_jk tr(C P_j C P_k),  (0, j): tr(C P_j) - sum_k tr(C P_j C P_k).
    pixel = count[0] - parameter_count + jnp.sum(product_traces)
    pixel_robot = (traces - jnp.sum(product_traces, axis=1))[:-1]
    robot = product_traces[:-1, :-1] + jnp.diag(count[1:] - 2.0 * traces[:-1])
    by_precision = jnp.block(
        [[pixel[None, None], pixel_robot[None]], [pixel_robot[:, None], robot]]
    )
    # log sigma = -log(precision) / 2: a factor of 4, times the half of the formula.
    return 2.0 * by_precision


def maximise(
    views: LinearisedViews,
    start: StandardDeviations,
    active: Bool[Array, "robot"],
    prior: StandardDeviationPrior | None = None,
) -> LikelihoodMaximum:
    """Maximise the restricted likelihood, or the posterior, over the standard deviations of errors.

    Args:
        views: the linearised views.
        start: standard deviations at which the search begins.
        active: mask of the robot's errors that are fitted: translation, rotation, each group of the
            field; the others stay at zero (their lower bound).
        prior: prior of the standard deviations; None for none.
    """
    lower_bounds = views.lower_bounds(len(start.vector))
    is_active = jnp.concatenate([jnp.ones(1, bool), active])
    initial_log_excess = 0.5 * jnp.log(
        jnp.maximum(start.vector**2 - lower_bounds**2, (MIN_RELATIVE_EXCESS * lower_bounds) ** 2)
    )

    # sigma = sqrt(bound^2 + excess^2) with
    #     log(excess) = initial_log_excess + MAX_LOG_CHANGE tanh(x / MAX_LOG_CHANGE):
    # x is unbounded, and no constraint is needed where a sigma goes to its lower bound.
    def sigmas_at(x: Float[Array, "kinds"]) -> Float[Array, "kinds"]:
        """Return the standard deviations at a point of the search."""
        excess = jnp.exp(initial_log_excess + MAX_LOG_CHANGE * jnp.tanh(x / MAX_LOG_CHANGE))
        return jnp.where(is_active, jnp.hypot(lower_bounds, excess), lower_bounds)

    def evaluate(x: Float[Array, "kinds"]) -> _Evaluation:
        """Evaluate objective, gradient and information matrix at a point of the search."""
        logarithms, log_sigma_by_x = jax.jvp(
            lambda x: jnp.log(sigmas_at(x)), (x,), (jnp.ones_like(x),)
        )
        sigmas = StandardDeviations.from_vector(jnp.exp(logarithms))
        marginal = marginalise(views, sigmas)
        # Derivative of half the deviance by log(sigma): dD / d log(sigma) = sigma dD / dsigma.
        log_gradient = 0.5 * gradient(views, sigmas, marginal).vector * sigmas.vector
        information = fisher_information(views, marginal, len(sigmas.field))
        negative_log_prior, prior_gradient, precision = _negative_log_prior(
            logarithms, jnp.log(lower_bounds[0]), active, prior
        )
        information = information + jnp.diag(precision)
        deviance = marginal.deviance + 2.0 * negative_log_prior
        # The chain rule from log(sigma) to the coordinates x, each of which acts on one sigma.
        return _Evaluation(
            x,
            sigmas,
            deviance,
            information,
            log_sigma_by_x * (log_gradient + prior_gradient),
            information * jnp.outer(log_sigma_by_x, log_sigma_by_x),
        )

    # A standard deviation estimated from n random numbers has a logarithm with standard deviation
    # of about 1 / sqrt(2 n), which is the unit of each coordinate of the search.
    units = 1.0 / jnp.sqrt(2.0 * jnp.maximum(counts(views, len(start.field)), 1.0))
    initial = evaluate(jnp.zeros_like(initial_log_excess))
    search = _SearchState(initial, jnp.array(INITIAL_DAMPING), jnp.array(0), jnp.array(False))
    search = jax.lax.while_loop(
        lambda s: (s.steps < MAX_SCORING_STEPS) & ~s.converged,
        lambda s: _scoring_step(s, evaluate, units),
        search,
    )
    best = search.best
    deviance_decrease = initial.deviance - best.deviance
    return LikelihoodMaximum(
        best.sigmas, best.deviance, deviance_decrease, best.information, search.steps
    )


def _negative_log_prior(
    logarithms: Float[Array, "kinds"],
    log_white_sigma: Float[Array, ""],
    active: Bool[Array, "robot"],
    prior: StandardDeviationPrior | None,
) -> tuple[Float[Array, ""], Float[Array, "kinds"], Float[Array, "kinds"]]:
    """Return the prior's negative logarithm, its gradient and the diagonal of its Hessian.

    The derivatives are by the logarithms of the standard deviations.
    """
    if prior is None:
        zeros = jnp.zeros_like(logarithms)
        return jnp.zeros(()), zeros, zeros
    precision = jnp.where(active, prior.log_std**-2, 0.0)
    offset = logarithms[1:] - jnp.log(prior.median)
    value = 0.5 * jnp.sum(precision * offset**2) + prior.pixel_rate * (
        logarithms[0] - log_white_sigma
    )
    prior_gradient = jnp.concatenate([prior.pixel_rate[None], precision * offset])
    return value, prior_gradient, jnp.pad(precision, (1, 0))


class _Evaluation(NamedTuple):
    """The objective at a point x of the search.

    `gradient` and `expected_hessian` are those of half the deviance, by x; `information` is the
    expected Hessian by the logarithms of the standard deviations.
    """

    x: Float[Array, "kinds"]
    sigmas: StandardDeviations
    deviance: Float[Array, ""]
    information: Float[Array, "kinds kinds"]
    gradient: Float[Array, "kinds"]
    expected_hessian: Float[Array, "kinds kinds"]


class _SearchState(NamedTuple):
    """The state of the search: best point, damping, number of steps, and whether done."""

    best: _Evaluation
    damping: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


def _scoring_step(
    search: _SearchState,
    evaluate: Callable[[Float[Array, "kinds"]], _Evaluation],
    units: Float[Array, "kinds"],
) -> _SearchState:
    """Take one damped Fisher scoring step, and adapt the damping.

    With damping, a variance component that tends to zero approaches it by a factor per step.
    """
    best, damping = search.best, search.damping
    # (H + lambda 1) d = -g, in the units of the coordinates; H is the expected Hessian, g the
    # gradient.
    scaled_gradient = units * best.gradient
    scaled_hessian = best.expected_hessian * jnp.outer(units, units)
    step = -jnp.linalg.solve(scaled_hessian + damping * jnp.eye(len(units)), scaled_gradient)
    step = step * jnp.minimum(1.0, MAX_LOG_STEP / jnp.max(jnp.abs(units * step)))
    predicted_increase = -step @ (scaled_gradient + 0.5 * scaled_hessian @ step)
    # log sigma += log(1 + 2 d) / 2 multiplies the variance by 1 + 2 d. The expectation is linear in
    # the variances, so that a single variance component is found in one step.
    variance_factors = jnp.maximum(1.0 + 2.0 * units * step, jnp.exp(-2.0 * MAX_LOG_STEP))
    trial = evaluate(best.x + 0.5 * jnp.log(variance_factors))
    actual_increase = 0.5 * (best.deviance - trial.deviance)
    accept = actual_increase > 0.0
    best = jax.tree.map(lambda new, old: jnp.where(accept, new, old), trial, best)
    # Damping by the ratio of actual to predicted increase of the log-likelihood: a fifth above 0.5,
    # six times below 0.1.
    factor = jnp.where(
        actual_increase > 0.5 * predicted_increase,
        0.2,
        jnp.where(actual_increase > 0.1 * predicted_increase, 1.0, 6.0),
    )
    damping = jnp.clip(damping * factor, *DAMPING_BOUNDS)
    return _SearchState(
        best, damping, search.steps + 1, predicted_increase < LOG_LIKELIHOOD_TOLERANCE
    )
