"""Maximise the restricted likelihood over the standard deviations of errors, by Fisher scoring.

Fisher scoring is Newton's method with the expected Hessian (the information matrix) instead of the
actual one. The expected Hessian is never indefinite and needs no derivative beyond the first.

Reference: Patterson and Thompson, Recovery of inter-block information when block sizes are unequal,
1971; Searle, Casella and McCulloch, Variance components, 1992, section 8.3.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..runtime.array_namespace import AnyArray, array_namespace
from .likelihood import (
    IS_POSE_KIND,
    Kinds,
    LinearisedViews,
    Marginalisation,
    StandardDeviations,
    gradient,
    kinds_of,
    marginalise,
    rows_of_views,
    with_added_diagonal,
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
        weak_probability: probability of a weak robot.
        weak_median: medians of translation and rotation of a weak robot.
    """

    median: Float[np.ndarray, "robot"]
    log_std: Float[np.ndarray, "robot"]
    pixel_rate: float
    weak_probability: float = 0.0
    weak_median: tuple[float, float] = (1.0, 1.0)

    @property
    def of_weak_robot(self) -> "StandardDeviationPrior":
        """The prior of a robot that is known to be weak."""
        return self._replace(median=np.concatenate([self.weak_median, self.median[2:]]))


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
    deviance: float
    deviance_decrease: float
    information: Float[np.ndarray, "kinds kinds"]
    steps: int


