"""Define the interface of a lens, the map between directions and the unit image plane.

The lens without distortion shows it.

Every model of this package, and a user's own, passes the same property test: applying a map and its
inverse gives the identity inside the valid region, and outside it the result is NaN with
`valid=False`.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class AbstractLens(eqx.Module):
    """A lens that maps camera-frame points to the image plane at unit focal length, and inversely.

    Both directions return `(answer, valid)`. Where `valid` is False the answer is NaN, and its
    derivatives with respect to every parameter are zero or NaN but never a wrong number.
    """

    @abc.abstractmethod
    def distort(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Return the points on the unit image plane that camera-frame points are mapped to.

        Args:
            points: in the camera frame, in any unit of length.
        """

    @abc.abstractmethod
    def undistort(
        self, plane_points: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 3"], Bool[Array, "*batch"]]:
        """Return the unit rays that are mapped to points of the unit image plane."""


class AbstractPerspectiveLens(AbstractLens):
    """A lens that distorts the perspective image `(x/z, y/z)` of points with `z > 0`.

    A user's own lens defines `distort_normalised` and `undistort_normalised`; `implicit_inverse`
    computes either of them from the other.
    """

    @abc.abstractmethod
    def distort_normalised(
        self, ideal: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Return distorted from ideal normalised coordinates, and whether each is valid."""

    def distort_valid(self, ideal: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """Return distorted from ideal normalised coordinates that are known to be valid.

        A lens whose test of validity takes long can leave the test out here.
        """
        return self.distort_normalised(ideal)[0]

    @abc.abstractmethod
    def undistort_normalised(
        self, distorted: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Return ideal from distorted normalised coordinates, and whether each is valid."""

    def distort(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Return the points on the unit image plane that camera-frame points are mapped to."""
        # ideal = (x / z, y / z), then the distortion of the model.
        in_front = points[..., 2] > 0.0
        # The inner `where` keeps the derivatives of masked points finite.
        depth = jnp.where(in_front, points[..., 2], 1.0)
        ideal = jnp.stack([points[..., 0] / depth, points[..., 1] / depth], axis=-1)
        distorted, valid = self.distort_normalised(ideal)
        valid = valid & in_front
        x, y = (jnp.where(valid, distorted[..., k], jnp.nan) for k in (0, 1))
        return jnp.stack([x, y], axis=-1), valid

    def undistort(
        self, plane_points: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 3"], Bool[Array, "*batch"]]:
        """Return the unit rays that are mapped to points of the unit image plane."""
        # ray = (x', y', 1) / |(x', y', 1)|, with the ideal coordinates (x', y').
        ideal, valid = self.undistort_normalised(plane_points)
        ray = jnp.concatenate([ideal, jnp.ones_like(ideal[..., :1])], axis=-1)
        ray = ray / jnp.linalg.norm(ray, axis=-1, keepdims=True)
        return jnp.where(valid[..., None], ray, jnp.nan), valid


class Pinhole(AbstractPerspectiveLens):
    """A lens without distortion (Eq. 2)."""

    def distort_normalised(
        self, ideal: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Return the coordinates unchanged; all are valid."""
        return ideal, jnp.ones(ideal.shape[:-1], dtype=bool)

    def undistort_normalised(
        self, distorted: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Return the coordinates unchanged; all are valid."""
        return distorted, jnp.ones(distorted.shape[:-1], dtype=bool)
