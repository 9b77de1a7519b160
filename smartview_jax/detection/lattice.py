"""Find the row and column of each circle of a partly visible grid.

A lattice is grown from a circle and two of its neighbours, neighbour by neighbour, with steps that
adapt to perspective. It numbers rows and columns from an arbitrary origin. Their numbers on the
target are known if the lattice spans all rows and columns, with only a few circles hidden, or if
the larger corner circle is visible. Otherwise the result is a text that states what is missing.
"""

from collections import deque

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from ..targets import CircleGrid

MIN_VISIBLE_FRACTION = 0.5
"""Smallest fraction of a grid's circles that must be visible."""

_MAX_SEED_CIRCLES = 8
"""Number of circles from which a lattice is grown, starting with those nearest to the middle."""

_POSITION_TOLERANCE = 0.25
"""Largest distance of a circle from its predicted position, as a fraction of a lattice step."""

_MIN_MARK_DIAMETER_RATIO = 1.2
"""Smallest ratio of the mark's diameter to the mean diameter of its neighbours."""

Lattice = dict[tuple[int, int], int]
"""Type of a lattice: the index of a blob by row and column, counted from an arbitrary origin."""


def match_partial_grid(
    centres: Float[np.ndarray, "blobs 2"], diameters: Float[np.ndarray, "blobs"], target: CircleGrid
) -> tuple[Int[np.ndarray, "found"], Int[np.ndarray, "found"]] | str:
    """Return which blob is which circle of a symmetric grid, or the reason why this is unknown.

    The blobs' centres and diameters are px; the result is indices of circles, then of their blobs.
    """
    total = target.rows * target.columns
    lattices: list[Lattice] = _grow_lattices(centres)
    cells = _homography_inliers(max(lattices, key=len, default={}), centres)
    if len(cells) < MIN_VISIBLE_FRACTION * total:
        return f"{len(cells)} of them lie on a grid, at least half of {total} are needed"
    # Counting can start at any of the four corners. Each of the four rotations of the cells that
    # fits into the target is a candidate; the mark or the extent selects one of them.
    cell_indices = np.array(list(cells))
    cell_indices -= cell_indices.min(axis=0)
    blobs = np.array(list(cells.values()))
    rotated = [_rotate_cells(cell_indices, quarter_rotations) for quarter_rotations in range(4)]
    fitting_rotations = [
        indices
        for indices in rotated
        if (indices.max(axis=0) < (target.rows, target.columns)).all()
    ]
    rows, columns = (fitting_rotations or rotated)[0].max(axis=0) + 1
    extent = f"{len(cells)} circles found, on {rows} x {columns} positions"
    if not fitting_rotations:
        return f"{extent}: larger than the grid of {target.rows} x {target.columns}"
    if target.origin_mark:
        fitting_rotations = _select_by_mark(fitting_rotations, diameters[blobs], target)
        unknown = "and the larger corner circle was not found"
    else:
        fitting_rotations = fitting_rotations if _spans_target(fitting_rotations[0], target) else []
        unknown = "and the grid has no larger corner circle to show which"
    if not fitting_rotations:
        return (
            f"{extent} of {target.rows} x {target.columns}: rows or columns are missing, {unknown}"
        )
    return fitting_rotations[0] @ np.array([target.columns, 1]), blobs


def _grow_lattices(centres: Float[np.ndarray, "blobs 2"]) -> list[Lattice]:
    """Return the lattices grown from the circles nearest to the middle, one for each."""
    if len(centres) < 4:
        return []
    tree = KDTree(centres)
    from_centre_out = np.argsort(np.linalg.norm(centres - np.median(centres, axis=0), axis=1))
    return [_grow_lattice(centres, tree, int(seed)) for seed in from_centre_out[:_MAX_SEED_CIRCLES]]


def _grow_lattice(centres: Float[np.ndarray, "blobs 2"], tree: KDTree, seed: int) -> Lattice:
    """Return the lattice that contains a circle, with rows and columns oriented as in the picture.

    The tree has the same centres as the array, px.
    """
    # Breadth first from the seed: the neighbour of a circle at c is expected at c +- step, and the
    # step to a found neighbour is its measured distance, so that steps follow the perspective.
    across, down = _initial_steps(centres, tree, seed)
    cells, used = {(0, 0): seed}, {seed}
    queue = deque([((0, 0), np.stack([down, across]))])
    while queue:
        cell, steps = queue.popleft()
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            neighbour = (cell[0] + sign * (axis == 0), cell[1] + sign * (axis == 1))
            position, step = centres[cells[cell]], sign * steps[axis]
            distance, nearest = tree.query(position + step)
            blob = int(nearest)
            if (
                neighbour in cells
                or blob in used
                or distance > _POSITION_TOLERANCE * np.linalg.norm(step)
            ):
                continue
            cells[neighbour] = blob
            used.add(blob)
            neighbour_steps = steps.copy()
            neighbour_steps[axis] = sign * (centres[blob] - position)
            queue.append((neighbour, neighbour_steps))
    return cells


