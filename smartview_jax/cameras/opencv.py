"""Define OpenCV's lenses: radial and tangential polynomials from ideal to distorted coordinates."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..runtime.array_namespace import as_float_array
from .inversion import bisected, end_of_increase, implicit_inverse, is_unfolded
from .lens import AbstractPerspectiveLens


class AbstractOpenCVLens(AbstractPerspectiveLens):
    """A lens of OpenCV's radial and tangential model, with up to eight coefficients.

    With the ideal radius r and `s = r^2`, the radial part is

        r' = r (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3)

    and p1, p2 add the tangential part. See the documentation of OpenCV's calib3d module. The model
    is valid up to the smallest radius at which the radial part stops increasing; beyond it OpenCV
    itself returns wrong pixels without a warning. Every such lens has k1, k2, p1 and p2; subclasses
    add the others.
    """

    k1: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)
    k2: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)
    p1: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)
    p2: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)

    @property
    @abc.abstractmethod
    def coefficients(self) -> Float[Array, "8"]:
        """The coefficients k1, k2, p1, p2, k3, k4, k5, k6, in OpenCV's order."""

    def distort_normalised(
        self, ideal: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Return distorted from ideal normalised coordinates, and whether each is valid."""
        # The fold radius bounds the radial part. The tangential part can fold the map earlier,
        # which `is_unfolded` tests at the point itself.
        valid = jnp.sum(ideal**2, axis=-1) < self._fold_radius() ** 2
        inside = jnp.where(valid[..., None], ideal, 0.0)
        # Whether a point is valid is not differentiated.
        fixed, at = jax.lax.stop_gradient((self, inside))
        return self._distort_unchecked(inside), valid & is_unfolded(fixed._distort_unchecked, at)

    def distort_valid(self, ideal: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """Return distorted from ideal normalised coordinates that are known to be valid."""
        return self._distort_unchecked(ideal)

    def undistort_normalised(
        self, distorted: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Return ideal from distorted normalised coordinates, and whether each is valid."""
        # The inverse of the radial part alone is close enough to the solution that Newton's method
        # converges on the whole map.
        fold = self._fold_radius()
        start = self._invert_radial(distorted, jnp.minimum(fold, _MAX_IDEAL_RADIUS))
        ideal, valid = implicit_inverse(self._distort_unchecked, distorted, start)
        return ideal, valid & (jnp.sum(ideal**2, axis=-1) < fold**2)

    def _distort_unchecked(self, ideal: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """Return distorted from ideal normalised coordinates, without a test of validity."""
        # x_d = x ratio + 2 p1 x y + p2 (s + 2 x^2)
        # y_d = y ratio + p1 (s + 2 y^2) + 2 p2 x y
        # ratio = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3),   s = x^2 + y^2
        k1, k2, p1, p2, k3, k4, k5, k6 = self.coefficients
        x, y = ideal[..., 0], ideal[..., 1]
        s = x * x + y * y
        ratio = (1.0 + s * (k1 + s * (k2 + s * k3))) / (1.0 + s * (k4 + s * (k5 + s * k6)))
        return jnp.stack(
            [
                x * ratio + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x),
                y * ratio + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y,
            ],
            axis=-1,
        )

    def _fold_radius(self) -> Float[Array, ""]:
        """Return the smallest ideal radius at which the radial part stops increasing.

        It is infinite if the radial part increases up to the largest of the `_FOLD_SEARCH_RADII`.
        """
        return end_of_increase(self._radial_derivative, _FOLD_SEARCH_RADII, np.inf)

    def _radial_derivative(self, radius: Float[Array, "*grid"]) -> Float[Array, "*grid"]:
        """Return a positive multiple of the derivative of the distorted by the ideal radius.

        It is -1 where the denominator of the radial part is not positive, because the model ends
        there, too.
        """
        # r' = r a(s) / b(s), with s = r^2, the numerator a and the denominator b, has
        #   dr'/dr = ((a + 2 s a') b - 2 s a b') / b^2,   where a' = da/ds, b' = db/ds.
        # The positive factor 1 / b^2 is left out.
        k1, k2, _, _, k3, k4, k5, k6 = jax.lax.stop_gradient(self.coefficients)
        s = radius * radius
        numerator = 1.0 + s * (k1 + s * (k2 + s * k3))
        denominator = 1.0 + s * (k4 + s * (k5 + s * k6))
        numerator_derivative = k1 + s * (2.0 * k2 + 3.0 * s * k3)
        denominator_derivative = k4 + s * (2.0 * k5 + 3.0 * s * k6)
        derivative = (numerator + 2.0 * s * numerator_derivative) * denominator
        derivative = derivative - 2.0 * s * numerator * denominator_derivative
        return jnp.where(denominator > 0.0, derivative, -1.0)

    def _invert_radial(
        self, distorted: Float[Array, "*batch 2"], limit: Float[Array, ""]
    ) -> Float[Array, "*batch 2"]:
        """Return the ideal point whose radial distortion gives a distorted point, by bisection.

        It is the starting point of Newton's method, and is not differentiated.

        Args:
            distorted: normalised coordinates.
            limit: largest ideal radius to consider.
        """
        # 40 halvings find r in r a(r^2) / b(r^2) = r', with the `target_radius` r' = |distorted|
        # and the polynomials a, b of `_radial_derivative`; then ideal = distorted r / r'.
        k1, k2, _, _, k3, k4, k5, k6 = jax.lax.stop_gradient(self.coefficients)
        target_radius = jnp.linalg.norm(jax.lax.stop_gradient(distorted), axis=-1)

        def is_below(radius):
            """Return whether ideal radii are distorted to less than the target radius."""
            s = radius * radius
            denominator = 1.0 + s * (k4 + s * (k5 + s * k6))
            return radius * (1.0 + s * (k1 + s * (k2 + s * k3))) / denominator < target_radius

        low, high = jnp.zeros_like(target_radius), jnp.full_like(target_radius, 1.0) * limit
        low, high = bisected(is_below, low, high, 40)
        ratio = 0.5 * (low + high) / jnp.where(target_radius > 0.0, target_radius, 1.0)
        return (
            jax.lax.stop_gradient(distorted) * jnp.where(target_radius > 0.0, ratio, 1.0)[..., None]
        )


class OpenCV4(AbstractOpenCVLens):
    """A lens with OpenCV's four coefficients k1, k2, p1, p2."""

    @property
    def coefficients(self) -> Float[Array, "8"]:
        """The coefficients in OpenCV's order; k3 to k6 are zero."""
        zero = jnp.zeros(())
        return jnp.stack([self.k1, self.k2, self.p1, self.p2, zero, zero, zero, zero])


class OpenCV5(AbstractOpenCVLens):
    """A lens with OpenCV's five coefficients k1, k2, p1, p2, k3."""

    k3: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)

    @property
    def coefficients(self) -> Float[Array, "8"]:
        """The coefficients in OpenCV's order; k4 to k6 are zero."""
        zero = jnp.zeros(())
        return jnp.stack([self.k1, self.k2, self.p1, self.p2, self.k3, zero, zero, zero])


class OpenCV8(AbstractOpenCVLens):
    """A lens with the eight coefficients k1, k2, p1, p2, k3, k4, k5, k6 of the rational model."""

    k3: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)
    k4: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)
    k5: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)
    k6: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)

    @property
    def coefficients(self) -> Float[Array, "8"]:
        """The coefficients in OpenCV's order."""
        return jnp.stack([self.k1, self.k2, self.p1, self.p2, self.k3, self.k4, self.k5, self.k6])


_FOLD_SEARCH_RADII = np.tan(np.deg2rad(np.linspace(0.0, 89.5, 400)))
"""Ideal radii at which the search for the fold evaluates the derivative.

They are `r/z` of rays up to 89.5 degrees from the axis.
"""

_MAX_IDEAL_RADIUS = float(_FOLD_SEARCH_RADII[-1])
"""Largest ideal radius that the inverse considers where the model has no fold."""