def fisher_information(
    views: LinearisedViews, marginal: Marginalisation, kinds: Kinds
) -> Float[AnyArray, "kinds kinds"]:
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
        kinds: result of `kinds_of` for the views.
    """
    # C has the blocks of `Marginalisation`, and C_vw = K_v C_ss K_w^T for two different views.
    xp = array_namespace(marginal.shared_whitening)
    covariance = marginal.shared_covariance
    per_view_covariance, per_view_inverse = marginal.per_view_covariance, marginal.per_view_inverse
    per_view_precision = marginal.prior_precision.per_view

    # P_j as rows of weights: the groups of the field, and last the parameters with a known prior.
    has_known_prior = (views.group_index < 0).astype(float)
    shared_precisions = (
        xp.concatenate([kinds.groups, has_known_prior[None]])
        * marginal.prior_precision.shared[None]
    )

    # P_j are diagonal: tr(C P_j C P_k) = sum_ab P_j,a C_ab^2 P_k,b, summed block by block. For the
    # blocks of the views, with N_j = sum_v K_v^T P_j K_v, where only three rows of a view belong to
    # a kind: the diagonal of C_ss N_j C_ss holds the sums of squares between a kind and each shared
    # parameter, and tr(N_j C_ss N_k C_ss) is the sum over all pairs of views. It needs a correction
    # for the pairs of a view with itself, which also contain D_v^-1, entry by entry:
    # (D^-1 + S)^2 - S^2 = D^-1 (D^-1 + 2 S).
    shared_traces = shared_precisions @ covariance**2 @ shared_precisions.T
    weighted_gain = marginal.gain * xp.sqrt(per_view_precision)[..., None]
    shape = 2, 3 * len(weighted_gain), len(covariance)
    kinds_rows = [rows_of_views(weighted_gain[:, rows]) for rows in (slice(0, 3), slice(3, 6))]
    rows = xp.concatenate(kinds_rows)
    rows_covariance = (rows @ covariance).reshape(shape)
    cross_traces = (rows_covariance**2).sum(axis=1) @ shared_precisions.T
    products = rows.reshape(shape).swapaxes(1, 2) @ rows_covariance
    entries, transposed = (
        x.reshape(2, covariance.size) for x in (products, products.swapaxes(1, 2))
    )
    per_view_traces = entries @ transposed.T
    excess = per_view_inverse * (2.0 * per_view_covariance - per_view_inverse)
    weighted_excess = per_view_precision[:, :, None] * excess * per_view_precision[:, None]
    per_view_traces = per_view_traces + IS_POSE_KIND @ weighted_excess.sum(axis=0) @ IS_POSE_KIND.T
    product_traces = _arranged(per_view_traces, cross_traces, shared_traces)
    diagonal = per_view_covariance.diagonal(axis1=1, axis2=2)
    traces = xp.concatenate(
        [
            IS_POSE_KIND @ (per_view_precision * diagonal).sum(axis=0),
            shared_precisions @ covariance.diagonal(),
        ]
    )

    count = kinds.counts
    parameter_count = views.per_view_free.sum(dtype=float) + len(covariance)
    # C^-1 = P_0 + sum_j P_j with P_0 the information of the pixels. C P_0 = 1 - sum_j C P_j in the
    # formula above, with N the number of marginalised parameters, gives
    # (0, 0): n_0 - N + sum_jk tr(C P_j C P_k),  (0, j): tr(C P_j) - sum_k tr(C P_j C P_k).
    pixel = count[0] - parameter_count + product_traces.sum()
    pixel_robot = (traces - product_traces.sum(axis=1))[:-1]
    robot = with_added_diagonal(product_traces[:-1, :-1], count[1:] - 2.0 * traces[:-1])
    # log sigma = -log(precision) / 2: a factor of 4, times the half of the formula.
    return 2.0 * _arranged(xp.reshape(pixel, (1, 1)), pixel_robot[None], robot)


def _arranged(
    upper_left: Float[AnyArray, "m m"],
    upper_right: Float[AnyArray, "m n"],
    lower_right: Float[AnyArray, "n n"],
) -> Float[AnyArray, "both both"]:
    """Return the symmetric matrix with these blocks."""
    # Twice as fast as `block`, which matters in evaluations that take less than a millisecond.
    xp = array_namespace(lower_right)
    return xp.concatenate(
        [
            xp.concatenate([upper_left, upper_right], axis=1),
            xp.concatenate([upper_right.T, lower_right], axis=1),
        ]
    )


def maximise(
    views: LinearisedViews,
    start: StandardDeviations,
    active: Bool[AnyArray, "robot"],
    prior: StandardDeviationPrior | None = None,
) -> LikelihoodMaximum:
    """Maximise the restricted likelihood, or the posterior, over the standard deviations of errors.

    The search runs on the host, and its result consists of NumPy arrays.

    Args:
        views: the linearised views.
        start: standard deviations at which the search begins.
        active: mask of the robot's errors that are fitted: translation, rotation, each group of the
            field; the others stay at zero (their lower bound).
        prior: prior of the standard deviations; None for none.
    """
    views, start, prior = jax.tree.map(np.asarray, (views, start, prior))
    active = np.asarray(active)
    # A group whose standard deviation stays at zero holds its parameters at their prior means.
    is_held = (views.group_index >= 0) & ~np.append(active[2:], True)[views.group_index]
    objective = _Objective(views.with_held(is_held), start, active, prior)
    # A standard deviation estimated from n random numbers has a logarithm with standard deviation
    # of about 1 / sqrt(2 n), which is the unit of each coordinate of the search.
    units = 1.0 / np.sqrt(2.0 * np.maximum(kinds_of(views, len(start.field)).counts, 1.0))
    best = initial = objective.at(np.zeros(len(units)))
    slopes = objective.slopes(best)
    damping, steps, converged = INITIAL_DAMPING, 0, not np.isfinite(initial.deviance)
    while steps < MAX_SCORING_STEPS and not converged:
        change, predicted_increase = _damped_step(slopes, damping, units)
        trial = objective.at(best.x + change)
        increase = 0.5 * (best.deviance - trial.deviance)
        if increase > 0.0:
            best, slopes = trial, objective.slopes(trial)
        # Damping by the ratio of actual to predicted increase of the log-likelihood: a fifth above
        # 0.5, six times below 0.1.
        if increase > 0.5 * predicted_increase:
            damping *= 0.2
        elif not increase > 0.1 * predicted_increase:
            damping *= 6.0
        damping = min(max(damping, DAMPING_BOUNDS[0]), DAMPING_BOUNDS[1])
        steps, converged = steps + 1, bool(predicted_increase < LOG_LIKELIHOOD_TOLERANCE)
    return LikelihoodMaximum(
        best.sigmas,
        float(best.deviance),
        float(initial.deviance - best.deviance),
        slopes.information,
        steps,
    )


class _Point(NamedTuple):
    """The objective at a point x of the search.

    `log_sigma_by_x` is the derivative of each log standard deviation by its coordinate,
    `prior_gradient` the gradient of the prior's negative logarithm by the log standard deviations.
    """

    x: Float[np.ndarray, "kinds"]
    sigmas: StandardDeviations
    log_sigma_by_x: Float[np.ndarray, "kinds"]
    prior_gradient: Float[np.ndarray, "kinds"]
    marginal: Marginalisation
    deviance: float


class _Slopes(NamedTuple):
    """The derivatives of half the deviance at a point x of the search.

    `gradient` and `expected_hessian` are by x, and `information` is the expected Hessian by the
    logarithms of the standard deviations.
    """

    information: Float[np.ndarray, "kinds kinds"]
    gradient: Float[np.ndarray, "kinds"]
    expected_hessian: Float[np.ndarray, "kinds kinds"]


class _Objective:
    """The deviance, with the prior, as a function of unbounded coordinates x."""

    def __init__(
        self,
        views: LinearisedViews,
        start: StandardDeviations,
        active: Bool[np.ndarray, "robot"],
        prior: StandardDeviationPrior | None,
    ):
        self.views, self.prior = views, prior
        self.kinds = kinds_of(views, len(start.field))
        self.is_active = np.concatenate([[True], active])
        self.prior_precision = np.zeros(len(self.is_active))
        if prior is not None:
            self.prior_precision[1:] = np.where(active, prior.log_std**-2, 0.0)
            self.log_median = np.log(prior.median)
        self.lower_bounds = views.lower_bounds(len(self.is_active))
        self.log_white_sigma = np.log(self.lower_bounds[0])
        min_excess = MIN_RELATIVE_EXCESS * self.lower_bounds
        self.initial_log_excess = 0.5 * np.log(
            np.maximum(start.vector**2 - self.lower_bounds**2, min_excess**2)
        )

    def at(self, x: Float[np.ndarray, "kinds"]) -> _Point:
        """Evaluate the objective at a point of the search."""
        # sigma = sqrt(bound^2 + excess^2) with
        #     log(excess) = initial_log_excess + MAX_LOG_CHANGE tanh(x / MAX_LOG_CHANGE):
        # x is unbounded, and no constraint is needed if a sigma goes to its lower bound.
        saturation = np.tanh(x / MAX_LOG_CHANGE)
        excess = np.exp(self.initial_log_excess + MAX_LOG_CHANGE * saturation)
        excess = np.where(self.is_active, excess, 0.0)
        vector = np.hypot(self.lower_bounds, excess)
        log_sigma_by_x = (excess / vector) ** 2 * (1.0 - saturation**2)
        sigmas = StandardDeviations.from_vector(vector)
        negative_log_prior, prior_gradient = self._negative_log_prior(np.log(vector))
        marginal = marginalise(self.views, sigmas)
        deviance = float(marginal.deviance + 2.0 * negative_log_prior)
        return _Point(x, sigmas, log_sigma_by_x, prior_gradient, marginal, deviance)

    def slopes(self, point: _Point) -> _Slopes:
        """Evaluate gradient and information matrix at a point of the search."""
        sigmas, log_sigma_by_x = point.sigmas, point.log_sigma_by_x
        # Derivative of half the deviance by log(sigma): dD / d log(sigma) = sigma dD / dsigma.
        by_sigma = gradient(self.views, sigmas, point.marginal, self.kinds).vector
        log_gradient = 0.5 * by_sigma * sigmas.vector + point.prior_gradient
        information = np.asarray(fisher_information(self.views, point.marginal, self.kinds))
        information = information + np.diag(self.prior_precision)
        # The chain rule from log(sigma) to x; each coordinate acts on one sigma.
        return _Slopes(
            information,
            log_sigma_by_x * log_gradient,
            information * np.outer(log_sigma_by_x, log_sigma_by_x),
        )

    def _negative_log_prior(
        self, logarithms: Float[np.ndarray, "kinds"]
    ) -> tuple[float, Float[np.ndarray, "kinds"]]:
        """Return the prior's negative logarithm and its gradient by the log standard deviations."""
        if self.prior is None:
            return 0.0, np.zeros_like(logarithms)
        precision, offset = self.prior_precision[1:], logarithms[1:] - self.log_median
        log_pixel_ratio = logarithms[0] - self.log_white_sigma
        value = 0.5 * precision @ offset**2 + self.prior.pixel_rate * log_pixel_ratio
        return value, np.concatenate([[self.prior.pixel_rate], precision * offset])


def _damped_step(
    slopes: _Slopes, damping: float, units: Float[np.ndarray, "kinds"]
) -> tuple[Float[np.ndarray, "kinds"], float]:
    """Return the change of x of one damped Fisher scoring step, and the increase it predicts.

    With damping, a variance component that tends to zero approaches it by a factor per step.
    """
    # (H + lambda 1) d = -g, in the units of the coordinates; H is the expected Hessian, g the
    # gradient.
    gradient_in_units = units * slopes.gradient
    hessian = slopes.expected_hessian * np.outer(units, units)
    step = -np.linalg.solve(hessian + damping * np.eye(len(units)), gradient_in_units)
    longest = np.abs(units * step).max()
    if longest > MAX_LOG_STEP:
        step = step * (MAX_LOG_STEP / longest)
    predicted_increase = -step @ (gradient_in_units + 0.5 * hessian @ step)
    # log sigma += log(1 + 2 d) / 2 multiplies the variance by 1 + 2 d. The expectation is linear in
    # the variances, so that a single variance component is found in one step.
    variance_factors = np.maximum(1.0 + 2.0 * units * step, np.exp(-2.0 * MAX_LOG_STEP))
    return 0.5 * np.log(variance_factors), float(predicted_increase)
