"""Robust losses that limit the influence of points with large residuals.

The fit minimises `1/2 sum rho(s)` with `s = |r|^2` over the observations, where r is the residual
of a point (two components) divided by the pixel sigma. An ordinary least-squares solver can be used
unchanged with the residual `r sqrt(rho(s) / s)`, whose square is rho.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..argument_checks import require_one_of


class AbstractLoss(eqx.Module):
    """A loss function of the squared whitened residual of a point.

    A `scale` is in standard deviations of a pixel; the loss of much smaller residuals is their
    square.
    """

    @abc.abstractmethod
    def rho(self, s: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Return the loss of a squared whitened residual: `s` near zero, less for large s."""

    def robustify(self, residual: Float[Array, "*points 2"]) -> Float[Array, "*points 2"]:
        """Scale a whitened residual so that its square is the loss."""
        s = jnp.sum(residual**2, axis=-1)
        tiny = s < 1e-12
        # s -> 0: rho / s -> 1. The inner `where` keeps the derivative of the unused branch finite.
        safe = jnp.where(tiny, 1.0, s)
        ratio = jnp.where(tiny, 1.0, self.rho(safe) / safe)
        return residual * jnp.sqrt(ratio)[..., None]


class Huber(AbstractLoss):
    """The Huber loss: quadratic up to `scale`, then linear, `2 scale sqrt(s) - scale^2`."""

    scale: float = 2.0

    def rho(self, s: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Return the loss of a squared whitened residual."""
        return jnp.where(s <= self.scale**2, s, 2.0 * self.scale * jnp.sqrt(s) - self.scale**2)


class Cauchy(AbstractLoss):
    """The Cauchy loss `scale^2 log(1 + s / scale^2)`; an infinite scale is least squares."""

    scale: float | Float[Array, ""] = 2.5

    def rho(self, s: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Return the loss of a squared whitened residual."""
        return jnp.where(jnp.isinf(self.scale), s, self.scale**2 * jnp.log1p(s / self.scale**2))


class GemanMcClure(AbstractLoss):
    """The Geman-McClure loss `s / (1 + s / scale^2)`.

    It is bounded, so that a gross error has no influence.
    """

    scale: float = 3.0

    def rho(self, s: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Return the loss of a squared whitened residual."""
        return s / (1.0 + s / self.scale**2)


class StudentT(AbstractLoss):
    """The loss of t-distributed residuals, `(dof + 2) log(1 + s / dof)`.

    It is twice the negative log-likelihood of a bivariate t distribution, up to a constant.
    """

    dof: float = 5.0

    def rho(self, s: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Return the loss of a squared whitened residual."""
        return (self.dof + 2.0) * jnp.log1p(s / self.dof)


LOSSES: dict[str, type[AbstractLoss]] = {
    "huber": Huber,
    "cauchy": Cauchy,
    "geman_mcclure": GemanMcClure,
    "student_t": StudentT,
}
"""All losses that can be chosen by name."""


def loss_by_name(name: str | AbstractLoss | None) -> AbstractLoss | None:
    """Return the named loss with its usual scale; None, and a loss, are returned unchanged.

    Raises:
        ValueError: the name is unknown; the message lists the known names.
    """
    if name is None or isinstance(name, AbstractLoss):
        return name
    require_one_of("loss", name, LOSSES, ", or an AbstractLoss")
    return LOSSES[name]()
