"""What a target looks like: how light it is at any place on its board."""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from ..detection import dictionary_by_name
from ..targets import AbstractTarget, Charuco, Chessboard, CircleGrid, TagGrid

Pattern = Callable[
    [Float[np.ndarray, "places"], Float[np.ndarray, "places"]], Bool[np.ndarray, "places"]
]
"""Where a board is dark, by x and y in the board's own frame, m."""

ORIGIN_MARK = 1.5
"""Radius of the larger corner circle over that of the others, where the target does not say."""


def dark_places(target: AbstractTarget) -> Pattern:
    """The printed pattern of a flat target; paper around it is light without end.

    Circles of unknown radius have a quarter of the distance to their nearest neighbour, and the
    ground of light circles is dark everywhere.

    Raises:
        ValueError: a target whose looks are not known.
    """
    if isinstance(target, CircleGrid):
        return _circles(target)
    if isinstance(target, Chessboard):
        return _chessboard(target)
    if isinstance(target, Charuco):
        return _charuco(target)
    if isinstance(target, TagGrid):
        return _tags(target)
    raise ValueError(f"there is no drawing of a {type(target).__name__}; draw its board")


def _circles(target: CircleGrid) -> Pattern:
    step = target.spacing
    radius = 0.25 * target.nearest if target.radius is None else target.radius
    mark = ORIGIN_MARK * radius if target.mark_radius is None else target.mark_radius

    def dark(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        i = np.clip(np.rint(y / step), 0, target.rows - 1)
        shift, pitch = (i % 2, 2.0) if target.asymmetric else (0.0, 1.0)
        j = np.clip(np.rint((x / step - shift) / pitch), 0, target.columns - 1)
        marked = target.origin_mark & (i == 0) & (j == 0)
        from_centre = np.hypot(x - (pitch * j + shift) * step, y - i * step)
        inside = from_centre <= np.where(marked, mark, radius)
        return inside != target.light_on_dark

    return dark


def _chessboard(target: Chessboard) -> Pattern:
    def dark(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        i, j = _cell(y, target.square), _cell(x, target.square)
        printed = (i >= -1) & (i < target.rows) & (j >= -1) & (j < target.columns)
        # The square between the first four corners is light.
        return printed & ((i + j) % 2 != 0)

    return dark


def _charuco(target: Charuco) -> Pattern:
    # Markers sit on the light squares, which begin with the first one in some legacy boards.
    light_first = target.legacy and target.squares_y % 2 == 0
    light = (np.add.outer(range(target.squares_y), range(target.squares_x)) % 2 == 0) == light_first
    ids = np.where(light, np.cumsum(light).reshape(light.shape) - 1, -1)
    bits = _marker_cells(target.dictionary, int(light.sum()))
    margin = 0.5 * (target.square - target.marker)

    def dark(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        i, j = _cell(y, target.square), _cell(x, target.square)
        printed = (i >= 0) & (i < target.squares_y) & (j >= 0) & (j < target.squares_x)
        i, j = np.clip(i, 0, target.squares_y - 1), np.clip(j, 0, target.squares_x - 1)
        across, down = x - j * target.square - margin, y - i * target.square - margin
        marked = _marker(bits, np.maximum(ids[i, j], 0), across, down, target.marker)
        return printed & np.where(light[i, j], marked, True)

    return dark


def _tags(target: TagGrid) -> Pattern:
    bits = _marker_cells(target.dictionary, target.ids[-1] + 1)
    pitch = target.size + target.gap
    left, top = target.points[0, :2]

    def dark(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        # The board's y points up, rows go down.
        i = np.clip(_cell(top - y, pitch), 0, target.rows - 1)
        j = np.clip(_cell(x - left, pitch), 0, target.columns - 1)
        number = target.first_id + i * target.columns + j
        return _marker(bits, number, x - left - j * pitch, top - y - i * pitch, target.size)

    return dark


def _cell(where: Float[np.ndarray, "places"], size: float) -> Int[np.ndarray, "places"]:
    return np.floor(where / size).astype(int)


def _marker_cells(dictionary: str, count: int) -> Bool[np.ndarray, "markers cells cells"]:
    """The dark cells of a dictionary's first markers, the border included."""
    known = dictionary_by_name(dictionary)
    cells = known.markerSize + 2
    return np.stack([cv2.aruco.generateImageMarker(known, k, cells) == 0 for k in range(count)])


def _marker(
    bits: Bool[np.ndarray, "markers cells cells"],
    number: Int[np.ndarray, "places"],
    across: Float[np.ndarray, "places"],
    down: Float[np.ndarray, "places"],
    size: float,
) -> Bool[np.ndarray, "places"]:
    """Whether a place is dark, given from a marker's top left corner; light outside of it."""
    cells = bits.shape[-1]
    row, column = _cell(down, size / cells), _cell(across, size / cells)
    inside = (row >= 0) & (row < cells) & (column >= 0) & (column < cells)
    row, column = np.clip(row, 0, cells - 1), np.clip(column, 0, cells - 1)
    return inside & bits[number, row, column]
