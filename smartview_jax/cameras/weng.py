"""Define Weng's lens: radial, decentring and thin-prism terms, from distorted to ideal."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..runtime.array_namespace import as_float_array
from .inversion import implicit_inverse, is_unfolded
from .lens import AbstractPerspectiveLens


class Weng(AbstractPerspectiveLens):
    """A lens with radial, decentring and thin-prism distortion.

    With `(x, y)` distorted and `s = x^2 + y^2`, the ideal coordinates are

        x' = x + (g1 + g3) x^2 + g4 x y + g1 y^2 + k1 x s
        y' = y + g2 x^2 + g3 x y + (g2 + g4) y^2 + k1 y s

    with `g1 = s1 + p1`, `g2 = s2 + p2`, `g3 = 2 p1`, `g4 = 2 p2` (thin prism s, decentring p). The
    model is linear in its coefficients, which Weng's second step uses; with `k1` alone it equals
    `Radial`.

    Reference: Weng, Cohen, Herniou, PAMI 14(10), 1992, Eq. 11.
    """

    k1: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)
    g1: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)
    g2: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)
    g3: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)
    g4: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)

    def distort_normalised(
        self, ideal: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Return distorted from ideal normalised coordinates, and whether each is valid."""
        return implicit_inverse(self._undistort_unchecked, ideal, ideal)

    def undistort_normalised(
        self, distorted: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Return ideal from distorted normalised coordinates, and whether each is valid."""
        # A point beyond a fold may pass the test for folds itself, so points between the centre and
        # it are tested, too.
        valid = jnp.ones(distorted.shape[:-1], dtype=bool)
        for fraction in (0.25, 0.5, 0.75, 1.0):
            valid &= is_unfolded(self._undistort_unchecked, fraction * distorted)
        return self._undistort_unchecked(distorted), valid

    def _undistort_unchecked(self, distorted: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """Return ideal from distorted normalised coordinates, without a test of validity."""
        x, y = distorted[..., 0], distorted[..., 1]
        radial = self.k1 * (x * x + y * y)
        return jnp.stack(
            [
                x + (self.g1 + self.g3) * x * x + self.g4 * x * y + self.g1 * y * y + radial * x,
                y + self.g2 * x * x + self.g3 * x * y + (self.g2 + self.g4) * y * y + radial * y,
            ],
            axis=-1,
        )
