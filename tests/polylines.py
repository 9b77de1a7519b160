"""Where a curve of pixels passes a point."""

import numpy as np


def nearest_on(curve, pixel):
    """The distance of a pixel from a curve in one piece, px, and the depth there, m."""
    # Densely between the samples; pictures change evenly with inverse depth.
    at = np.linspace(0.0, len(curve.depths) - 1.0, 200 * len(curve.depths))
    samples = np.arange(len(curve.depths))
    u, v = (np.interp(at, samples, curve.pixels[:, k]) for k in (0, 1))
    distance = np.hypot(u - pixel[0], v - pixel[1])
    best = np.argmin(distance)
    return distance[best], 1.0 / np.interp(at[best], samples, 1.0 / curve.depths)
