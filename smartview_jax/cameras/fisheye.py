"""Define OpenCV's fisheye lens, Kannala and Brandt's polynomial in the angle to the axis."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..runtime.array_namespace import as_float_array
from .inversion import bisected, end_of_increase
from .lens import AbstractLens


class Fisheye(AbstractLens):
    """A fisheye lens whose image radius is a polynomial in the angle to the optical axis.

        theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)

    The angle is computed from the ray itself, so that points at the side of the camera and behind
    it (`z <= 0`) are valid as long as the polynomial increases.

    Reference: Kannala, Brandt, PAMI 28(8), 2006.
    """

    k1: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)
    k2: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)
    k3: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)
    k4: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)

    def distort(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Return the points on the unit image plane that camera-frame points are mapped to."""
        # (x_d, y_d) = (x, y) theta_d(theta) / r   with   r = |(x, y)|,   theta = atan2(r, z)
        xy, z = points[..., :2], points[..., 2]
        square = jnp.sum(xy**2, axis=-1)
        on_axis = square <= _ON_AXIS_TOLERANCE * z**2
        radius = jnp.sqrt(jnp.where(on_axis, 1.0, square))
        angle = jnp.arctan2(radius, z)
        # On the axis, where both vanish, the limit of theta_d / r is 1 / z.
        depth = jnp.where(on_axis & (z > 0.0), z, 1.0)
        ratio = jnp.where(on_axis, 1.0 / depth, self._distorted_angle(angle) / radius)
        valid = jnp.where(on_axis, z > 0.0, angle < self._fold_angle())
        return jnp.where(valid[..., None], xy * ratio[..., None], jnp.nan), valid

    def undistort(
        self, plane_points: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 3"], Bool[Array, "*batch"]]:
        """Return the unit rays that are mapped to points of the unit image plane."""
        # ray = ((x_d, y_d) sin(theta) / r_d, cos(theta))   with   theta_d(theta) = r_d
        square = jnp.sum(plane_points**2, axis=-1)
        on_axis = square <= _ON_AXIS_TOLERANCE
        radius = jnp.sqrt(jnp.where(on_axis, 1.0, square))
        fold = self._fold_angle()
        valid = on_axis | (radius < self._distorted_angle(fold))
        angle = self._undistorted_angle(jnp.where(valid, radius, 0.5 * fold), fold)
        ratio = jnp.where(on_axis, 1.0, jnp.sin(angle) / radius)
        cosine = jnp.where(on_axis, 1.0, jnp.cos(angle))
        ray = jnp.concatenate([plane_points * ratio[..., None], cosine[..., None]], axis=-1)
        return jnp.where(valid[..., None], ray, jnp.nan), valid

    def _distorted_angle(self, angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Return theta_d, the image radius of rays at an angle theta (rad) to the axis."""
        s = angle * angle
        return angle * (1.0 + s * (self.k1 + s * (self.k2 + s * (self.k3 + s * self.k4))))

    def _distorted_angle_derivative(self, angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Return the derivative of theta_d with respect to theta."""
        # 1 + 3 k1 theta^2 + 5 k2 theta^4 + 7 k3 theta^6 + 9 k4 theta^8
        s = angle * angle
        k1, k2, k3, k4 = 3.0 * self.k1, 5.0 * self.k2, 7.0 * self.k3, 9.0 * self.k4
        return 1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)))

    def _fold_angle(self) -> Float[Array, ""]:
        """Return the smallest angle, rad, at which the polynomial stops increasing.

        It is pi if the polynomial increases everywhere.
        """
        return end_of_increase(self._distorted_angle_derivative, _FOLD_SEARCH_ANGLES, np.pi)

    def _undistorted_angle(
        self, distorted: Float[Array, "*batch"], fold: Float[Array, ""]
    ) -> Float[Array, "*batch"]:
        """Return the angle below the fold at which theta_d has a given value, rad.

        Bisection finds a start and Newton's method the solution. Derivatives are computed by the
        implicit function theorem, not through these iterations.
        """

        def solve(residual, guess):
            """Return the angle at which the residual is zero, rad."""
            low, high = jnp.zeros_like(guess), jnp.ones_like(guess) * fold
            low, high = bisected(lambda middle: residual(middle) < 0.0, low, high, 25)
            angle = 0.5 * (low + high)
            # Newton: theta <- theta - (theta_d(theta) - distorted) / theta_d'(theta). The bound on
            # the derivative only matters next to the fold, where it vanishes.
            for _ in range(3):
                angle = angle - residual(angle) / jnp.maximum(
                    self._distorted_angle_derivative(angle), 1e-9
                )
            return angle

        return jax.lax.custom_root(
            lambda angle: self._distorted_angle(angle) - distorted,
            distorted,
            solve,
            lambda linear, value: value / linear(jnp.ones_like(value)),
        )


_FOLD_SEARCH_ANGLES = np.linspace(0.0, np.pi, 400)
"""Angles at which the search for the fold evaluates the derivative, rad."""

_ON_AXIS_TOLERANCE = 1e-24
"""Limit on squared radius over squared depth, below which a point is treated as on the axis."""
