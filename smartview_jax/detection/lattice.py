"""Find the row and column of each circle of a partly visible grid.

A lattice is grown from a circle and two of its neighbours, neighbour by neighbour, with steps that
adapt to perspective. It numbers rows and columns from an arbitrary origin. Their numbers on the
target follow if the lattice spans all rows and columns, with only a few circles hidden, or from the
larger corner circle if it is visible. Otherwise the result is a text that states what is missing.
"""

from collections import deque

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from ..targets import CircleGrid

LEAST_SHARE = 0.5
"""Smallest fraction of a grid's circles that must be visible."""

_SEEDS = 8
"""Number of circles from which a lattice is grown, starting with those nearest to the middle."""

_MISS = 0.25
"""Largest distance of a circle from its predicted position, as a fraction of a lattice step."""

_MARK = 1.2
"""Smallest ratio of the mark's diameter to the mean diameter of its neighbours."""

Cells = dict[tuple[int, int], int]
"""Type of a lattice: the index of a blob by row and column, counted from an arbitrary origin."""


def partial_grid(
    centres: Float[np.ndarray, "blobs 2"], sizes: Float[np.ndarray, "blobs"], target: CircleGrid
) -> tuple[Int[np.ndarray, "found"], Int[np.ndarray, "found"]] | str:
    """Return which blob is which circle of a symmetric grid, or the reason why this is unknown.

    Args:
        centres: centres of all blobs, px.
        sizes: diameters of all blobs, px.
        target: the grid.

    Returns:
        Indices of the target's circles and, for each, the index of its blob; or a reason in words.
    """
    total = target.rows * target.columns
    lattices: list[Cells] = _lattices(centres)
    cells = _without_strays(max(lattices, key=len, default={}), centres)
    if len(cells) < LEAST_SHARE * total:
        return f"{len(cells)} of them lie on a grid, at least half of {total} are needed"
    # Counting can start at any of the four corners. Each of the four rotations of the cells that
    # fits into the target is a candidate, and the mark or the extent selects among them.
    placed = np.array(list(cells))
    placed -= placed.min(axis=0)
    blobs = np.array(list(cells.values()))
    turned = [_turned(placed, quarter) for quarter in range(4)]
    fits = [cell for cell in turned if (cell.max(axis=0) < (target.rows, target.columns)).all()]
    rows, columns = (fits or turned)[0].max(axis=0) + 1
    seen = f"{len(cells)} circles seen, on {rows} x {columns} places"
    if not fits:
        return f"{seen}: more than the grid of {target.rows} x {target.columns} has"
    if target.origin_mark:
        fits = _by_mark(fits, sizes[blobs], target)
        unknown = "and the larger corner circle is not among them"
    else:
        fits = fits if _spans(fits[0], target) else []
        unknown = "and the grid has no larger corner circle that would tell which"
    if not fits:
        return f"{seen} of {target.rows} x {target.columns}: rows or columns are missing, {unknown}"
    return fits[0] @ np.array([target.columns, 1]), blobs


def _lattices(centres: Float[np.ndarray, "blobs 2"]) -> list[Cells]:
    """Return the lattices grown from the circles nearest to the middle, one for each."""
    if len(centres) < 4:
        return []
    tree = KDTree(centres)
    middle = np.argsort(np.linalg.norm(centres - np.median(centres, axis=0), axis=1))
    return [_grown(centres, tree, int(seed)) for seed in middle[:_SEEDS]]


def _grown(centres: Float[np.ndarray, "blobs 2"], tree: KDTree, seed: int) -> Cells:
    """Return the lattice that contains a circle, with rows and columns oriented as in the picture.

    Args:
        centres: centres of all blobs, px.
        tree: the same centres, for queries of the nearest one.
        seed: index of the circle to start from.
    """
    # Breadth first from the seed: the neighbour of a circle at c is expected at c +- step, and the
    # step to a found neighbour is its measured distance, so that steps follow the perspective.
    across, down = _first_steps(centres, tree, seed)
    cells, used = {(0, 0): seed}, {seed}
    queue = deque([((0, 0), np.stack([down, across]))])
    while queue:
        cell, steps = queue.popleft()
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            beside = (cell[0] + sign * (axis == 0), cell[1] + sign * (axis == 1))
            here, step = centres[cells[cell]], sign * steps[axis]
            miss, nearest = tree.query(here + step)
            blob = int(nearest)
            if beside in cells or blob in used or miss > _MISS * np.linalg.norm(step):
                continue
            cells[beside] = blob
            used.add(blob)
            found = steps.copy()
            found[axis] = sign * (centres[blob] - here)
            queue.append((beside, found))
    return cells


