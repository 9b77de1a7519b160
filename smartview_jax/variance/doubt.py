"""What it means for a fit's parameters that the sizes of errors were found, and not given.

References:
    Kackar and Harville, Approximations for standard errors of estimators of fixed and random
    effects in mixed linear models, 1984.
    Kenward and Roger, Small sample inference for fixed effects from restricted maximum likelihood,
    1997.
    Satterthwaite, An approximate distribution of estimates of variance components, 1946.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import chdtrc, fdtrc

from .likelihood import LinearisedViews, Sizes, integrate
from .scoring import Likeliest

UNTOLD = 3.0
"""Deviation of a size's logarithm where the views say nothing of it."""


class Doubt(NamedTuple):
    """How uncertain sizes make the parameters uncertain.

    Attributes:
        relative_std: deviations of the sizes' logarithms.
        covariance: what they add to the parameters'.
        freedom: degrees of freedom that each parameter's deviation rests on; infinite where no size
            matters to it.
        spread: covariance of the logarithms of the sizes, beyond the least that each can be.
        by_size: derivative of the parameters' covariance by each of these.
    """

    relative_std: Float[Array, "kinds"]
    covariance: Float[Array, "shared shared"]
    freedom: Float[Array, "shared"]
    spread: Float[Array, "kinds kinds"]
    by_size: Float[Array, "kinds shared shared"]

    def of(self, chosen: np.ndarray) -> "Doubt":
        """That of some of the parameters, by their places."""
        pairs = np.ix_(chosen, chosen)
        return self._replace(
            covariance=self.covariance[pairs],
            freedom=self.freedom[chosen],
            by_size=self.by_size[:, *pairs],
        )


def doubt(views: LinearisedViews, found: Likeliest) -> Doubt:
    """How the sizes' own uncertainty carries over, to first order in their logarithms.

    A size at the least that it can be moves nothing: it can but grow, and half of the time it is
    there because it truly is. The covariance grows by twice what Kackar and Harville have, since
    at sizes that scatter about the true ones it is too small by as much on average (Kenward and
    Roger).
    """

    def fitted(logarithms: Float[Array, "kinds"]) -> tuple[tuple[Array, Array], Array]:
        at = integrate(views, Sizes.of(jnp.exp(logarithms)))
        covariance = at.shared_covariance
        return (at.step.shared, covariance), jnp.diagonal(covariance)

    numbers = found.sizes.numbers
    (moves, by_size), variance = jax.jacfwd(fitted, has_aux=True)(jnp.log(numbers))
    # By the logarithm of what a size has beyond its least: d log(size) / d log(beyond).
    along = jnp.maximum(1.0 - (views.least(len(numbers)) / numbers) ** 2, 0.0)
    vague = jnp.eye(len(numbers)) / UNTOLD**2
    spread = jnp.linalg.inv(found.information * jnp.outer(along, along) + vague)
    moves, by_size = along[None] * moves, along[None, None] * by_size

    grows = jnp.diagonal(by_size).T / variance[:, None]
    # A variance that rests on n degrees of freedom has a logarithm of variance 2 / n.
    known = jnp.sum((grows @ spread) * grows, axis=1)
    freedom = jnp.where(known > 0.0, 2.0 / jnp.where(known > 0.0, known, 1.0), jnp.inf)
    relative = jnp.sqrt(jnp.diagonal(jnp.linalg.inv(found.information + vague)))
    return Doubt(
        relative, 2.0 * moves @ spread @ moves.T, freedom, spread, jnp.moveaxis(by_size, -1, 0)
    )


def p_value(
    offset: Float[np.ndarray, "numbers"],
    covariance: Float[np.ndarray, "numbers numbers"],
    doubt: Doubt | None = None,
) -> float:
    """Chance of estimates at least as far from the truth as by `offset`, all together.

    By the chi-square distribution; by F, scaled as Kenward and Roger have it, where the sizes of
    errors were found.

    Args:
        offset: of the estimates from what would be true.
        covariance: stated of these numbers.
        doubt: of these numbers, where sizes were found.
    """
    count, square = len(offset), float(offset @ np.linalg.solve(covariance, offset))
    scale, freedom = (1.0, np.inf) if doubt is None else _scaled_f(covariance, doubt)
    if np.isinf(freedom):
        return float(chdtrc(count, square))
    return float(fdtrc(count, freedom, scale * square / count))


def _scaled_f(
    covariance: Float[np.ndarray, "numbers numbers"], doubt: Doubt
) -> tuple[float, float]:
    """Scale, and degrees of freedom of the denominator, of Kenward and Roger's F."""
    count = len(covariance)
    given = np.asarray(covariance - doubt.covariance)
    shares = np.linalg.solve(given[None], np.asarray(doubt.by_size))
    traces, spread = np.trace(shares, axis1=1, axis2=2), np.asarray(doubt.spread)
    of_traces = float(traces @ spread @ traces)
    of_products = float(np.einsum("jk,jab,kba->", spread, shares, shares))
    if of_products < 1e-9 * count:
        return 1.0, np.inf

    g = ((count + 1) * of_traces - (count + 4) * of_products) / ((count + 2) * of_products)
    c = np.array([g, count - g, count + 2 - g]) / (3 * count + 2 * (1 - g))
    b = (of_traces + 6.0 * of_products) / (2.0 * count)
    mean = 1.0 - of_products / count
    # The variance's two factors have poles: beyond them there is no F of that mean and variance.
    first, second = 1.0 - c[1] * b, 1.0 - c[2] * b
    if min(mean, first, second) > 0.0:
        ratio = (1.0 + c[0] * b) / (first**2 * second) * mean**2
        if ratio > 1.0:
            freedom = 4.0 + (count + 2) / (ratio - 1.0)
            return freedom * mean / (freedom - 2.0), freedom
    return 1.0, 2.0 * count / of_products
