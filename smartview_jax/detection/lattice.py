"""Circles of a grid that is seen in part: which row and column each of them is in.

From a circle and two of its neighbours a lattice is grown, neighbour by neighbour, with steps that
follow perspective. It numbers rows and columns from anywhere. What they are on the target is told
by the lattice itself where it spans all rows and columns, a few circles being hidden; and by the
larger corner circle where that is seen. Where neither tells, the answer says what is missing.
"""

from collections import deque

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from ..targets import CircleGrid

LEAST_SHARE = 0.5
"""Share of a grid's circles that have to be seen."""

_SEEDS = 8
"""Circles from which a lattice is tried, those in the middle first."""

_MISS = 0.25
"""Share of a step by which a circle may miss the place where its neighbours expect it."""

_MARK = 1.2
"""Size of a corner circle over its neighbours', from which it is the mark."""

Cells = dict[tuple[int, int], int]
"""By row and column, counted from anywhere, the index of a blob."""


def partial_grid(
    centres: Float[np.ndarray, "blobs 2"], sizes: Float[np.ndarray, "blobs"], target: CircleGrid
) -> tuple[Int[np.ndarray, "found"], Int[np.ndarray, "found"]] | str:
    """Return which blobs are which circles of a symmetric grid, or why that cannot be told.

    Args:
        centres: of all blobs, px.
        sizes: their diameters, px.
        target: the grid.

    Returns:
        Indices of the target's circles and, for each, of its blob; or a reason in words.
    """
    total = target.rows * target.columns
    lattices: list[Cells] = _lattices(centres)
    cells = _without_strays(max(lattices, key=len, default={}), centres)
    if len(cells) < LEAST_SHARE * total:
        return f"{len(cells)} of them lie on a grid, at least half of {total} are needed"
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
    """Return the lattices grown from circles in the middle."""
    if len(centres) < 4:
        return []
    tree = KDTree(centres)
    middle = np.argsort(np.linalg.norm(centres - np.median(centres, axis=0), axis=1))
    return [_grown(centres, tree, int(seed)) for seed in middle[:_SEEDS]]


def _grown(centres: Float[np.ndarray, "blobs 2"], tree: KDTree, seed: int) -> Cells:
    """Return the lattice that a circle belongs to; rows and columns turn as in the picture."""
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
    """Return the ways to the nearest circle and to the nearest one aside from it."""
    _, near = tree.query(centres[seed], k=min(9, len(centres)))
    ways = centres[np.asarray(near)[1:]] - centres[seed]
    lengths = np.linalg.norm(ways, axis=1)
    first = ways[0]
    turn = first[0] * ways[:, 1] - first[1] * ways[:, 0]
    aside = np.flatnonzero(np.abs(turn) > 0.5 * lengths[0] * lengths)
    if not len(aside):
        return first, np.array([-first[1], first[0]])
    # Rows follow columns as y follows x in the picture: a target is seen from its front.
    return first, np.sign(turn[aside[0]]) * ways[aside[0]]


def _without_strays(cells: Cells, centres: Float[np.ndarray, "blobs 2"]) -> Cells:
    """Return the cells that one homography explains."""
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
    """Return rows and columns, from zero, as counted after quarter turns."""
    for _ in range(quarter):
        cells = np.stack([cells[:, 1], cells[:, 0].max() - cells[:, 0]], axis=1)
    return cells


def _spans(cells: Int[np.ndarray, "found 2"], target: CircleGrid) -> bool:
    return bool((cells.max(axis=0) + 1 == (target.rows, target.columns)).all())


def _by_mark(
    turned: list[Int[np.ndarray, "found 2"]],
    sizes: Float[np.ndarray, "found"],
    target: CircleGrid,
) -> list[Int[np.ndarray, "found 2"]]:
    """Return the ways of counting that begin at the mark, or where alone it can be hidden."""
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