def _initial_steps(
    centres: Float[np.ndarray, "blobs 2"], tree: KDTree, seed: int
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return the lattice's first two steps at a circle, px.

    They are the vectors to the nearest circle and to the nearest one in a direction at least 30
    degrees from the first; without such a circle, the second step is perpendicular to the first.
    """
    # |first x other| > sin(30 degrees) |first| |other|
    _, neighbour_indices = tree.query(centres[seed], k=min(9, len(centres)))
    offsets = centres[np.asarray(neighbour_indices)[1:]] - centres[seed]
    lengths = np.linalg.norm(offsets, axis=1)
    first = offsets[0]
    cross_product = first[0] * offsets[:, 1] - first[1] * offsets[:, 0]
    non_parallel = np.flatnonzero(np.abs(cross_product) > 0.5 * lengths[0] * lengths)
    if not len(non_parallel):
        return first, np.array([-first[1], first[0]])
    # The sign makes (columns, rows) right-handed as (x, y) in the picture, because a target is seen
    # from its front and never mirrored.
    return first, np.sign(cross_product[non_parallel[0]]) * offsets[non_parallel[0]]


def _homography_inliers(cells: Lattice, centres: Float[np.ndarray, "blobs 2"]) -> Lattice:
    """Return the cells that agree with one homography from cells to pixels.

    Fewer than nine cells are too few for this test, and none of them is returned.
    """
    if len(cells) < 9:
        return {}
    cell_positions, pixels = np.array(list(cells), dtype=float), centres[list(cells.values())]
    steps = np.linalg.norm(pixels - pixels[:1], axis=1)[1:]
    steps = steps / np.linalg.norm(cell_positions - cell_positions[:1], axis=1)[1:]
    H, inlier_mask = cv2.findHomography(
        cell_positions, pixels, cv2.RANSAC, _POSITION_TOLERANCE * float(np.median(steps))
    )
    if H is None:
        return {}
    return {
        cell: blob
        for (cell, blob), is_inlier in zip(cells.items(), inlier_mask.ravel(), strict=True)
        if is_inlier
    }


def _rotate_cells(
    cells: Int[np.ndarray, "found 2"], quarter_rotations: int
) -> Int[np.ndarray, "found 2"]:
    """Return rows and columns, from zero, after rotations of the grid by 90 degrees each."""
    # (row, column) -> (column, last row - row)
    for _ in range(quarter_rotations):
        cells = np.stack([cells[:, 1], cells[:, 0].max() - cells[:, 0]], axis=1)
    return cells


def _spans_target(cells: Int[np.ndarray, "found 2"], target: CircleGrid) -> bool:
    """Return whether the cells reach from the first to the last row and column of the target."""
    return bool((cells.max(axis=0) + 1 == (target.rows, target.columns)).all())


def _select_by_mark(
    rotated: list[Int[np.ndarray, "found 2"]],
    diameters: Float[np.ndarray, "found"],
    target: CircleGrid,
) -> list[Int[np.ndarray, "found 2"]]:
    """Return the rotation of the cells whose first corner is the mark.

    If the mark is not seen, it is the rotation that spans the target with its first corner hidden.
    The list is empty if there is none or more than one.
    """
    marked, hidden = [], []
    for cells in rotated:
        diameter_by_cell = {
            (int(i), int(j)): float(s) for (i, j), s in zip(cells, diameters, strict=True)
        }
        neighbour_diameters = [
            diameter_by_cell[cell] for cell in ((0, 1), (1, 0), (1, 1)) if cell in diameter_by_cell
        ]
        if (0, 0) not in diameter_by_cell:
            hidden += [cells] if _spans_target(cells, target) else []
        elif neighbour_diameters and diameter_by_cell[0, 0] > _MIN_MARK_DIAMETER_RATIO * np.mean(
            neighbour_diameters
        ):
            marked.append(cells)
    if marked:
        return marked if len(marked) == 1 else []
    return hidden if len(hidden) == 1 else []
