"""Define the printed pattern of targets: whether a point of the board is dark or light."""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from ..detection import dictionary_by_name
from ..targets import AbstractTarget, AprilGrid, Charuco, Chessboard, CircleGrid, TagGrid

Pattern = Callable[
    [Float[np.ndarray, "samples"], Float[np.ndarray, "samples"]], Bool[np.ndarray, "samples"]
]
"""A function that returns whether a board is dark at x and y of the board's own frame, m."""

ORIGIN_MARK_RATIO = 1.5
"""Ratio of the larger corner circle's radius to the others', if the target does not state it."""


def printed_pattern(target: AbstractTarget) -> Pattern:
    """Return the printed pattern of a flat target; the paper around it is light and unbounded.

    Circles of unknown radius have a quarter of the distance to their nearest neighbour; the
    background of light circles is dark everywhere.
    """
    if isinstance(target, CircleGrid):
        return _circle_pattern(target)
    if isinstance(target, Chessboard):
        return _chessboard_pattern(target)
    if isinstance(target, Charuco):
        return _charuco_pattern(target)
    if isinstance(target, TagGrid | AprilGrid):
        return _tag_pattern(target)
    raise ValueError(f"there is no drawing of a {type(target).__name__}; draw its board")


def _circle_pattern(target: CircleGrid) -> Pattern:
    step = target.spacing
    radius = 0.25 * target.nearest_neighbour_distance if target.radius is None else target.radius
    mark_radius = ORIGIN_MARK_RATIO * radius if target.mark_radius is None else target.mark_radius

    def is_dark(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        # The nearest circle decides, so that no loop over circles is needed. Odd rows of an
        # asymmetric grid are shifted by one step, and the pitch of its columns is two.
        i = np.clip(np.rint(y / step), 0, target.rows - 1)
        shift, pitch = (i % 2, 2.0) if target.asymmetric else (0.0, 1.0)
        j = np.clip(np.rint((x / step - shift) / pitch), 0, target.columns - 1)
        marked = target.origin_mark & (i == 0) & (j == 0)
        from_centre = np.hypot(x - (pitch * j + shift) * step, y - i * step)
        inside = from_centre <= np.where(marked, mark_radius, radius)
        return inside != target.light_on_dark

    return is_dark


def _chessboard_pattern(target: Chessboard) -> Pattern:
    def is_dark(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        i, j = _cell_index(y, target.square), _cell_index(x, target.square)
        printed = (i >= -1) & (i < target.rows) & (j >= -1) & (j < target.columns)
        # The square between the first four corners is light.
        return printed & ((i + j) % 2 != 0)

    return is_dark


def _charuco_pattern(target: Charuco) -> Pattern:
    """Return the pattern of a ChArUco board: dark squares, and markers on the light ones."""
    # Markers are on the light squares. In legacy boards with an even number of rows the first
    # square is light.
    light_first = target.legacy and target.squares_y % 2 == 0
    light = (np.add.outer(range(target.squares_y), range(target.squares_x)) % 2 == 0) == light_first
    # Markers are numbered row by row over the light squares; -1 where a square has none.
    ids = np.where(light, np.cumsum(light).reshape(light.shape) - 1, -1)
    bits = _marker_cells(target.dictionary, int(light.sum()))
    margin = 0.5 * (target.square - target.marker)

    def is_dark(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        i, j = _cell_index(y, target.square), _cell_index(x, target.square)
        printed = (i >= 0) & (i < target.squares_y) & (j >= 0) & (j < target.squares_x)
        i, j = np.clip(i, 0, target.squares_y - 1), np.clip(j, 0, target.squares_x - 1)
        across, down = x - j * target.square - margin, y - i * target.square - margin
        marked = _is_marker_dark(bits, np.maximum(ids[i, j], 0), across, down, target.marker)
        return printed & np.where(light[i, j], marked, True)

    return is_dark


def _tag_pattern(target: TagGrid | AprilGrid) -> Pattern:
    """Return the pattern of a grid of tags, with an AprilGrid's squares at the tags' corners."""
    bits = _marker_cells(target.dictionary, target.ids[-1] + 1, target.border_bits)
    is_april = isinstance(target, AprilGrid)
    if is_april:
        # Kalibr prints tags rotated by half a turn compared with OpenCV's drawings.
        bits = bits[:, ::-1, ::-1]
    gap = target.spacing * target.size if isinstance(target, AprilGrid) else target.gap or 0.0
    from_bottom = isinstance(target, AprilGrid) or target.rows_from == "bottom"
    pitch = target.size + gap
    left, top = target.points[:, 0].min(), target.points[:, 1].max()
    bottom, right = target.points[:, 1].min(), target.points[:, 0].max()

    def is_dark(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        # The board's y axis points up; rows are counted downwards here.
        i = np.clip(_cell_index(top - y, pitch), 0, target.rows - 1)
        j = np.clip(_cell_index(x - left, pitch), 0, target.columns - 1)
        row = target.rows - 1 - i if from_bottom else i
        marker_ids = target.first_id + row * target.columns + j
        dark = _is_marker_dark(
            bits, marker_ids, x - left - j * pitch, top - y - i * pitch, target.size
        )
        if not is_april:
            return dark
        # Squares fill the crossings of the gaps, also in a border around the board.
        within = (x >= left - gap) & (x < right + gap) & (y > bottom - gap) & (y <= top + gap)
        crossing = ((x - left) % pitch >= target.size) & ((top - y) % pitch >= target.size)
        return dark | (within & crossing)

    return is_dark


def _cell_index(
    coordinates: Float[np.ndarray, "samples"], size: float
) -> Int[np.ndarray, "samples"]:
    """Return the index of the cell that contains each coordinate."""
    return np.floor(coordinates / size).astype(int)


def _marker_cells(
    dictionary: str, count: int, border_bits: int = 1
) -> Bool[np.ndarray, "markers cells cells"]:
    """Return the dark cells of the first markers of a dictionary, including the border."""
    marker_dictionary = dictionary_by_name(dictionary)
    # A border of dark cells surrounds the marker's own cells.
    cells = marker_dictionary.markerSize + 2 * border_bits
    return np.stack(
        [
            cv2.aruco.generateImageMarker(marker_dictionary, k, cells, borderBits=border_bits) == 0
            for k in range(count)
        ]
    )


def _is_marker_dark(
    bits: Bool[np.ndarray, "markers cells cells"],
    marker_ids: Int[np.ndarray, "samples"],
    across: Float[np.ndarray, "samples"],
    down: Float[np.ndarray, "samples"],
    size: float,
) -> Bool[np.ndarray, "samples"]:
    """Return whether a point is dark, given relative to a marker's top left corner.

    Points outside the marker are light.
    """
    cells = bits.shape[-1]
    row, column = _cell_index(down, size / cells), _cell_index(across, size / cells)
    inside = (row >= 0) & (row < cells) & (column >= 0) & (column < cells)
    row, column = np.clip(row, 0, cells - 1), np.clip(column, 0, cells - 1)
    return inside & bits[marker_ids, row, column]
