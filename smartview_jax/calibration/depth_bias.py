"""Describe how far the depths of a sensor are from the true ones."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, ScalarLike

from ..runtime.array_namespace import AnyArray, as_float_array


class DepthBias(eqx.Module):
    """The bias of the depths that a camera measures along its optical axis.

        true depth = scale * measured depth + offset

    Attributes:
        scale: true depth over measured depth, but for the offset.
        offset: true depth minus scaled depth, m.
    """

    scale: Float[Array, ""]
    offset: Float[Array, ""]

    def __init__(self, scale: ScalarLike = 1.0, offset: ScalarLike = 0.0):
        """Store the bias; arguments as the class's attributes."""
        self.scale = as_float_array(scale)
        self.offset = as_float_array(offset)

    def measured(self, depths: Float[AnyArray, "*points"]) -> Float[AnyArray, "*points"]:
        """Return what the sensor measures at true depths, m."""
        return (depths - self.offset) / self.scale

    @property
    def host_values(self) -> Float[np.ndarray, "2"]:
        """Scale and offset on the host."""
        return np.array([float(self.scale), float(self.offset)])
