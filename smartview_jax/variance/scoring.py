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
    Integral,
    LinearisedViews,
    Sizes,
    draws,
    integrate,
    members,
    slopes,
)

WIDEST = 15.0
"""Largest change of the logarithm of a standard deviation, from the start of the search."""

LONGEST = 3.0
"""Largest step of the logarithm of a standard deviation: a factor of twenty."""

EDGE = 0.01
"""Smallest excess over a lower bound at which a search starts, as a fraction of the bound.

The excess of a standard deviation s over its lower bound b is `sqrt(s^2 - b^2)`.
"""

ENOUGH = 1e-4
"""Increase of the log-likelihood that a further step predicts, below which the search ends."""

STEPS = 100
"""Largest number of steps of the search."""

FIRST_DAMPING, DAMPINGS = 1e-2, (1e-6, 1e8)
"""Damping of the first step (FIRST_DAMPING), and its lower and upper limit (DAMPINGS)."""


class SizePrior(NamedTuple):
    """Independent prior distributions of the standard deviations of errors.

    Attributes:
        median: medians of the log-normal priors of the robot's errors: translation, rotation, each
            group of the field.
        spread: standard deviations of their logarithms.
        pixel_rate: rate of the exponential prior of log(effective pixel sigma / white pixel sigma).
    """

    median: Float[Array, "robot"]
    spread: Float[Array, "robot"]
    pixel_rate: Float[Array, ""]


class Likeliest(NamedTuple):
    """The result of maximising the restricted likelihood, or the posterior.

    Attributes:
        sizes: the standard deviations of all errors at the maximum.
        deviance: -2 log of the restricted likelihood there; with a prior, plus twice the prior's
            negative logarithm.
        gained: decrease of the deviance from the start of the search.
        information: Fisher information of the logarithms of the sizes, plus the prior's precision.
        steps: number of steps tried.
    """

    sizes: Sizes
    deviance: Float[Array, ""]
    gained: Float[Array, ""]
    information: Float[Array, "kinds kinds"]
    steps: Int[Array, ""]


