"""Define the range of views that may be chosen, with random sampling and unbounded coordinates."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..geometry import look_at

NEAREST = 0.995
"""Fraction of a limit to which numbers are clipped before conversion to unbounded coordinates.

The limit itself would be at infinity.
"""


class ViewRange(eqx.Module):
    """A range of camera poses that look at a point from within a cone.

    A view is six numbers: the horizontal part (x, y) of the unit vector from the point of aim to
    the camera; the horizontal offset (x, y) of the point of aim, m; roll, rad; and distance, m.
    Unlike tilt and azimuth they are smooth at the vertical.

    Attributes:
        point: the point that all views look at, m.
        distance: smallest and largest distance, m.
        tilt: largest tilt, less than a right angle, rad.
        roll: largest roll in either direction, rad; pi allows any roll.
        beside: largest horizontal distance from the point to the point of aim, m.
        above: as in `direction_of`.
    """

    point: Float[Array, "3"] = eqx.field(converter=jnp.asarray)
    distance: tuple[float, float] = eqx.field(static=True)
    tilt: float = eqx.field(static=True, converter=float)
    roll: float = eqx.field(static=True, converter=float, default=float(np.pi))
    beside: float = eqx.field(static=True, converter=float, default=0.0)
    above: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        near, far = self.distance
        if not 0.0 < near < far < np.inf:
            raise ValueError(f"distance: expected 0 < least < greatest, found {self.distance}")
        if not 0.0 < self.tilt < 0.5 * np.pi:
            raise ValueError(f"tilt: expected between 0 and a right angle, found {self.tilt}")
        if not self.roll > 0.0:
            raise ValueError(f"roll: expected a positive angle, found {self.roll}")

    def drawn(self, rng: np.random.Generator, count: int) -> Float[Array, "count 6"]:
        """Return random views, uniform in tilt, roll, distance and azimuth within the limits."""
        sine = np.sin(rng.uniform(0.0, self.tilt, count))
        azimuth = rng.uniform(0.0, 2.0 * np.pi, count)
        roll = rng.uniform(-self.roll, self.roll, count)
        away = rng.uniform(*self.distance, count)
        # The square root makes the point of aim uniform over the disc's area.
        shift = self.beside * np.sqrt(rng.uniform(0.0, 1.0, count))
        where = rng.uniform(0.0, 2.0 * np.pi, count)
        aside = (sine * np.cos(azimuth), sine * np.sin(azimuth))
        looking = (shift * np.cos(where), shift * np.sin(where))
        return jnp.asarray(np.stack([*aside, *looking, roll, away], axis=1))

    def poses(self, numbers: Float[Array, "*views 6"]) -> SE3:
        """Return `camera_from_world` of views."""
        x, y, right, up, roll, away = jnp.moveaxis(numbers, -1, 0)
        height = jnp.sqrt(1.0 - x**2 - y**2)
        towards = jnp.stack([x, y, height if self.above else -height], axis=-1)
        beside = jnp.stack([right, up, jnp.zeros_like(up)], axis=-1)
        point = jnp.broadcast_to(self.point, beside.shape) + beside
        return look_at(point, -towards, away, roll)

    def without_limits(self, numbers: Float[Array, "*views 6"]) -> Float[Array, "*views 6"]:
        """Return unbounded coordinates of views, for solvers without limits."""
        roll, away = jnp.moveaxis(numbers[..., 4:], -1, 0)
        middle, half = self._distances
        return self._joined(
            _widened(numbers[..., :2], np.sin(self.tilt)),
            _widened(numbers[..., 2:4], self.beside),
            # A roll of any size is allowed here, since it is periodic.
            roll[..., None] if self.roll >= np.pi else _widened(roll[..., None], self.roll),
            _widened((away - middle)[..., None], half),
        )

    def within_limits(self, numbers: Float[Array, "*views 6"]) -> Float[Array, "*views 6"]:
        """Return views from their unbounded coordinates, the inverse of `without_limits`."""
        roll, away = numbers[..., 4:5], numbers[..., 5:]
        middle, half = self._distances
        return self._joined(
            _narrowed(numbers[..., :2], np.sin(self.tilt)),
            _narrowed(numbers[..., 2:4], self.beside),
            roll if self.roll >= np.pi else _narrowed(roll, self.roll),
            middle + _narrowed(away, half),
        )

    @staticmethod
    def _joined(*parts: Float[Array, "*views _"]) -> Float[Array, "*views 6"]:
        """Return the parts of views concatenated."""
        return jnp.concatenate(parts, axis=-1)

    @property
    def _distances(self) -> tuple[float, float]:
        """The middle of the distances and half their range, m."""
        near, far = self.distance
        return 0.5 * (near + far), 0.5 * (far - near)


def _widened(numbers: Float[Array, "*views n"], limit: float) -> Float[Array, "*views n"]:
    """Return an unbounded vector for a vector no longer than a limit."""
    if not limit:
        return numbers
    # x = limit * w / sqrt(1 + |w|^2), solved for w after clipping |x| to NEAREST * limit.
    share = numbers / limit
    square = jnp.sum(share**2, axis=-1, keepdims=True)
    share = share * jnp.sqrt(jnp.minimum(1.0, NEAREST**2 / jnp.maximum(square, NEAREST**2)))
    return share / jnp.sqrt(1.0 - jnp.minimum(square, NEAREST**2))


def _narrowed(numbers: Float[Array, "*views n"], limit: float) -> Float[Array, "*views n"]:
    """Return a vector no longer than a limit for an unbounded vector, the inverse of `_widened`."""
    return limit * numbers / jnp.sqrt(1.0 + jnp.sum(numbers**2, axis=-1, keepdims=True))
