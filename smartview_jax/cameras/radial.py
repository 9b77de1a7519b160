"""The paper's lens (Eq. 3): one radial coefficient, from distorted to ideal."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, ScalarLike

from .lens import AbstractPerspectiveLens


class Radial(AbstractPerspectiveLens):
    """`u' = u~ + k1 u~ (u~^2 + v~^2)`, with `u~` distorted and `u'` ideal: OpenCV's reverse.

    For `k1 < 0` the map folds where `1 + 3 k1 r~^2 = 0`. Beyond, `undistort` is not valid, and
    `distort` has no solution for ideal radii over `2 / (3 sqrt(-3 k1))`.
    """

    k1: Float[Array, ""]

    def __init__(self, k1: ScalarLike = 0.0):
        self.k1 = jnp.asarray(k1, dtype=float)

    def distort_normalised(
        self, ideal: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        strength = self.k1 * jnp.sum(ideal**2, axis=-1)
        valid = strength > -_FOLD
        ratio = _radius_ratio(jnp.where(valid, strength, 0.0))
        return ideal * ratio[..., None], valid

    def undistort_normalised(
        self, distorted: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        strength = self.k1 * jnp.sum(distorted**2, axis=-1)
        return distorted * (1.0 + strength[..., None]), 1.0 + 3.0 * strength > 0.0


_FOLD = 4.0 / 27.0
"""`-k1 r'^2` where the cubic of `_radius_ratio` loses its root."""


@jax.custom_jvp
def _radius_ratio(strength: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """The root g of `g + q g^3 = 1`, continuous with g = 1 at q = 0, where `q = k1 r'^2`.

    `g = r~ / r'`. The trigonometric and hyperbolic forms of Cardano's root, then one Newton step
    for the digits that cancellation costs.
    """
    scale = jnp.sqrt(jnp.maximum(6.75 * jnp.abs(strength), 1e-12))
    growing = jnp.sinh(jnp.arcsinh(scale) / 3.0)
    shrinking = jnp.sin(jnp.arcsin(jnp.minimum(scale, 1.0)) / 3.0)
    closed = 3.0 / scale * jnp.where(strength >= 0.0, growing, shrinking)
    ratio = jnp.where(jnp.abs(strength) < 1e-8, 1.0 - strength, closed)
    slope = 1.0 + 3.0 * strength * ratio**2
    return ratio - (ratio + strength * ratio**3 - 1.0) / jnp.maximum(slope, 1e-6)


@_radius_ratio.defjvp
def _radius_ratio_jvp(primals, tangents):
    (strength,), (strength_dot,) = primals, tangents
    ratio = _radius_ratio(strength)
    # The implicit function theorem; nothing is differentiated through the solution's steps.
    return ratio, -(ratio**3) / (1.0 + 3.0 * strength * ratio**2) * strength_dot
