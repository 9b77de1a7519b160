"""The sizes of errors that make what is observed likeliest, by Fisher scoring.

Newton's steps, with the curvature that is to be expected in the place of the one there is: it is
never negative, and costs no derivative beyond the first.

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
"""Logarithms of deviations are kept within this of where the search began."""

LONGEST = 3.0
"""Step of a logarithm, at most: a factor of twenty."""

EDGE = 0.01
"""Of the least that a size can be, in squares above it, where a search begins that starts there."""

ENOUGH = 1e-4
"""Half the deviance that a further step promises, below which the search ends."""

STEPS = 100
"""Of the search, at most."""

FIRST_DAMPING, DAMPINGS = 1e-2, (1e-6, 1e8)


class SizePrior(NamedTuple):
    """Independent priors on the sizes of errors.

    Attributes:
        median: of the log-normal priors of the robot's errors: translation, rotation, each group.
        spread: standard deviations of their logarithms.
        pixel_rate: of the exponential prior of the logarithm of the effective pixel sigma over the
            white one.
    """

    median: Float[Array, "robot"]
    spread: Float[Array, "robot"]
    pixel_rate: Float[Array, ""]


class Likeliest(NamedTuple):
    """Where the search ended.

    Attributes:
        sizes: of all errors.
        deviance: there, with twice the prior's negative logarithm where there is a prior.
        gained: by how much it was higher where the search began.
        information: Fisher's, of the logarithms of the sizes, with the prior's precision.
        steps: that were tried.
    """

    sizes: Sizes
    deviance: Float[Array, ""]
    gained: Float[Array, ""]
    information: Float[Array, "kinds kinds"]
    steps: Int[Array, ""]


def fisher_information(
    views: LinearisedViews, at: Integral, groups: int
) -> Float[Array, "kinds kinds"]:
    """Fisher's information of the logarithms of the sizes.

    With the precision P_j of each kind of random number, and the covariance C of all that is
    integrated out, by the logarithms of two precisions it is half of

        tr(C P_j C P_k) + [j = k] (n_j - 2 tr(C P_j))

    and the pixels' follows, since the precisions of pixels and priors are C's inverse together.

    Args:
        views: linearised.
        at: where, as `integrate` has it.
        groups: of the field.
    """
    parts, prior = at.elimination, at.precision
    covariance = at.shared_covariance
    carried, own_covariance = parts.gain @ covariance, parts.own_covariance(covariance)
    across = own_covariance - parts.own_inverse

    # Rows by kind: translation, rotation; groups of the field, and what has a known prior.
    kinds = jnp.repeat(jnp.eye(2), 3, axis=1)[None] * prior.corrections[:, None]
    known = (views.group < 0).astype(float)
    rows = jnp.concatenate([members(views, groups), known[None]]) * prior.shared[None]

    among_shared = rows @ covariance**2 @ rows.T
    between = jnp.einsum("vak,vki->ai", kinds, carried**2) @ rows.T
    # Over pairs of views a product of traces; a view with itself has its own inverse besides.
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
    pixel = count[0] - free + jnp.sum(both)
    cross = (once - jnp.sum(both, axis=1))[:-1]
    robot = both[:-1, :-1] + jnp.diag(count[1:] - 2.0 * once[:-1])
    by_precision = jnp.block([[pixel[None, None], cross[None]], [cross[:, None], robot]])
    # A deviation's logarithm is minus half its precision's: four times half.
    return 2.0 * by_precision


def likeliest(
    views: LinearisedViews,
    start: Sizes,
    active: Bool[Array, "robot"],
    prior: SizePrior | None = None,
) -> Likeliest:
    """Maximise the restricted likelihood, or the posterior, over the sizes of errors.

    Args:
        views: linearised.
        start: where the search begins.
        active: which errors of the robot may have a size: of translation, of rotation, of each
            group of the field; the others have none.
        prior: of the sizes; None for none.
    """
    least = views.least(len(start.numbers))
    searched = jnp.concatenate([jnp.ones(1, bool), active])
    begin = 0.5 * jnp.log(jnp.maximum(start.numbers**2 - least**2, (EDGE * least) ** 2))

    def numbers(x: Float[Array, "kinds"]) -> Float[Array, "kinds"]:
        beyond = jnp.exp(begin + WIDEST * jnp.tanh(x / WIDEST))
        return jnp.where(searched, jnp.hypot(least, beyond), least)

    def expanded(x: Float[Array, "kinds"]) -> _Expansion:
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

    # A size that rests on n draws has a logarithm known to about 1 / sqrt(2 n).
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
    """Return the prior's negative logarithm, and its first and second derivatives by the sizes'."""
    if prior is None:
        nothing = jnp.zeros_like(logarithms)
        return jnp.zeros(()), nothing, nothing
    precision = jnp.where(active, prior.spread**-2, 0.0)
    off = logarithms[1:] - jnp.log(prior.median)
    value = 0.5 * jnp.sum(precision * off**2) + prior.pixel_rate * (logarithms[0] - white)
    pull = jnp.concatenate([prior.pixel_rate[None], precision * off])
    return value, pull, jnp.pad(precision, (1, 0))


class _Expansion(NamedTuple):
    """About a point of the search; slope and curvature are half the deviance's, by the point."""

    x: Float[Array, "kinds"]
    sizes: Sizes
    deviance: Float[Array, ""]
    information: Float[Array, "kinds kinds"]
    slope: Float[Array, "kinds"]
    curvature: Float[Array, "kinds kinds"]


class _Search(NamedTuple):
    best: _Expansion
    damping: Float[Array, ""]
    steps: Int[Array, ""]
    done: Bool[Array, ""]


def _stepped(
    search: _Search,
    expanded: Callable[[Float[Array, "kinds"]], _Expansion],
    unit: Float[Array, "kinds"],
) -> _Search:
    """Levenberg's step; damped, a size that wants to be nothing becomes so a factor at a time."""
    best, damping = search.best, search.damping
    slope, curvature = unit * best.slope, best.curvature * jnp.outer(unit, unit)
    move = -jnp.linalg.solve(curvature + damping * jnp.eye(len(unit)), slope)
    move = move * jnp.minimum(1.0, LONGEST / jnp.max(jnp.abs(unit * move)))
    promise = -move @ (slope + 0.5 * curvature @ move)
    # A step of variances, in which the expectation is linear: one alone is found in one step.
    variances = jnp.maximum(1.0 + 2.0 * unit * move, jnp.exp(-2.0 * LONGEST))
    tried = expanded(best.x + 0.5 * jnp.log(variances))
    gain = 0.5 * (best.deviance - tried.deviance)
    better = gain > 0.0
    best = jax.tree.map(lambda new, old: jnp.where(better, new, old), tried, best)
    factor = jnp.where(gain > 0.5 * promise, 0.2, jnp.where(gain > 0.1 * promise, 1.0, 6.0))
    damping = jnp.clip(damping * factor, *DAMPINGS)
    return _Search(best, damping, search.steps + 1, promise < ENOUGH)
