"""Define the lens without distortion."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .lens import AbstractPerspectiveLens


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
