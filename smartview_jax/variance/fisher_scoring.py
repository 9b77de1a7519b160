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

from ..runtime.array_namespace import AnyArray
from .fisher_information import fisher_information
from .likelihood import Marginalisation, gradient, marginalise, with_added_diagonal
from .linearised_views import LinearisedViews, kinds_of
from .standard_deviations import StandardDeviations

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

MAX_TOGETHER_BYTES = 2**18
"""Largest size of the border blocks of all searches that take their steps together.

Several arrays of this size then fit into a processor's cache of 1 MB. With 500 views eight searches
together, in 20 MB, take 2.5 times as long as one after the other.
"""

MAX_COLUMN_RATIO = 1.25
"""Largest number of parameters of searches together, those that others fit included, over the
number that they fit themselves."""

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
    return maximise_each(views, start, np.asarray(active)[None], prior)[0]


def maximise_each(
    views: LinearisedViews,
    start: StandardDeviations,
    active: Bool[AnyArray, "searches robot"],
    prior: StandardDeviationPrior | None = None,
) -> list[LikelihoodMaximum]:
    """Maximise as `maximise` does for several choices of the errors that are fitted.

    The searches are independent. With few views they take their steps together, because nearly all
    of the time of a step is NumPy's calls, however many matrices each is given.

    Args:
        views: the linearised views.
        start: standard deviations at which all searches begin.
        active: as of `maximise`, for each search.
        prior: prior of the standard deviations; None for none.
    """
    views, start, prior = jax.tree.map(np.asarray, (views, start, prior))
    active = np.asarray(active)
    maxima: dict[int, LikelihoodMaximum] = {}
    for together in _batches(views, active):
        search = _Search(views, start, active[together], prior)
        for _ in range(MAX_SCORING_STEPS):
            if not search.is_running:
                break
            search.step()
        maxima |= dict(zip(together, search.maxima, strict=True))
    return [maxima[k] for k in range(len(active))]


def _batches(views: LinearisedViews, active: Bool[np.ndarray, "searches robot"]) -> list[list[int]]:
    """Return the numbers of the searches that take their steps together.

    Those that fit nearly the same errors come together: what none of a batch fits is left out.
    """
    is_fitted = ~_is_held(views, active)
    column_bytes = views.matrix.border.nbytes / max(is_fitted.shape[1], 1)
    batches: list[list[int]] = []
    for k in np.lexsort(active.T[::-1]).tolist():
        larger = [*batches[-1], k] if batches else [k]
        columns = len(larger) * int(is_fitted[larger].any(axis=0).sum())
        is_small = columns * column_bytes <= MAX_TOGETHER_BYTES
        if batches and is_small and columns <= MAX_COLUMN_RATIO * is_fitted[larger].sum():
            batches[-1] = larger
        else:
            batches.append([k])
    return batches


def _is_held(
    views: LinearisedViews, active: Bool[np.ndarray, "searches robot"]
) -> Bool[np.ndarray, "searches shared"]:
    """Return whether each search holds each shared parameter, at its prior mean.

    It does so with a group whose standard deviation stays at zero.
    """
    is_in_group = np.append(active[:, 2:], np.ones((len(active), 1), dtype=bool), axis=1)
    group_index = np.asarray(views.group_index)
    return (group_index >= 0) & ~is_in_group[:, group_index]


class _Points(NamedTuple):
    """The objective of each search at its point x.

    `log_sigma_by_x` is the derivative of each log standard deviation by its coordinate,
    `prior_gradient` the gradient of the prior's negative logarithm by the log standard deviations.
    """

    x: Float[np.ndarray, "searches kinds"]
    vector: Float[np.ndarray, "searches kinds"]
    log_sigma_by_x: Float[np.ndarray, "searches kinds"]
    prior_gradient: Float[np.ndarray, "searches kinds"]
    marginal: Marginalisation
    deviance: Float[np.ndarray, "searches"]


class _Best(NamedTuple):
    """The best point of each search, with the derivatives of half the deviance there.

    `gradient` and `expected_hessian` are by x, and `information` is the expected Hessian by the
    logarithms of the standard deviations.
    """

    x: Float[np.ndarray, "searches kinds"]
    vector: Float[np.ndarray, "searches kinds"]
    deviance: Float[np.ndarray, "searches"]
    information: Float[np.ndarray, "searches kinds kinds"]
    gradient: Float[np.ndarray, "searches kinds"]
    expected_hessian: Float[np.ndarray, "searches kinds kinds"]

    def replaced(self, others: "_Best", where: Bool[np.ndarray, "searches"]) -> "_Best":
        """Return these points with others in the place of some."""
        if where.all():
            return others
        return _Best(
            *(
                np.where(where.reshape(-1, *(1,) * (old.ndim - 1)), new, old)
                for old, new in zip(self, others, strict=True)
            )
        )

    def selected(self, where: Bool[np.ndarray, "searches"]) -> "_Best":
        """Return the points of some of the searches."""
        return _Best(*(array[where] for array in self))


