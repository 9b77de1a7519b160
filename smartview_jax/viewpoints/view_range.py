"""Define the range of views that may be chosen, with random sampling and unbounded coordinates."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..geometry import look_at
from ..runtime.compilation import one_program

MAX_LIMIT_FRACTION = 0.995
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
        max_aim_offset: largest horizontal distance from the point to the point of aim, m.
        above: as in `viewing_direction`.
    """

    point: Float[Array, "3"] = eqx.field(converter=jnp.asarray)
    distance: tuple[float, float] = eqx.field(static=True)
    tilt: float = eqx.field(static=True, converter=float)
    roll: float = eqx.field(static=True, converter=float, default=float(np.pi))
    max_aim_offset: float = eqx.field(static=True, converter=float, default=0.0)
    above: bool = eqx.field(static=True, default=True)

    def __check_init__(self) -> None:
        near, far = self.distance
        if not 0.0 < near < far < np.inf:
            raise ValueError(f"distance: expected 0 < least < greatest, found {self.distance}")
        if not 0.0 < self.tilt < 0.5 * np.pi:
            raise ValueError(f"tilt: expected between 0 and a right angle, found {self.tilt}")
        if not self.roll > 0.0:
            raise ValueError(f"roll: expected a positive angle, found {self.roll}")

    def sample(self, rng: np.random.Generator, count: int) -> Float[Array, "count 6"]:
        """Return random views, uniform in tilt, roll, distance and azimuth within the limits."""
        sine = np.sin(rng.uniform(0.0, self.tilt, count))
        azimuth = rng.uniform(0.0, 2.0 * np.pi, count)
        roll = rng.uniform(-self.roll, self.roll, count)
        distance = rng.uniform(*self.distance, count)
        # The square root makes the point of aim uniform over the disc's area.
        aim_distance = self.max_aim_offset * np.sqrt(rng.uniform(0.0, 1.0, count))
        aim_azimuth = rng.uniform(0.0, 2.0 * np.pi, count)
        direction = (sine * np.cos(azimuth), sine * np.sin(azimuth))
        aim_offset = (aim_distance * np.cos(aim_azimuth), aim_distance * np.sin(aim_azimuth))
        return jnp.asarray(np.stack([*direction, *aim_offset, roll, distance], axis=1))

    @one_program
    def poses(self, coordinates: Float[Array, "*views 6"]) -> SE3:
        """Return `camera_from_world` of views."""
        # The unit vector from the point of aim to the camera is (x, y, +-sqrt(1 - x^2 - y^2)).
        x, y, right, up, roll, distance = jnp.moveaxis(coordinates, -1, 0)
        height = jnp.sqrt(1.0 - x**2 - y**2)
        point_to_camera = jnp.stack([x, y, height if self.above else -height], axis=-1)
        aim_offset = jnp.stack([right, up, jnp.zeros_like(up)], axis=-1)
        point = jnp.broadcast_to(self.point, aim_offset.shape) + aim_offset
        return look_at(point, -point_to_camera, distance, roll)

    @one_program
    def to_unbounded(self, coordinates: Float[Array, "*views 6"]) -> Float[Array, "*views 6"]:
        """Return unbounded coordinates of views, for solvers without limits."""
        roll, distance = jnp.moveaxis(coordinates[..., 4:], -1, 0)
        middle, half = self._distance_centre_and_half_range
        return self._concatenate(
            _ball_to_unbounded(coordinates[..., :2], np.sin(self.tilt)),
            _ball_to_unbounded(coordinates[..., 2:4], self.max_aim_offset),
            # A roll of any size is allowed here, since it is periodic.
            roll[..., None]
            if self.roll >= np.pi
            else _ball_to_unbounded(roll[..., None], self.roll),
            _ball_to_unbounded((distance - middle)[..., None], half),
        )

    @one_program
    def from_unbounded(self, unbounded: Float[Array, "*views 6"]) -> Float[Array, "*views 6"]:
        """Return views from their unbounded coordinates, the inverse of `to_unbounded`."""
        roll, distance = unbounded[..., 4:5], unbounded[..., 5:]
        middle, half = self._distance_centre_and_half_range
        return self._concatenate(
            _unbounded_to_ball(unbounded[..., :2], np.sin(self.tilt)),
            _unbounded_to_ball(unbounded[..., 2:4], self.max_aim_offset),
            roll if self.roll >= np.pi else _unbounded_to_ball(roll, self.roll),
            middle + _unbounded_to_ball(distance, half),
        )

    @staticmethod
    def _concatenate(*parts: Float[Array, "*views _"]) -> Float[Array, "*views 6"]:
        """Return the parts of views concatenated."""
        return jnp.concatenate(parts, axis=-1)

    @property
    def _distance_centre_and_half_range(self) -> tuple[float, float]:
        """The middle of the distances and half their range, m."""
        near, far = self.distance
        return 0.5 * (near + far), 0.5 * (far - near)


def _ball_to_unbounded(vector: Float[Array, "*views n"], limit: float) -> Float[Array, "*views n"]:
    """Return an unbounded vector for a vector no longer than a limit."""
    if not limit:
        return vector
    # x = limit w / sqrt(1 + |w|^2), solved for w, with the fraction f = x / limit:
    #   w = f / sqrt(1 - |f|^2)   after clipping |f| to MAX_LIMIT_FRACTION.
    fraction = vector / limit
    squared_norm = jnp.sum(fraction**2, axis=-1, keepdims=True)
    fraction = fraction * jnp.sqrt(
        jnp.minimum(1.0, MAX_LIMIT_FRACTION**2 / jnp.maximum(squared_norm, MAX_LIMIT_FRACTION**2))
    )
    return fraction / jnp.sqrt(1.0 - jnp.minimum(squared_norm, MAX_LIMIT_FRACTION**2))


def _unbounded_to_ball(vector: Float[Array, "*views n"], limit: float) -> Float[Array, "*views n"]:
    """Return a vector no longer than a limit, the inverse of `_ball_to_unbounded`."""
    return limit * vector / jnp.sqrt(1.0 + jnp.sum(vector**2, axis=-1, keepdims=True))
