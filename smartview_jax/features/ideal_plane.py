"""Map pixels to the picture that a camera without distortion would take, and back.

Straight edges are straight only there. Ideal coordinates belong to a pinhole camera with the mean
focal length and the axis at the origin: `f (x / z, y / z)`, in px, so that distances and noise have
almost the same size as in the real picture.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..cameras import Camera
from ..runtime.compilation import compiled_optimised
from ..runtime.padding import in_batches

POINTS_PER_BATCH = 4_096
"""Number of points that are mapped at once: one compiled program serves any number of points."""


class IdealPlane:
    """The undistorted image plane of one camera, with its focal length as scale, px."""

    def __init__(self, camera: Camera):
        # No ray depends on the picture's size: pictures of all sizes share their programs.
        self._camera = dataclasses.replace(camera, image_size=(0, 0))
        self.focal_length: float = 0.5 * float(camera.alpha_u + camera.alpha_v)

    def from_pixels(self, pixels: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 2"]:
        """Return ideal coordinates; NaN where the lens has no ray, or one that is not in front."""
        return self.focal_length * self._run(_to_normalised, pixels)[0]

    def to_pixels(
        self, ideal: Float[np.ndarray, "points 2"]
    ) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2 2"]]:
        """Return pixels, and their derivatives by the ideal coordinates; NaN where not valid."""
        pixels, derivatives = self._run(_to_pixels, ideal / self.focal_length)
        return pixels, derivatives / self.focal_length

    def with_normals(
        self, pixels: Float[np.ndarray, "points 2"], normals: Float[np.ndarray, "points 2"]
    ) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2"]]:
        """Return ideal coordinates of edge points and the unit directions of their gradients there.

        NaN as in `from_pixels`.

        Args:
            pixels: of the edge points.
            normals: unit directions of their gradients in the picture.
        """
        normalised, derivatives = self._run(_to_normalised, pixels)
        # A gradient is a covector: J^-T g with J the derivative of ideal coordinates by pixels. The
        # length does not matter: J^-T is the matrix of cofactors over the determinant.
        (a, b), (c, d) = derivatives.transpose(1, 2, 0)
        u, v = normals.T
        turned = np.sign(a * d - b * c) * np.stack([d * u - c * v, a * v - b * u])
        return self.focal_length * normalised, (turned / np.linalg.norm(turned, axis=0)).T

    def rays(self, ideal: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 3"]:
        """Return the unit rays to points of the ideal plane, in the camera's frame."""
        rays = np.column_stack([ideal, np.full(len(ideal), self.focal_length)])
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def _run(
        self, program: Callable[..., tuple[Array, Array]], points: Float[np.ndarray, "points 2"]
    ) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2 2"]]:
        """Return values and derivatives of points; padding is zero, which every lens can map."""
        return in_batches(lambda batch: program(self._camera, batch), points, POINTS_PER_BATCH)


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
    directions = jnp.stack([jnp.zeros_like(points).at[:, k].set(1.0) for k in (0, 1)])

    def along(direction: Float[Array, "points 2"]) -> tuple[Array, Array]:
        return jax.jvp(function, (points,), (direction,))

    return jax.vmap(along, out_axes=(None, -1))(directions)
