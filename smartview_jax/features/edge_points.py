"""Find edge points with sub-pixel accuracy.

An edge point is where the gradient of the smoothed picture is largest along its own direction
(Canny, "A computational approach to edge detection", 1986). Its position between pixels follows
from three gradients along the row or column that crosses the edge more steeply (as in Devernay,
"A non-maxima suppression method for edge detection with sub-pixel accuracy", 1995), here by a
parabola through their logarithms, which is exact for a blurred step: its gradient is a Gaussian.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from ..cameras import Camera
from .gradient import BORDER, Gradient
from .picture_checks import grey_levels

LOW_GATE, HIGH_GATE = 4.0, 9.0
"""Gradients of a weak and of a certain edge point, in standard deviations of the gradient's noise.

A weak point counts where it is connected to a certain one.
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


def find_edge_points(gradient: Gradient) -> EdgePoints:
    """Return the edge points of a picture, in the order of its rows."""
    points = edge_points_above(gradient, LOW_GATE)
    column, row = points.cells.T
    weak = np.zeros(gradient.magnitude.shape, dtype=bool)
    weak[row, column] = True
    kept = _connected_to(weak, gradient.magnitude > HIGH_GATE * gradient.sigma)[row, column]
    return EdgePoints(*(part[kept] for part in points))


def edge_points_above(gradient: Gradient, gate: float) -> EdgePoints:
    """Return all peaks of the gradient that exceed a gate, in standard deviations of its noise."""
    magnitude = gradient.magnitude
    is_strong = magnitude > gate * gradient.sigma
    inside = np.zeros_like(is_strong)
    inside[BORDER:-BORDER, BORDER:-BORDER] = True
    is_strong &= inside
    row, column, shift, along_u = _peaks(gradient, *np.nonzero(is_strong))
    pixels = np.column_stack([column, row]).astype(float)
    pixels[np.arange(len(row)), np.where(along_u, 0, 1)] += shift
    strengths = magnitude[row, column]
    normals = gradient.at(row, column) / strengths[:, None]
    return EdgePoints(pixels, normals, strengths, np.column_stack([column, row]))


def _peaks(
    gradient: Gradient, row: Int[np.ndarray, "pixels"], column: Int[np.ndarray, "pixels"]
) -> tuple[
    Int[np.ndarray, "peaks"],
    Int[np.ndarray, "peaks"],
    Float[np.ndarray, "peaks"],
    Bool[np.ndarray, "peaks"],
]:
    """Return the given pixels where the gradient peaks: row, column, shift, whether along u.

    The shift is the position of the peak between pixels, along the axis that crosses the edge more
    steeply, px.
    """
    before, size, after, along_u = _across(gradient, row, column)
    is_peak = (size > before) & (size >= after)
    # A Gaussian's logarithm is a parabola: shift = (l- - l+) / (2 (l- - 2 l0 + l+)). Its curvature
    # is negative, since the middle value is the largest, except for rounding on a flat top.
    low, middle, high = _logarithms(before[is_peak], size[is_peak], after[is_peak])
    shift = 0.5 * (low - high) / np.minimum(low - 2.0 * middle + high, -np.finfo(float).eps)
    return row[is_peak], column[is_peak], np.clip(shift, -0.5, 0.5), along_u[is_peak]


def log_curvatures(gradient: Gradient, points: EdgePoints) -> Float[np.ndarray, "points"]:
    """Return minus the second difference of the gradient's logarithm across each edge point.

    It is taken along the row or column that crosses the edge more steeply.
    """
    column, row = points.cells.T
    low, middle, high = _logarithms(*_across(gradient, row, column)[:3])
    return 2.0 * middle - low - high


def _across(
    gradient: Gradient, row: Int[np.ndarray, "pixels"], column: Int[np.ndarray, "pixels"]
) -> tuple[
    Float[np.ndarray, "pixels"],
    Float[np.ndarray, "pixels"],
    Float[np.ndarray, "pixels"],
    Bool[np.ndarray, "pixels"],
]:
    """Return the gradients before, at and after pixels, across the edge; and whether along u."""
    (by_u, by_v), size = gradient.at(row, column).T, gradient.magnitude[row, column]
    along_u = np.abs(by_u) >= np.abs(by_v)
    unit_u, unit_v = by_u / size, by_v / size
    # The neighbours' gradients along this pixel's own direction, so that opposite edges do not mix.
    columns = gradient.magnitude.shape[1]
    steps = np.where(along_u, 1, columns)
    before, after = (
        unit_u * gradient.by_u.take(place) + unit_v * gradient.by_v.take(place)
        for place in (row * columns + column + sign * steps for sign in (-1, 1))
    )
    return before, size, after, along_u


def _logarithms(
    before: Float[np.ndarray, "pixels"],
    size: Float[np.ndarray, "pixels"],
    after: Float[np.ndarray, "pixels"],
) -> list[Float[np.ndarray, "pixels"]]:
    """Return the logarithms of three neighbouring gradients; tiny ones are cut off."""
    return [np.log(np.maximum(x, 1e-3 * size)) for x in (before, size, after)]


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


def edge_map(picture: np.ndarray, camera: Camera) -> Bool[np.ndarray, "rows columns"]:
    """Return which pixels have an edge point by Canny's criteria; thresholds follow the noise.

    Args:
        picture: uint8, grey `(rows, columns)` or BGR `(rows, columns, 3)`.

    Raises:
        ValueError: as `find` does.
    """
    grey = grey_levels(picture, camera)
    column, row = find_edge_points(Gradient.of(grey)).cells.T
    edges = np.zeros(grey.shape, dtype=bool)
    edges[row, column] = True
    return edges
