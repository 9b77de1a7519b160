"""Define the paper's lens (Eq. 3): one radial coefficient, from distorted to ideal coordinates."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..runtime.array_namespace import as_float_array
from .lens import AbstractPerspectiveLens


class Radial(AbstractPerspectiveLens):
    """A lens with one radial coefficient that maps distorted to ideal coordinates (Eq. 3).

        u' = u~ + k1 u~ (u~^2 + v~^2)

    Here `u~` is distorted and `u'` ideal; OpenCV's models map in the opposite direction. For
    `k1 < 0` the map folds where `1 + 3 k1 r~^2 = 0`. Beyond this radius `undistort` is not valid,
    and `distort` has no solution for ideal radii over `2 / (3 sqrt(-3 k1))`.
    """

    k1: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)

    def distort_normalised(
        self, ideal: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Return distorted from ideal normalised coordinates, and whether each is valid."""
        # u~ = g u' with the root g of g + q g^3 = 1 and q = k1 r'^2
        x, y = ideal[..., 0], ideal[..., 1]
        strength = self.k1 * (x * x + y * y)
        valid = strength > -_FOLD_STRENGTH
        ratio = _radius_ratio(jnp.where(valid, strength, 0.0))
        return jnp.stack([x * ratio, y * ratio], axis=-1), valid

    def undistort_normalised(
        self, distorted: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Return ideal from distorted normalised coordinates, and whether each is valid."""
        # u' = u~ (1 + k1 r~^2), valid where dr'/dr~ = 1 + 3 k1 r~^2 > 0
        strength = self.k1 * jnp.sum(distorted**2, axis=-1)
        return distorted * (1.0 + strength[..., None]), 1.0 + 3.0 * strength > 0.0


_FOLD_STRENGTH = 4.0 / 27.0
"""Value of `-k1 r'^2` beyond which the cubic of `_radius_ratio` has no positive root."""

_HALF_ROOT_3 = 0.75**0.5
"""Half the square root of 3, a coefficient of the initial value in `_radius_ratio`."""


@jax.custom_jvp
def _radius_ratio(strength: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Return the distorted over the ideal radius, the root g of `g + q g^3 = 1`.

    Here `g = r~ / r'` and `q = k1 r'^2` is the strength; the root is the one that is continuous
    with g = 1 at q = 0. The result has full precision up to a strength of 1e6.
    """
    # Four Halley steps, g <- g - f f' / (f'^2 - f f'' / 2) with f = g + q g^3 - 1.
    # Closed forms with transcendental functions cost eight times as much.
    # For q < 0 the initial value is exact at q = 0 and at the fold, and behaves as the square root
    # of the distance to the fold, as the root does; for q > 0 it is exact at q = 0.
    fold_distance_root = jnp.sqrt(jnp.maximum(1.0 + strength / _FOLD_STRENGTH, 0.0))
    initial_positive = jnp.sqrt(jnp.sqrt(1.0 / (1.0 + 4.0 * jnp.maximum(strength, 0.0))))
    initial_negative = (
        1.5
        - _HALF_ROOT_3 * fold_distance_root
        + (_HALF_ROOT_3 - 0.5) * fold_distance_root * fold_distance_root
    )
    ratio = jnp.where(strength < 0.0, initial_negative, initial_positive)
    for _ in range(4):
        value = ratio * (1.0 + strength * ratio * ratio) - 1.0
        derivative = 1.0 + 3.0 * strength * ratio * ratio
        # f f'' / 2 = 3 q g f. The bound on the denominator only matters at the fold itself.
        curvature_term = 3.0 * strength * ratio * value
        ratio = ratio - value * derivative / jnp.maximum(
            derivative * derivative - curvature_term, 1e-12
        )
    return ratio


@_radius_ratio.defjvp
def _radius_ratio_jvp(primals, tangents):
    """Return the radius ratio and its directional derivative."""
    # Implicit function theorem on g + q g^3 = 1:   dg = -g^3 / (1 + 3 q g^2) dq.
    # The iterations themselves are not differentiated.
    (strength,), (strength_dot,) = primals, tangents
    ratio = _radius_ratio(strength)
    return ratio, -(ratio**3) / (1.0 + 3.0 * strength * ratio**2) * strength_dot
