"""Tell which edge points have no other edge beside them, which would displace them.

A smoothed picture's gradient peaks a little off an edge where another one is near, such as the
border of a shadow that leaves an object at a small angle. Beside a step of height a, one of height
b at the distance D, both blurred to the width s, adds the part (b / a) exp(-D (D - 2) / (2 s^2)) to
the gradient one pixel towards it, so that the parabola through three logarithms peaks off by

    (b / a) (s^2 / 2) exp(-D (D - 2) / (2 s^2)),

which for the usual width of 1.2 px and equal steps is 0.25 px at 3 px, and 0.004 px at 5 px. Where
the two edges run into each other only one peak is left, and it is displaced most: so points next to
those that see another edge are taken to be displaced, too.
"""

from itertools import product

import cv2
import numpy as np
from jaxtyping import Bool

from .edge_points import EdgePoints

CLEARANCE = 5.0
"""Distance from another edge, px, within which a blurred edge is displaced by it."""

OTHER_EDGE = 1.5
"""Distance across an edge, px, from which a point is of another edge."""

BESIDE = 1.0
"""Largest distance along an edge from a point to what is beside it, px."""

SEARCHED_ACROSS, SEARCHED_ALONG = (2.0, 3.0, 4.0, 5.0), (-1.0, 0.0, 1.0)
"""Places across and along an edge at which another one is looked for, px: each pixel is met."""

SPREAD = 1
"""Number of pixels by which displaced points spread to their neighbours."""


def lone_points(points: EdgePoints) -> Bool[np.ndarray, "points"]:
    """Return which edge points of a picture are farther than `CLEARANCE` from all other edges."""
    pixels, normals, cells = points.pixels, points.normals, points.cells
    if not len(pixels):
        return np.zeros(0, dtype=bool)
    # With a margin, no search leaves the table.
    margin = int(CLEARANCE + BESIDE) + 2
    columns, rows = cells.max(axis=0) + 2 * margin + 1
    own_column, own_row = cells.T + margin
    index = np.full((rows, columns), -1, dtype=np.int32)
    index[own_row, own_column] = np.arange(len(cells))
    directions = np.column_stack([-normals[:, 1], normals[:, 0]])
    displaced = np.zeros((rows, columns), dtype=np.uint8)
    for across, along, sign in product(SEARCHED_ACROSS, SEARCHED_ALONG, (-1.0, 1.0)):
        place = np.rint(pixels + sign * across * normals + along * directions).astype(int) + margin
        other = index[place[:, 1], place[:, 0]]
        found = np.flatnonzero(other >= 0)
        gap = pixels[other[found]] - pixels[found]
        distance = np.abs((gap * normals[found]).sum(axis=1))
        is_other = (distance > OTHER_EDGE) & (distance < CLEARANCE)
        is_other &= np.abs((gap * directions[found]).sum(axis=1)) <= BESIDE
        own = found[is_other]
        displaced[own_row[own], own_column[own]] = 1
    around = np.ones((2 * SPREAD + 1, 2 * SPREAD + 1), dtype=np.uint8)
    return np.asarray(cv2.dilate(displaced, around))[own_row, own_column] == 0
