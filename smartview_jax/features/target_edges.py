"""Measure how wide the edges of a detected target are in its picture.

Where a lens is out of focus, or the camera moves while a picture is exposed, a step of brightness
becomes a ramp. Its width is the distance between the two places at which the gradient across the
edge has fallen to half of its peak: for a movement the length of the movement, for the blur of a
lens 2.4 standard deviations. Neither the contrast of the target nor its kind matters.
"""

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from .edge_points import EdgePoints, find_edge_points
from .gradient import SMOOTHING, Gradient

WIDTH_OF_GAUSSIAN = float(2.0 * np.sqrt(2.0 * np.log(2.0)))
"""Width of a Gaussian at half of its peak, in its standard deviations."""

WIDE_SHARE = 0.75
"""Share of the edges that are at most as wide as the picture's width.

A movement blurs the edges across it and leaves those along it sharp, which may be half of them.
"""

MIN_MEASURED = 20
"""Smallest number of edge points from which the width is taken."""

MAX_MEASURED = 2000
"""Largest number of edge points that are measured, evenly taken from all."""

MAX_REACH = 40.0
"""Largest distance from an edge, and from a point of the target, that is looked at, px."""

STEP = 0.5
"""Distance between the places across an edge at which the gradient is looked up, px."""


def target_edge_width(grey: np.ndarray, pixels: Float[np.ndarray, "points 2"]) -> float | None:
    """Return the width of the edges around the detected points of a target, px.

    Args:
        grey: picture `(rows, columns)` of grey levels.
        pixels: detected points, px; with fewer than two, the edges of the whole picture are
            measured.

    Returns:
        The width at half of the gradient's peak, without the smoothing that finds edges; None
        where too few edges are seen.
    """
    reach, first, part, tree = MAX_REACH, np.zeros(2, dtype=int), grey, None
    if len(pixels) > 1:
        tree = KDTree(pixels)
        # Up to the middle between two points an edge belongs to the nearer one.
        spacing = float(np.median(tree.query(pixels, k=2)[0][:, 1]))
        reach = min(0.5 * spacing, MAX_REACH)
        margin = reach + 4.0 * SMOOTHING
        first = np.maximum(np.floor(pixels.min(axis=0) - margin), 0).astype(int)
        last = np.ceil(pixels.max(axis=0) + margin).astype(int) + 1
        part = grey[first[1] : last[1], first[0] : last[0]]
    gradient = Gradient.of(part.astype(np.float32))
    points = find_edge_points(gradient)
    if tree is None:
        near = np.arange(len(points.pixels))
    else:
        near = np.flatnonzero(tree.query(points.pixels + first)[0] <= reach)
    if len(near) < MIN_MEASURED:
        return None
    near = near[:: -(-len(near) // MAX_MEASURED)]
    widths = _widths(gradient, EdgePoints(*(x[near] for x in points)), reach)
    widths = widths[np.isfinite(widths)]
    if len(widths) < MIN_MEASURED:
        return None
    width = float(np.quantile(widths, WIDE_SHARE))
    return float(np.sqrt(max(width**2 - (WIDTH_OF_GAUSSIAN * SMOOTHING) ** 2, 0.0)))


def _widths(gradient: Gradient, points: EdgePoints, reach: float) -> Float[np.ndarray, "points"]:
    """Return the widths at half of the peak of the smoothed gradient across edges, px.

    A width is NaN where the gradient does not fall to half within reach: another edge is there.
    """
    offsets = STEP * np.arange(1, int(reach / STEP) + 1)
    half_widths = []
    for sign in (-1.0, 1.0):
        places = points.pixels[:, None] + sign * offsets[:, None] * points.normals[:, None]
        u, v = (places[..., k].astype(np.float32) for k in range(2))
        by_u, by_v = (
            cv2.remap(by, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
            for by in (gradient.by_u, gradient.by_v)
        )
        across = by_u * points.normals[:, 0, None] + by_v * points.normals[:, 1, None]
        relative = np.column_stack([np.ones(len(across)), across / points.strengths[:, None]])
        # Between the last place above half and the first one below it the gradient is a line.
        below = relative < 0.5
        place = np.argmax(below, axis=1)
        rows = np.arange(len(place))
        high, low = relative[rows, place - 1], relative[rows, place]
        crossing = STEP * (place - 1 + (high - 0.5) / np.where(high > low, high - low, 1.0))
        half_widths.append(np.where(below.any(axis=1), crossing, np.nan))
    return half_widths[0] + half_widths[1]