class _Search:
    """Several searches that take their steps together, from the same start."""

    def __init__(
        self,
        views: LinearisedViews,
        start: StandardDeviations,
        active: Bool[np.ndarray, "searches robot"],
        prior: StandardDeviationPrior | None,
    ):
        self._views, self._start, self._active, self._prior = views, start, active, prior
        self._objective = _Objective(views, start, active, prior)
        # A standard deviation estimated from n random numbers has a logarithm with standard
        # deviation of about 1 / sqrt(2 n), which is the unit of each coordinate of the search.
        counts = kinds_of(views, len(start.field)).counts
        self._units = 1.0 / np.sqrt(2.0 * np.maximum(counts, 1.0))
        points = self._objective.points(np.zeros((len(active), len(counts))))
        self._best = self._objective.best_of(points)
        self._start_deviance = points.deviance
        self._damping, self._steps = np.full(len(active), INITIAL_DAMPING), 0
        # The numbers of the searches that have not ended; all arrays are theirs.
        self._numbers = np.arange(len(active))
        self._maxima: dict[int, LikelihoodMaximum] = {}
        self._end(~np.isfinite(points.deviance))

    @property
    def is_running(self) -> bool:
        """Whether a search has not converged."""
        return len(self._numbers) > 0

    @property
    def maxima(self) -> list[LikelihoodMaximum]:
        """The result of each search."""
        self._end(np.ones(len(self._numbers), dtype=bool))
        return [self._maxima[k] for k in range(len(self._start_deviance))]

    def step(self) -> None:
        """Take a step of each search that has not converged."""
        change, predicted_increase = _damped_steps(self._best, self._damping, self._units)
        trial = self._objective.points(self._best.x + change)
        increase = 0.5 * (self._best.deviance - trial.deviance)
        if (increase > 0.0).any():
            self._best = self._best.replaced(self._objective.best_of(trial), increase > 0.0)
        # Damping by the ratio of actual to predicted increase of the log-likelihood: a fifth above
        # 0.5, six times below 0.1.
        is_good, is_poor = (
            increase > 0.5 * predicted_increase,
            ~(increase > 0.1 * predicted_increase),
        )
        factor = np.where(is_good, 0.2, np.where(is_poor, 6.0, 1.0))
        self._damping = np.clip(self._damping * factor, *DAMPING_BOUNDS)
        self._steps += 1
        self._end(predicted_increase < LOG_LIKELIHOOD_TOLERANCE)

    def _end(self, has_ended: Bool[np.ndarray, "searches"]) -> None:
        """Keep the results of searches that have ended, and go on with the others."""
        if not has_ended.any():
            return
        best = self._best
        for k in np.flatnonzero(has_ended):
            number = int(self._numbers[k])
            self._maxima[number] = LikelihoodMaximum(
                StandardDeviations.from_vector(best.vector[k]),
                float(best.deviance[k]),
                float(self._start_deviance[number] - best.deviance[k]),
                best.information[k],
                self._steps,
            )
        runs = ~has_ended
        self._numbers = self._numbers[runs]
        if self.is_running:
            self._best, self._damping = best.selected(runs), self._damping[runs]
            active = self._active[self._numbers]
            self._objective = _Objective(self._views, self._start, active, self._prior)


