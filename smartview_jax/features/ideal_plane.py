"""Map pixels to the picture that a camera without distortion would take, and back.

Straight edges are straight only there. Ideal coordinates belong to a pinhole camera with the mean
focal length and the axis at the origin: `f (x / z, y / z)`, in px, so that distances and noise have
almost the same size as in the real picture.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..cameras import Camera
from ..runtime.array_namespace import to_device
from ..runtime.compilation import compiled_optimised

POINTS_PER_BATCH = 4_096
"""Number of points that are mapped at once: one compiled program serves any number of points."""


class IdealPlane:
    """The undistorted image plane of one camera.

    Attributes:
        focal_length: scale of the ideal coordinates, px.
    """

    def __init__(self, camera: Camera):
        self._camera = camera
        self.focal_length: float = 0.5 * float(camera.alpha_u + camera.alpha_v)

    def from_pixels(self, pixels: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 2"]:
        """Return ideal coordinates; NaN where the lens has no ray, or one that is not in front."""
        return self.focal_length * _in_batches(_to_normalised, self._camera, pixels)[0]

    def to_pixels(
        self, ideal: Float[np.ndarray, "points 2"]
    ) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2 2"]]:
        """Return pixels, and their derivatives by the ideal coordinates; NaN where not valid."""
        pixels, derivatives = _in_batches(_to_pixels, self._camera, ideal / self.focal_length)
        return pixels, derivatives / self.focal_length

    def derivatives(self, pixels: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 2 2"]:
        """Return the derivatives of ideal coordinates by pixels."""
        return self.focal_length * _in_batches(_to_normalised, self._camera, pixels)[1]

    def rays(self, ideal: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 3"]:
        """Return the unit rays to points of the ideal plane, in the camera's frame."""
        rays = np.column_stack([ideal, np.full(len(ideal), self.focal_length)])
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _in_batches(
    function: Callable[..., tuple[Array, Array]], camera: Camera, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Apply a compiled function to points, a fixed number at a time."""
    # The last batch is padded with zeros, which every lens can map.
    values, derivatives = np.empty((len(points), 2)), np.empty((len(points), 2, 2))
    for start in range(0, len(points), POINTS_PER_BATCH):
        part = points[start : start + POINTS_PER_BATCH]
        padded = np.zeros((POINTS_PER_BATCH, 2))
        padded[: len(part)] = part
        value, derivative = function(camera, to_device(padded))
        values[start : start + len(part)] = np.asarray(value)[: len(part)]
        derivatives[start : start + len(part)] = np.asarray(derivative)[: len(part)]
    return values, derivatives


@compiled_optimised
def _to_normalised(
    camera: Camera, pixels: Float[Array, "points 2"]
) -> tuple[Float[Array, "points 2"], Float[Array, "points 2 2"]]:
    """Return `(x / z, y / z)` of the rays of pixels and the derivatives by the pixels."""

    def normalised(points: Float[Array, "points 2"]) -> Float[Array, "points 2"]:
        rays, valid = camera.unproject(points)
        # Rays to the side or behind do not meet the ideal plane.
        usable: Bool[Array, "points"] = valid & (rays[:, 2] > 0.0)
        # The inner `where` keeps the derivatives of other points finite.
        depth = jnp.where(usable, rays[:, 2], 1.0)
        return jnp.where(usable[:, None], rays[:, :2] / depth[:, None], jnp.nan)

    return _with_derivatives(normalised, pixels)


@compiled_optimised
def _to_pixels(
    camera: Camera, normalised: Float[Array, "points 2"]
) -> tuple[Float[Array, "points 2"], Float[Array, "points 2 2"]]:
    """Return the pixels of `(x / z, y / z)` and the derivatives by them."""

    def pixels(points: Float[Array, "points 2"]) -> Float[Array, "points 2"]:
        return camera.project(jnp.concatenate([points, jnp.ones_like(points[:, :1])], axis=1))[0]

    return _with_derivatives(pixels, normalised)


def _with_derivatives(
    function: Callable[[Float[Array, "points 2"]], Float[Array, "points 2"]],
    points: Float[Array, "points 2"],
) -> tuple[Float[Array, "points 2"], Float[Array, "points 2 2"]]:
    """Return the values of a function that maps points one by one, and its derivatives."""
    # Each point depends only on itself: two directional derivatives give all of them.
    columns = []
    value = function(points)
    for k in (0, 1):
        direction = jnp.zeros_like(points).at[:, k].set(1.0)
        columns.append(jax.jvp(function, (points,), (direction,))[1])
    return value, jnp.stack(columns, axis=-1)
