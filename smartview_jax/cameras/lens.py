"""What a lens is: the map between directions in front of the camera and the ideal image plane.

Every model of this package, and a user's own, passes the same property test: going there and back
is the identity inside the valid region, and outside the answer is NaN with `valid=False`.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class AbstractLens(eqx.Module):
    """A lens maps camera-frame points to the plane at unit focal length, and back to rays.

    Both directions return `(answer, valid)`. Where `valid` is False the answer is NaN, and its
    derivatives with respect to every parameter are zero or NaN but never a wrong number.
    """

    @abc.abstractmethod
    def distort(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Where points of the camera frame (any length unit) fall on the unit image plane."""

    @abc.abstractmethod
    def undistort(
        self, plane: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 3"], Bool[Array, "*batch"]]:
        """The ray, of unit length, that falls on a place of the unit image plane."""


class AbstractPerspectiveLens(AbstractLens):
    """A lens that distorts the perspective image `(x/z, y/z)`; points need `z > 0`.

    A lens of one's own writes `distort_normalised` and `undistort_normalised`; `implicit_inverse`
    turns either of them into the other.
    """

    @abc.abstractmethod
    def distort_normalised(
        self, ideal: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Distorted from ideal normalised coordinates."""

    @abc.abstractmethod
    def undistort_normalised(
        self, distorted: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Ideal from distorted normalised coordinates."""

    def distort(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        in_front = points[..., 2] > 0.0
        # The inner `where` keeps the derivatives of masked points finite.
        depth = jnp.where(in_front, points[..., 2], 1.0)
        ideal = jnp.stack([points[..., 0] / depth, points[..., 1] / depth], axis=-1)
        distorted, valid = self.distort_normalised(ideal)
        valid = valid & in_front
        x, y = (jnp.where(valid, distorted[..., k], jnp.nan) for k in (0, 1))
        return jnp.stack([x, y], axis=-1), valid

    def undistort(
        self, plane: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 3"], Bool[Array, "*batch"]]:
        ideal, valid = self.undistort_normalised(plane)
        ray = jnp.concatenate([ideal, jnp.ones_like(ideal[..., :1])], axis=-1)
        ray = ray / jnp.linalg.norm(ray, axis=-1, keepdims=True)
        return jnp.where(valid[..., None], ray, jnp.nan), valid
