"""Differentiate a smoothed picture, and estimate the noise of its gradient."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int

SMOOTHING = 1.0
"""Standard deviation of the smoothing before the gradient is taken, px."""

SMOOTHED_LENGTH = float(2.0 * np.sqrt(np.pi)) * SMOOTHING
"""Length along an edge over which smoothing makes the noise of the gradient the same noise, px.

White noise smoothed by s has the correlation exp(-d^2 / 4 s^2) at the distance d, whose integral
over all d is 2 sqrt(pi) s. About as many edge points count as one observation.
"""

MIN_NOISE = 0.6
"""Smallest standard deviation of a picture's noise, grey levels; a smaller estimate is not used.

Rounding to whole levels alone gives 0.3, and saturated regions have no noise.
"""

GRADIENT_OF_NOISE = 1.0 / (float(np.sqrt(8.0 * np.pi)) * SMOOTHING**2)
"""Standard deviation of the gradient's noise over the standard deviation of white noise, 1/px."""

MIN_GRADIENT_SIGMA = GRADIENT_OF_NOISE * MIN_NOISE
"""Smallest standard deviation of the gradient's noise, grey levels per px."""

BORDER = int(np.ceil(3.0 * SMOOTHING))
"""Width of the picture's border, px, where smoothing reaches over it: there the picture goes on by
a guess, which turns the edges that cross it."""


class Gradient(NamedTuple):
    """The gradient of a smoothed picture, grey levels per px.

    Attributes:
        by_u: derivatives along the rows.
        by_v: derivatives along the columns.
        magnitude: of the gradient.
        sigma: standard deviation of the noise of either derivative.
    """

    by_u: Float[np.ndarray, "rows columns"]
    by_v: Float[np.ndarray, "rows columns"]
    magnitude: Float[np.ndarray, "rows columns"]
    sigma: float

    @classmethod
    def of(cls, grey: Float[np.ndarray, "rows columns"]) -> "Gradient":
        """Return the gradient of a picture of grey levels."""
        radius = int(np.ceil(4.0 * SMOOTHING))
        x = np.arange(-radius, radius + 1.0)
        smooth = np.exp(-0.5 * (x / SMOOTHING) ** 2)
        smooth /= smooth.sum()
        # sepFilter2D correlates, so that x G(x) gives a positive derivative on a rising ramp. It is
        # scaled to be exact on ramps.
        slope = x * smooth
        slope /= (x * slope).sum()
        by_u = cv2.sepFilter2D(grey, -1, slope, smooth, borderType=cv2.BORDER_REPLICATE)
        by_v = cv2.sepFilter2D(grey, -1, smooth, slope, borderType=cv2.BORDER_REPLICATE)
        sigma = GRADIENT_OF_NOISE * _noise(grey)
        return cls(by_u, by_v, cv2.magnitude(by_u, by_v), sigma)

    def at(
        self, row: Int[np.ndarray, "*pixels"], column: Int[np.ndarray, "*pixels"]
    ) -> Float[np.ndarray, "*pixels 2"]:
        """Return the gradient of pixels, by u and v."""
        return np.stack([self.by_u[row, column], self.by_v[row, column]], axis=-1)


def _noise(grey: Float[np.ndarray, "rows columns"]) -> float:
    """Return the standard deviation of a picture's noise, grey levels.

    It is the median over the picture of a mixed fourth difference, which is zero on planes and
    along straight edges of the grid (Immerkaer, "Fast noise variance estimation", 1996).
    """
    kernel = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]])
    # The kernel's squares sum to 36; 0.6745 is the median of |x| for a standard normal x.
    differences = np.abs(cv2.filter2D(grey, -1, kernel))
    return max(float(np.median(differences)) / (6.0 * 0.6745), MIN_NOISE)