def _first_steps(
    centres: Float[np.ndarray, "blobs 2"], tree: KDTree, seed: int
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return the lattice's first two steps at a circle, px.

    They are the vectors to the nearest circle and to the nearest one in a direction at least 30
    degrees from the first; without such a circle, the second step is perpendicular to the first.
    """
    # |first x other| > sin(30 degrees) |first| |other|
    _, near = tree.query(centres[seed], k=min(9, len(centres)))
    ways = centres[np.asarray(near)[1:]] - centres[seed]
    lengths = np.linalg.norm(ways, axis=1)
    first = ways[0]
    turn = first[0] * ways[:, 1] - first[1] * ways[:, 0]
    aside = np.flatnonzero(np.abs(turn) > 0.5 * lengths[0] * lengths)
    if not len(aside):
        return first, np.array([-first[1], first[0]])
    # The sign makes (columns, rows) right-handed as (x, y) in the picture, because a target is seen
    # from its front and never mirrored.
    return first, np.sign(turn[aside[0]]) * ways[aside[0]]


def _without_strays(cells: Cells, centres: Float[np.ndarray, "blobs 2"]) -> Cells:
    """Return the cells that agree with one homography from cells to pixels.

    Fewer than nine cells are too few for this test, and none of them is returned.
    """
    if len(cells) < 9:
        return {}
    places, found = np.array(list(cells), dtype=float), centres[list(cells.values())]
    steps = np.linalg.norm(found - found[:1], axis=1)[1:]
    steps = steps / np.linalg.norm(places - places[:1], axis=1)[1:]
    H, kept = cv2.findHomography(places, found, cv2.RANSAC, _MISS * float(np.median(steps)))
    if H is None:
        return {}
    return {
        cell: blob for (cell, blob), good in zip(cells.items(), kept.ravel(), strict=True) if good
    }


def _turned(cells: Int[np.ndarray, "found 2"], quarter: int) -> Int[np.ndarray, "found 2"]:
    """Return rows and columns after rotations of the grid.

    Args:
        cells: rows and columns, counted from zero.
        quarter: number of rotations by 90 degrees.
    """
    # (row, column) -> (column, last row - row)
    for _ in range(quarter):
        cells = np.stack([cells[:, 1], cells[:, 0].max() - cells[:, 0]], axis=1)
    return cells


def _spans(cells: Int[np.ndarray, "found 2"], target: CircleGrid) -> bool:
    """Return whether the cells reach from the first to the last row and column of the target."""
    return bool((cells.max(axis=0) + 1 == (target.rows, target.columns)).all())


def _by_mark(
    turned: list[Int[np.ndarray, "found 2"]],
    sizes: Float[np.ndarray, "found"],
    target: CircleGrid,
) -> list[Int[np.ndarray, "found 2"]]:
    """Return the rotation of the cells whose first corner is the mark.

    If the mark is not seen, it is the rotation that spans the target with its first corner hidden.

    Args:
        turned: the possible rotations of the cells.
        sizes: diameter of each cell's circle, px.
        target: the grid.

    Returns:
        A list of one rotation, or an empty list if there is none or more than one.
    """
    marked, hidden = [], []
    for cells in turned:
        size = {(int(i), int(j)): float(s) for (i, j), s in zip(cells, sizes, strict=True)}
        beside = [size[cell] for cell in ((0, 1), (1, 0), (1, 1)) if cell in size]
        if (0, 0) not in size:
            hidden += [cells] if _spans(cells, target) else []
        elif beside and size[0, 0] > _MARK * np.mean(beside):
            marked.append(cells)
    if marked:
        return marked if len(marked) == 1 else []
    return hidden if len(hidden) == 1 else []
