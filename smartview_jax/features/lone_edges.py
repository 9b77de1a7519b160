"""Find the edge points that no other edge is near enough to displace.

The gradient of a smoothed picture peaks a little off an edge if another one is near, such as the
border of a shadow that leaves an object at a small angle. Next to a step of height a, a step of
height b at the distance D, both blurred to the width s, adds the part
(b / a) exp(-D (D - 2) / (2 s^2)) to the gradient one pixel towards it, so that the parabola through
three logarithms peaks off by

    (b / a) (s^2 / 2) exp(-D (D - 2) / (2 s^2)),

which for the usual width of 1.2 px and equal steps is 0.25 px at 3 px, and 0.004 px at 5 px. Where
two edges merge only one peak is left, with the largest displacement: so points next to displaced
ones count as displaced, too.
"""

from itertools import product

import cv2
import numpy as np
from jaxtyping import Bool

from .edge_points import EdgePoints

CLEARANCE = 5.0
"""Distance, px, within which another edge displaces a blurred edge."""

OTHER_EDGE = 1.5
"""Distance across an edge, px, beyond which a point belongs to another edge."""

MAX_ALONG = 1.0
"""Largest distance along an edge between a point and another edge's point next to it, px."""

SEARCHED_ACROSS, SEARCHED_ALONG = (2.0, 3.0, 4.0, 5.0), (-1.0, 0.0, 1.0)
"""Places across and along an edge where another one is searched, px: every pixel is covered."""

SPREAD = 1
"""Number of pixels by which the displacement is taken to spread to neighbours."""


def lone_points(points: EdgePoints) -> Bool[np.ndarray, "points"]:
    """Return which edge points of a picture are farther than `CLEARANCE` from all other edges."""
    pixels, normals, cells = points.pixels, points.normals, points.cells
    if not len(pixels):
        return np.zeros(0, dtype=bool)
    # With a margin, no search leaves the table.
    margin = int(CLEARANCE + MAX_ALONG) + 2
    columns, rows = cells.max(axis=0) + 2 * margin + 1
    column, row = cells.T + margin
    index = np.full((rows, columns), -1, dtype=np.int32)
    index[row, column] = np.arange(len(cells))
    displaced = np.zeros((rows, columns), dtype=np.uint8)
    for across in SEARCHED_ACROSS:
        # Nothing more is to be found about points that another edge is known to displace.
        candidates = np.flatnonzero(displaced[row, column] == 0)
        p, n = pixels[candidates], normals[candidates]
        d = np.column_stack([-n[:, 1], n[:, 0]])
        for along, sign in product(SEARCHED_ALONG, (-1.0, 1.0)):
            place = np.rint(p + sign * across * n + along * d).astype(np.int32) + margin
            other = index.take(place[:, 1] * columns + place[:, 0])
            near = np.flatnonzero(other >= 0)
            gap = pixels[other[near]] - p[near]
            distance = np.abs((gap * n[near]).sum(axis=1))
            is_other = (distance > OTHER_EDGE) & (distance < CLEARANCE)
            is_other &= np.abs((gap * d[near]).sum(axis=1)) <= MAX_ALONG
            crowded = candidates[near[is_other]]
            displaced[row[crowded], column[crowded]] = 1
    around = np.ones((2 * SPREAD + 1, 2 * SPREAD + 1), dtype=np.uint8)
    return np.asarray(cv2.dilate(displaced, around))[row, column] == 0
