"""Measure which parts of the picture, and which rotations, the views taken so far cover."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

GRID = (6, 8)
"""Rows and columns of the cells into which the picture is divided."""


class Coverage(NamedTuple):
    """The coverage of picture and rotations.

    Attributes:
        cells: which cells of the picture have a point of the target in any view.
        rotations: standard deviations of the robot's rotations about three perpendicular axes,
            largest first, rad. Where the second is zero, all rotations share an axis, and the
            hand-eye transform cannot be known.
    """

    cells: Bool[np.ndarray, "rows columns"]
    rotations: Float[np.ndarray, "3"]


def coverage(
    pixels: Sequence[Float[np.ndarray, "points 2"]],
    base_from_tool: Sequence[Float[np.ndarray, "4 4"]],
    image_size: tuple[int, int],
) -> Coverage:
    """Return the coverage of views.

    Args:
        pixels: detected points of each view, px; NaN where a point was not detected.
        base_from_tool: pose of each view.
        image_size: width and height of the pictures, px.
    """
    cells = np.zeros(GRID, dtype=bool)
    for view in pixels:
        seen = view[np.isfinite(view).all(axis=1)]
        # Pixels begin half a pixel before zero.
        part = (seen + 0.5) / image_size * (GRID[1], GRID[0])
        column, row = np.clip(np.floor(part).astype(int), 0, (GRID[1] - 1, GRID[0] - 1)).T
        cells[row, column] = True
    if len(base_from_tool) < 2:
        return Coverage(cells, np.zeros(3))
    rotations = Rotation.from_matrix(np.stack(base_from_tool)[:, :3, :3])
    vectors = (rotations.mean().inv() * rotations).as_rotvec()
    spread = np.linalg.svd(vectors, compute_uv=False) / np.sqrt(len(vectors))
    return Coverage(cells, np.pad(spread, (0, 3 - len(spread))))