class _Objective:
    """The deviance, with the prior, as a function of unbounded coordinates x, of each search."""

    def __init__(
        self,
        views: LinearisedViews,
        start: StandardDeviations,
        active: Bool[np.ndarray, "searches robot"],
        prior: StandardDeviationPrior | None,
    ):
        self.views, self.prior = views.with_held_in_searches(_is_held(views, active)), prior
        self.kinds = kinds_of(self.views, len(start.field))
        self.is_active = np.insert(active, 0, True, axis=1)
        self.prior_precision = np.zeros(self.is_active.shape)
        if prior is not None:
            self.prior_precision[:, 1:] = np.where(active, prior.log_std**-2, 0.0)
            self.log_median = np.log(prior.median)
        self.lower_bounds = views.lower_bounds(self.is_active.shape[1])
        self.log_white_sigma = np.log(self.lower_bounds[0])
        min_excess = MIN_RELATIVE_EXCESS * self.lower_bounds
        self.initial_log_excess = 0.5 * np.log(
            np.maximum(start.vector**2 - self.lower_bounds**2, min_excess**2)
        )

    def points(self, x: Float[np.ndarray, "searches kinds"]) -> _Points:
        """Evaluate the objective at a point of each search."""
        # sigma = sqrt(bound^2 + excess^2) with
        #     log(excess) = initial_log_excess + MAX_LOG_CHANGE tanh(x / MAX_LOG_CHANGE):
        # x is unbounded, and no constraint is needed if a sigma goes to its lower bound.
        saturation = np.tanh(x / MAX_LOG_CHANGE)
        excess = np.exp(self.initial_log_excess + MAX_LOG_CHANGE * saturation)
        excess = np.where(self.is_active, excess, 0.0)
        vector = np.hypot(self.lower_bounds, excess)
        log_sigma_by_x = (excess / vector) ** 2 * (1.0 - saturation**2)
        negative_log_prior, prior_gradient = self._negative_log_prior(np.log(vector))
        marginal = marginalise(self.views, StandardDeviations.from_vector(vector))
        deviance = np.asarray(marginal.deviance + 2.0 * negative_log_prior)
        return _Points(x, vector, log_sigma_by_x, prior_gradient, marginal, deviance)

    def best_of(self, points: _Points) -> _Best:
        """Evaluate gradients and information matrices at points."""
        vector, log_sigma_by_x = points.vector, points.log_sigma_by_x
        sigmas = StandardDeviations.from_vector(vector)
        # Derivative of half the deviance by log(sigma): dD / d log(sigma) = sigma dD / dsigma.
        by_sigma = gradient(self.views, sigmas, points.marginal, self.kinds).vector
        log_gradient = 0.5 * by_sigma * vector + points.prior_gradient
        information = np.asarray(fisher_information(self.views, points.marginal, self.kinds))
        information = np.asarray(with_added_diagonal(information, self.prior_precision))
        # The chain rule from log(sigma) to x; each coordinate acts on one sigma.
        return _Best(
            points.x,
            vector,
            points.deviance,
            information,
            log_sigma_by_x * log_gradient,
            information * log_sigma_by_x[:, None] * log_sigma_by_x[..., None],
        )

    def _negative_log_prior(
        self, logarithms: Float[np.ndarray, "searches kinds"]
    ) -> tuple[Float[np.ndarray, "*searches"], Float[np.ndarray, "searches kinds"]]:
        """Return the prior's negative logarithm and its gradient by the log standard deviations."""
        slopes = np.zeros_like(logarithms)
        if self.prior is None:
            return np.zeros(()), slopes
        offset = logarithms[:, 1:] - self.log_median
        slopes[:, 0], slopes[:, 1:] = self.prior.pixel_rate, self.prior_precision[:, 1:] * offset
        log_pixel_ratio = logarithms[:, 0] - self.log_white_sigma
        value = 0.5 * np.vecdot(slopes[:, 1:], offset) + self.prior.pixel_rate * log_pixel_ratio
        return value, slopes


def _damped_steps(
    best: _Best, damping: Float[np.ndarray, "searches"], units: Float[np.ndarray, "kinds"]
) -> tuple[Float[np.ndarray, "searches kinds"], Float[np.ndarray, "searches"]]:
    """Return the changes of x of one damped Fisher scoring step, and the increases they predict.

    With damping, a variance component that tends to zero approaches it by a factor per step.
    """
    # (H + lambda 1) d = -g, in the units of the coordinates; H is the expected Hessian, g the
    # gradient.
    gradient_in_units = units * best.gradient
    hessian = best.expected_hessian * np.outer(units, units)
    damped = with_added_diagonal(hessian, damping[:, None])
    step = -np.linalg.solve(damped, gradient_in_units[..., None])[..., 0]
    longest = np.abs(units * step).max(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        step = step * np.minimum(MAX_LOG_STEP / longest, 1.0)[:, None]
    predicted_increase = -np.vecdot(
        step, gradient_in_units + 0.5 * (hessian @ step[..., None])[..., 0]
    )
    # log sigma += log(1 + 2 d) / 2 multiplies the variance by 1 + 2 d. The expectation is linear in
    # the variances, so that a single variance component is found in one step.
    variance_factors = np.maximum(1.0 + 2.0 * units * step, np.exp(-2.0 * MAX_LOG_STEP))
    return 0.5 * np.log(variance_factors), predicted_increase
