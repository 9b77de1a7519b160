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
        x, y = ideal[..., 0], ideal[..., 1]
        strength = self.k1 * (x * x + y * y)
        valid = strength > -_FOLD
        ratio = _radius_ratio(jnp.where(valid, strength, 0.0))
        return jnp.stack([x * ratio, y * ratio], axis=-1), valid

    def undistort_normalised(
        self, distorted: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        strength = self.k1 * jnp.sum(distorted**2, axis=-1)
        return distorted * (1.0 + strength[..., None]), 1.0 + 3.0 * strength > 0.0


_FOLD = 4.0 / 27.0
"""`-k1 r'^2` where the cubic of `_radius_ratio` loses its root."""

_HALF_ROOT_3 = 0.75**0.5


@jax.custom_jvp
def _radius_ratio(strength: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """The root g of `g + q g^3 = 1`, continuous with g = 1 at q = 0, where `q = k1 r'^2`.

    `g = r~ / r'`. Halley's steps from a start that is exact at 0 and at the fold, and has the
    fold's square root: full precision up to a strength of 1e6, where transcendental forms of the
    root cost eight times as much.
    """
    to_fold = jnp.sqrt(jnp.maximum(1.0 + strength / _FOLD, 0.0))
    shrinking = jnp.sqrt(jnp.sqrt(1.0 / (1.0 + 4.0 * jnp.maximum(strength, 0.0))))
    growing = 1.5 - _HALF_ROOT_3 * to_fold + (_HALF_ROOT_3 - 0.5) * to_fold * to_fold
    ratio = jnp.where(strength < 0.0, growing, shrinking)
    for _ in range(4):
        value = ratio * (1.0 + strength * ratio * ratio) - 1.0
        slope = 1.0 + 3.0 * strength * ratio * ratio
        # Half of value times curvature; the bound only matters at the fold itself.
        turn = 3.0 * strength * ratio * value
        ratio = ratio - value * slope / jnp.maximum(slope * slope - turn, 1e-12)
    return ratio


@_radius_ratio.defjvp
def _radius_ratio_jvp(primals, tangents):
    (strength,), (strength_dot,) = primals, tangents
    ratio = _radius_ratio(strength)
    # The implicit function theorem; nothing is differentiated through the solution's steps.
    return ratio, -(ratio**3) / (1.0 + 3.0 * strength * ratio**2) * strength_dot
