"""Describe a depth sensor: the bias and the noise of the points that it measures."""

import dataclasses

import numpy as np
from jaxtyping import Float

TYPICAL_SCALE_STD, TYPICAL_OFFSET_STD = 0.05, 0.02
"""Standard deviations of the priors: depth sensors err by some per cent, and some millimetres."""


@dataclasses.dataclass(frozen=True)
class DepthSensor:
    """The bias and the noise of a depth sensor, with the uncertainty of the bias.

        corrected point = measured point (scale z + offset) / z

    Attributes:
        scale: true depth over measured depth, but for the offset.
        offset: true depth minus scaled depth, m.
        scale_std, offset_std: their standard deviations.
        correlation: of scale and offset.
        across_std: standard deviation of a coordinate across the line of sight, m; None for depths
            at the points of pictures, whose pixels tell the place across it.
        along_std: standard deviation along the line of sight, m; the constant part of it, if it
            grows.
        along_growth: part that grows with the square of the depth, at 1 m, 1/m (`DepthNoise`).
        common_std: standard deviation of the error that all depths of a view have in common, m.
    """

    scale: float
    offset: float
    scale_std: float
    offset_std: float
    correlation: float
    across_std: float | None
    along_std: float
    along_growth: float = 0.0
    common_std: float = 0.0

    def corrected(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Return measured points in the sensor's frame, m, with its bias removed."""
        return points * (self.scale + self.offset / points[..., 2:])

    @property
    def covariance(self) -> Float[np.ndarray, "2 2"]:
        """The covariance of scale and offset (m)."""
        stds = np.array([self.scale_std, self.offset_std])
        return np.outer(stds, stds) * [[1.0, self.correlation], [self.correlation, 1.0]]

    @property
    def described(self) -> str:
        """The bias with its standard deviations, and the noise, in words."""
        bias = (
            f"depths times {self.scale:.5f} +- {self.scale_std:.2g}, plus {1e3 * self.offset:.3f} "
            f"+- {1e3 * self.offset_std:.2g} mm"
        )
        if self.across_std is not None:
            return (
                f"{bias}; points +- {1e3 * self.across_std:.2g} mm across the line of sight, "
                f"{1e3 * self.along_std:.2g} mm along it"
            )
        text = f"{bias}; depths +- {1e3 * self.along_std:.2g} mm"
        if self.along_growth:
            at_metre = float(np.hypot(self.along_std, self.along_growth))
            text += f" nearby, {1e3 * at_metre:.2g} mm at 1 m"
        return f"{text}, {1e3 * self.common_std:.2g} mm in common by view"
