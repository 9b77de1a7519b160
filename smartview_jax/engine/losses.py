"""Robust losses: how much a deviation costs, as a function of its whitened square.

The fit minimises `1/2 sum rho(s)` with `s = |r|^2` over the observations, `r` being the residual of
one point over the pixel sigma. Least squares sees `r sqrt(rho(s) / s)`, whose square is rho, so any
least-squares solver can be used as it is.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class AbstractLoss(eqx.Module):
    """A loss; `scale` is in standard deviations of a point's deviation."""

    @abc.abstractmethod
    def rho(self, s: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Cost of a squared deviation: `s` near zero, growing more slowly far out."""

    def whiten(self, residual: Float[Array, "*points 2"]) -> Float[Array, "*points 2"]:
        """The residual whose square is the loss."""
        s = jnp.sum(residual**2, axis=-1)
        tiny = s < 1e-12
        # Near zero the ratio is 1; the inner `where` keeps its derivative finite.
        safe = jnp.where(tiny, 1.0, s)
        ratio = jnp.where(tiny, 1.0, self.rho(safe) / safe)
        return residual * jnp.sqrt(ratio)[..., None]


class Huber(AbstractLoss):
    """Quadratic up to `scale`, then linear: `2 scale sqrt(s) - scale^2`."""

    scale: float = 2.0

    def rho(self, s: Float[Array, "*points"]) -> Float[Array, "*points"]:
        return jnp.where(s <= self.scale**2, s, 2.0 * self.scale * jnp.sqrt(s) - self.scale**2)


class Cauchy(AbstractLoss):
    """`scale^2 log(1 + s / scale^2)`."""

    scale: float = 2.5

    def rho(self, s: Float[Array, "*points"]) -> Float[Array, "*points"]:
        return self.scale**2 * jnp.log1p(s / self.scale**2)


class GemanMcClure(AbstractLoss):
    """`s / (1 + s / scale^2)`: bounded, so a gross outlier has no say at all."""

    scale: float = 3.0

    def rho(self, s: Float[Array, "*points"]) -> Float[Array, "*points"]:
        return s / (1.0 + s / self.scale**2)


class StudentT(AbstractLoss):
    """`(dof + 2) log(1 + s / dof)`: twice the negative log-likelihood of a bivariate t."""

    dof: float = 5.0

    def rho(self, s: Float[Array, "*points"]) -> Float[Array, "*points"]:
        return (self.dof + 2.0) * jnp.log1p(s / self.dof)


LOSSES: dict[str, type[AbstractLoss]] = {
    "huber": Huber,
    "cauchy": Cauchy,
    "geman_mcclure": GemanMcClure,
    "student_t": StudentT,
}


def loss_by_name(name: str | AbstractLoss | None) -> AbstractLoss | None:
    """The named loss with its usual scale; None, and a loss, are returned as they are.

    Raises:
        ValueError: an unknown name; the message lists those there are.
    """
    if name is None or isinstance(name, AbstractLoss):
        return name
    if name not in LOSSES:
        raise ValueError(f"loss is one of {', '.join(LOSSES)}, or an AbstractLoss; found {name!r}")
    return LOSSES[name]()
