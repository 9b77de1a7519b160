"""Find edge points with sub-pixel accuracy.

An edge point is where the gradient of the smoothed picture is largest along its own direction
(Canny, "A computational approach to edge detection", 1986). Its position between pixels follows
from three gradients along the row or column that crosses the edge more steeply (as in Devernay,
"A non-maxima suppression method for edge detection with sub-pixel accuracy", 1995), here by a
parabola through their logarithms: the gradient of a blurred step is a Gaussian, for which that is
exact.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

SMOOTHING = 1.0
"""Standard deviation of the smoothing before the gradient is taken, px."""

LOW_GATE, HIGH_GATE = 4.0, 9.0
"""Gradients of a weak and of a certain edge point, in standard deviations of the gradient's noise.

A weak point counts where it is connected to a certain one.
"""

MIN_NOISE = 0.6
"""Smallest standard deviation of a picture's noise that is believed, grey levels.

Rounding to whole levels alone gives 0.3, and saturated regions have none.
"""


class EdgePoints(NamedTuple):
    """Edge points of a picture.

    Attributes:
        pixels: sub-pixel positions, px.
        normals: unit directions of the gradient, from dark to light.
        strengths: magnitudes of the gradient, grey levels per px.
        cells: column and row of the pixel that each belongs to.
    """

    pixels: Float[np.ndarray, "points 2"]
    normals: Float[np.ndarray, "points 2"]
    strengths: Float[np.ndarray, "points"]
    cells: Int[np.ndarray, "points 2"]


def noise_of(grey: Float[np.ndarray, "rows columns"]) -> float:
    """Return the standard deviation of a picture's noise, grey levels.

    The median over the picture of a second difference of second differences, which is zero on
    planes and along straight edges of the grid (Immerkaer, "Fast noise variance estimation", 1996).
    """
    kernel = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]])
    # The kernel's squares sum to 36; 0.6745 is the median of |x| for a standard normal x.
    differences = np.abs(cv2.filter2D(grey, -1, kernel))
    return max(float(np.median(differences)) / (6.0 * 0.6745), MIN_NOISE)


def gradient(
    grey: Float[np.ndarray, "rows columns"],
) -> Float[np.ndarray, "rows columns 2"]:
    """Return the gradient of the smoothed picture by u and v, grey levels per px."""
    radius = int(np.ceil(4.0 * SMOOTHING))
    x = np.arange(-radius, radius + 1.0)
    smooth = np.exp(-0.5 * (x / SMOOTHING) ** 2)
    smooth /= smooth.sum()
    # filter2D correlates: with x G(x) the derivative has the sign of a rising ramp. It is scaled to
    # be exact on ramps.
    slope = x * smooth
    slope /= (x * slope).sum()
    by_u = cv2.sepFilter2D(grey, -1, slope, smooth, borderType=cv2.BORDER_REPLICATE)
    by_v = cv2.sepFilter2D(grey, -1, smooth, slope, borderType=cv2.BORDER_REPLICATE)
    return np.stack([by_u, by_v], axis=-1)


def find_edge_points(grey: Float[np.ndarray, "rows columns"]) -> EdgePoints:
    """Return the edge points of a picture, in the order of its rows."""
    slopes = gradient(grey)
    magnitude = np.hypot(slopes[..., 0], slopes[..., 1])
    # White noise of sigma_n gives the gradient sigma_n / (sqrt(8 pi) s^2) along each axis.
    gradient_noise = noise_of(grey) / (np.sqrt(8.0 * np.pi) * SMOOTHING**2)
    is_strong = magnitude > LOW_GATE * gradient_noise
    # At the picture's border there is no neighbour on one side.
    is_strong[[0, -1], :] = is_strong[:, [0, -1]] = False
    row, column = np.nonzero(is_strong)
    shift, along_u, is_peak = _peaks(slopes, magnitude, row, column)
    weak = np.zeros_like(is_strong)
    weak[row[is_peak], column[is_peak]] = True
    is_peak &= _connected_to(weak, magnitude > HIGH_GATE * gradient_noise)[row, column]
    row, column, shift, along_u = row[is_peak], column[is_peak], shift[is_peak], along_u[is_peak]
    pixels = np.column_stack([column, row]).astype(float)
    pixels[np.arange(len(row)), np.where(along_u, 0, 1)] += shift
    strengths = magnitude[row, column]
    normals = slopes[row, column] / strengths[:, None]
    return EdgePoints(pixels, normals, strengths, np.column_stack([column, row]))


def _peaks(
    slopes: Float[np.ndarray, "rows columns 2"],
    magnitude: Float[np.ndarray, "rows columns"],
    row: Int[np.ndarray, "pixels"],
    column: Int[np.ndarray, "pixels"],
) -> tuple[Float[np.ndarray, "pixels"], Bool[np.ndarray, "pixels"], Bool[np.ndarray, "pixels"]]:
    """Return where between pixels the gradient peaks, along which axis, and whether it does."""
    own, size = slopes[row, column], magnitude[row, column]
    along_u = np.abs(own[:, 0]) >= np.abs(own[:, 1])
    unit = own / size[:, None]
    # The neighbour's gradient along this pixel's own direction: opposite edges do not mix.
    before, after = (
        (unit * slopes[row + step * ~along_u, column + step * along_u]).sum(axis=1)
        for step in (-1, 1)
    )
    # A Gaussian's logarithm is a parabola: shift = (l- - l+) / (2 (l- - 2 l0 + l+)).
    low, middle, high = (np.log(np.maximum(x, 1e-3 * size)) for x in (before, size, after))
    curvature = low - 2.0 * middle + high
    is_peak = (size > before) & (size >= after) & (curvature < 0.0)
    shift = 0.5 * (low - high) / np.where(curvature < 0.0, curvature, -1.0)
    return np.clip(shift, -0.5, 0.5), along_u, is_peak


def _connected_to(
    weak: Bool[np.ndarray, "rows columns"], certain: Bool[np.ndarray, "rows columns"]
) -> Bool[np.ndarray, "rows columns"]:
    """Return the weak points whose connected component has a certain point."""
    count, components = cv2.connectedComponents(weak.astype(np.uint8), connectivity=8)
    labels = np.asarray(components, dtype=int)
    keep = np.zeros(count, dtype=bool)
    keep[np.unique(labels[weak & certain])] = True
    keep[0] = False
    return keep[labels]