def fisher_information(
    views: LinearisedViews, at: Integral, groups: int
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
        at: result of `integrate` at the sizes in question.
        groups: number of groups of the field.
    """
    # Blocks of C, with K_v the gain of a view and D_v its own block: C_ss (shared),
    # C_vs = -K_v C_ss, C_vw = K_v C_ss K_w^T, and D_v^-1 + K_v C_ss K_v^T for a view with itself.
    parts, prior = at.elimination, at.precision
    covariance = at.shared_covariance
    carried, own_covariance = parts.gain @ covariance, parts.own_covariance(covariance)
    across = own_covariance - parts.own_inverse

    # P_j as rows of weights: translation, rotation; then the groups of the field, and last the
    # parameters with a known prior.
    kinds = jnp.repeat(jnp.eye(2), 3, axis=1)[None] * prior.corrections[:, None]
    known = (views.group < 0).astype(float)
    rows = jnp.concatenate([members(views, groups), known[None]]) * prior.shared[None]

    # P_j are diagonal: tr(C P_j C P_k) = sum_ab P_j,a C_ab^2 P_k,b, summed block by block.
    among_shared = rows @ covariance**2 @ rows.T
    between = jnp.einsum("vak,vki->ai", kinds, carried**2) @ rows.T
    # Over all pairs of views, tr((C_ss sum_v K_v^T P_j K_v) (C_ss sum_w K_w^T P_k K_w)); the second
    # line corrects the pairs of a view with itself, which have D_v^-1 besides.
    gathered = covariance[None] @ jnp.einsum("vak,vki,vkj->aij", kinds, parts.gain, parts.gain)
    among_own = jnp.einsum("aij,bji->ab", gathered, gathered)
    among_own += jnp.einsum("vak,vbl,vkl->ab", kinds, kinds, own_covariance**2 - across**2)
    both = jnp.block([[among_own, between], [between.T, among_shared]])
    diagonal = jnp.diagonal(own_covariance, axis1=1, axis2=2)
    once = jnp.concatenate(
        [jnp.einsum("vak,vk->a", kinds, diagonal), rows @ jnp.diagonal(covariance)]
    )

    count = draws(views, groups)
    free = jnp.sum(views.own_free.astype(float)) + len(at.factor)
    # C^-1 = P_0 + sum_j P_j with P_0 the information of the pixels. C P_0 = 1 - sum_j C P_j in the
    # formula above, with N the number of marginalised parameters, gives
    # (0, 0): n_0 - N + sum_jk tr(C P_j C P_k),  (0, j): tr(C P_j) - sum_k tr(C P_j C P_k).
    pixel = count[0] - free + jnp.sum(both)
    cross = (once - jnp.sum(both, axis=1))[:-1]
    robot = both[:-1, :-1] + jnp.diag(count[1:] - 2.0 * once[:-1])
    by_precision = jnp.block([[pixel[None, None], cross[None]], [cross[:, None], robot]])
    # log sigma = -log(precision) / 2: a factor of 4, times the half of the formula.
    return 2.0 * by_precision


def likeliest(
    views: LinearisedViews,
    start: Sizes,
    active: Bool[Array, "robot"],
    prior: SizePrior | None = None,
) -> Likeliest:
    """Maximise the restricted likelihood, or the posterior, over the standard deviations of errors.

    Args:
        views: the linearised views.
        start: sizes at which the search begins.
        active: mask of the robot's errors that are fitted: translation, rotation, each group of the
            field; the others stay at zero (their lower bound).
        prior: prior of the sizes; None for none.
    """
    least = views.least(len(start.numbers))
    searched = jnp.concatenate([jnp.ones(1, bool), active])
    begin = 0.5 * jnp.log(jnp.maximum(start.numbers**2 - least**2, (EDGE * least) ** 2))

    # size = sqrt(bound^2 + excess^2) with log(excess) = begin + WIDEST tanh(x / WIDEST): x is
    # unbounded, and no constraint is needed where a size goes to its lower bound.
    def numbers(x: Float[Array, "kinds"]) -> Float[Array, "kinds"]:
        """Return the standard deviations at a point of the search."""
        beyond = jnp.exp(begin + WIDEST * jnp.tanh(x / WIDEST))
        return jnp.where(searched, jnp.hypot(least, beyond), least)

    def expanded(x: Float[Array, "kinds"]) -> _Expansion:
        """Evaluate objective, gradient and information matrix at a point of the search."""
        logarithms, along = jax.jvp(lambda x: jnp.log(numbers(x)), (x,), (jnp.ones_like(x),))
        sizes = Sizes.of(jnp.exp(logarithms))
        at = integrate(views, sizes)
        slope = 0.5 * slopes(views, sizes, at).numbers * sizes.numbers
        told = fisher_information(views, at, len(sizes.field))
        penalty, pull, precision = _penalty(logarithms, jnp.log(least[0]), active, prior)
        told, deviance = told + jnp.diag(precision), at.deviance + 2.0 * penalty
        return _Expansion(
            x, sizes, deviance, told, along * (slope + pull), told * jnp.outer(along, along)
        )

    # A standard deviation estimated from n random numbers has a logarithm with standard deviation
    # of about 1 / sqrt(2 n), which is the unit of each coordinate of the search.
    unit = 1.0 / jnp.sqrt(2.0 * jnp.maximum(draws(views, len(start.field)), 1.0))
    first = expanded(jnp.zeros_like(begin))
    search = _Search(first, jnp.array(FIRST_DAMPING), jnp.array(0), jnp.array(False))
    search = jax.lax.while_loop(
        lambda s: (s.steps < STEPS) & ~s.done, lambda s: _stepped(s, expanded, unit), search
    )
    best = search.best
    gained = first.deviance - best.deviance
    return Likeliest(best.sizes, best.deviance, gained, best.information, search.steps)


def _penalty(
    logarithms: Float[Array, "kinds"],
    white: Float[Array, ""],
    active: Bool[Array, "robot"],
    prior: SizePrior | None,
) -> tuple[Float[Array, ""], Float[Array, "kinds"], Float[Array, "kinds"]]:
    """Return the prior's negative logarithm, and two derivatives of it by the log sizes."""
    if prior is None:
        nothing = jnp.zeros_like(logarithms)
        return jnp.zeros(()), nothing, nothing
    precision = jnp.where(active, prior.spread**-2, 0.0)
    off = logarithms[1:] - jnp.log(prior.median)
    value = 0.5 * jnp.sum(precision * off**2) + prior.pixel_rate * (logarithms[0] - white)
    pull = jnp.concatenate([prior.pixel_rate[None], precision * off])
    return value, pull, jnp.pad(precision, (1, 0))


class _Expansion(NamedTuple):
    """The objective at a point x of the search.

    `slope` and `curvature` are the gradient of half the deviance and its expected Hessian, by x.
    """

    x: Float[Array, "kinds"]
    sizes: Sizes
    deviance: Float[Array, ""]
    information: Float[Array, "kinds kinds"]
    slope: Float[Array, "kinds"]
    curvature: Float[Array, "kinds kinds"]


class _Search(NamedTuple):
    """The state of the search: best point, damping, number of steps, and whether done."""

    best: _Expansion
    damping: Float[Array, ""]
    steps: Int[Array, ""]
    done: Bool[Array, ""]


def _stepped(
    search: _Search,
    expanded: Callable[[Float[Array, "kinds"]], _Expansion],
    unit: Float[Array, "kinds"],
) -> _Search:
    """Take one damped Fisher scoring step, and adapt the damping.

    With damping, a variance component that tends to zero approaches it by a factor per step.
    """
    best, damping = search.best, search.damping
    # (I + lambda 1) d = -g, in the units of the coordinates; I is the information, g the gradient.
    slope, curvature = unit * best.slope, best.curvature * jnp.outer(unit, unit)
    move = -jnp.linalg.solve(curvature + damping * jnp.eye(len(unit)), slope)
    move = move * jnp.minimum(1.0, LONGEST / jnp.max(jnp.abs(unit * move)))
    promise = -move @ (slope + 0.5 * curvature @ move)
    # log sigma += log(1 + 2 d) / 2 multiplies the variance by 1 + 2 d. The expectation is linear in
    # the variances, so that a single variance component is found in one step.
    variances = jnp.maximum(1.0 + 2.0 * unit * move, jnp.exp(-2.0 * LONGEST))
    tried = expanded(best.x + 0.5 * jnp.log(variances))
    gain = 0.5 * (best.deviance - tried.deviance)
    better = gain > 0.0
    best = jax.tree.map(lambda new, old: jnp.where(better, new, old), tried, best)
    # Damping by the ratio of actual to predicted gain: a fifth above 0.5, six times below 0.1.
    factor = jnp.where(gain > 0.5 * promise, 0.2, jnp.where(gain > 0.1 * promise, 1.0, 6.0))
    damping = jnp.clip(damping * factor, *DAMPINGS)
    return _Search(best, damping, search.steps + 1, promise < ENOUGH)
