"""Uncertainty of a fit's parameters due to estimated, instead of known, variance components.

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
"""Standard deviation of a size's logarithm if the views give no information on it."""


class Doubt(NamedTuple):
    """The contribution of uncertain error sizes to the uncertainty of the parameters.

    Attributes:
        relative_std: standard deviations of the logarithms of the sizes.
        covariance: what the estimated sizes add to the covariance of the parameters.
        freedom: degrees of freedom of each parameter's estimated variance; infinite where no size
            affects it.
        spread: covariance of the logarithms of the sizes' excess over their lower bounds.
        by_size: derivative of the parameters' covariance by each of these logarithms.
    """

    relative_std: Float[Array, "kinds"]
    covariance: Float[Array, "shared shared"]
    freedom: Float[Array, "shared"]
    spread: Float[Array, "kinds kinds"]
    by_size: Float[Array, "kinds shared shared"]

    def of(self, chosen: np.ndarray) -> "Doubt":
        """Return the uncertainty for a subset of the parameters.

        Args:
            chosen: indices of these parameters.
        """
        pairs = np.ix_(chosen, chosen)
        return self._replace(
            covariance=self.covariance[pairs],
            freedom=self.freedom[chosen],
            by_size=self.by_size[:, *pairs],
        )


def doubt(views: LinearisedViews, found: Likeliest) -> Doubt:
    """Propagate the uncertainty of the error sizes to the parameters.

    The propagation is of first order in the logarithms of the sizes. A size at its lower bound has
    no effect: it can only grow, and half of the time it is there because its true value is. The
    added covariance is twice that of Kackar and Harville, because the covariance at estimated sizes
    is too small by the same amount on average (Kenward and Roger).

    Args:
        views: the linearised views.
        found: the estimated sizes and their information matrix.
    """

    def fitted(logarithms: Float[Array, "kinds"]) -> tuple[tuple[Array, Array], Array]:
        """Return the fitted parameters and their covariance for given logarithms of the sizes."""
        at = integrate(views, Sizes.of(jnp.exp(logarithms)))
        covariance = at.shared_covariance
        return (at.step.shared, covariance), jnp.diagonal(covariance)

    numbers = found.sizes.numbers
    (moves, by_size), variance = jax.jacfwd(fitted, has_aux=True)(jnp.log(numbers))
    # size^2 = bound^2 + excess^2: d log(size) / d log(excess) = 1 - (bound / size)^2
    along = jnp.maximum(1.0 - (views.least(len(numbers)) / numbers) ** 2, 0.0)
    vague = jnp.eye(len(numbers)) / UNTOLD**2
    spread = jnp.linalg.inv(found.information * jnp.outer(along, along) + vague)
    moves, by_size = along[None] * moves, along[None, None] * by_size

    # Satterthwaite: Var(log v_i) = a_i^T W a_i for the variance v_i of parameter i, with W =
    # `spread` and a_i the derivatives of log(v_i) by the logarithms that W is the covariance of.
    grows = jnp.diagonal(by_size).T / variance[:, None]
    # The logarithm of a variance with n degrees of freedom has variance 2 / n.
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
    """Compute the probability of estimates at least as far from the truth as `offset`, jointly.

    It is from the chi-square distribution or, where the sizes of errors were estimated, from an F
    distribution scaled according to Kenward and Roger.

    Args:
        offset: difference of the estimates from the hypothetical true values.
        covariance: covariance of these numbers, as reported.
        doubt: uncertainty of these numbers due to estimated sizes; None where the sizes are known.
    """
    count, square = len(offset), float(offset @ np.linalg.solve(covariance, offset))
    scale, freedom = (1.0, np.inf) if doubt is None else _scaled_f(covariance, doubt)
    if np.isinf(freedom):
        return float(chdtrc(count, square))
    return float(fdtrc(count, freedom, scale * square / count))


def _scaled_f(
    covariance: Float[np.ndarray, "numbers numbers"], doubt: Doubt
) -> tuple[float, float]:
    """Compute scale and denominator degrees of freedom of Kenward and Roger's F statistic.

    An infinite number of degrees of freedom means that the sizes do not matter.
    """
    count = len(covariance)
    # Kenward and Roger's A1 = sum_jk W_jk tr(F_j) tr(F_k) and A2 = sum_jk W_jk tr(F_j F_k), with
    # F_j = C^-1 dC/dj for the covariance C without its correction, and W the covariance of the
    # logarithms of the sizes.
    given = np.asarray(covariance - doubt.covariance)
    shares = np.linalg.solve(given[None], np.asarray(doubt.by_size))
    traces, spread = np.trace(shares, axis1=1, axis2=2), np.asarray(doubt.spread)
    of_traces = float(traces @ spread @ traces)
    of_products = float(np.einsum("jk,jab,kba->", spread, shares, shares))
    if of_products < 1e-9 * count:
        return 1.0, np.inf

    # For l numbers and B = (A1 + 6 A2) / (2 l), with c1, c2, c3 as in their paper, F has
    # expectation E = 1 / (1 - A2 / l),
    # variance V = (2 / l) (1 + c1 B) / ((1 - c2 B)^2 (1 - c3 B)),
    # degrees of freedom m = 4 + (l + 2) / (l rho - 1) with rho = V / (2 E^2),
    # and scale m / (E (m - 2)).
    g = ((count + 1) * of_traces - (count + 4) * of_products) / ((count + 2) * of_products)
    c = np.array([g, count - g, count + 2 - g]) / (3 * count + 2 * (1 - g))
    b = (of_traces + 6.0 * of_products) / (2.0 * count)
    mean = 1.0 - of_products / count
    # Beyond the poles of V no F distribution has these moments. The fallback, 2 l / A2, is
    # Satterthwaite's for a single number.
    first, second = 1.0 - c[1] * b, 1.0 - c[2] * b
    if min(mean, first, second) > 0.0:
        ratio = (1.0 + c[0] * b) / (first**2 * second) * mean**2
        if ratio > 1.0:
            freedom = 4.0 + (count + 2) / (ratio - 1.0)
            return freedom * mean / (freedom - 2.0), freedom
    return 1.0, 2.0 * count / of_products
