"""Read and write `detections.csv`: detected target points in pixels (view, point, u_px, v_px)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..schemas.words import shown
from .tables import numbers, read_table, refuse_cut, write_table

DETECTIONS = "detections.csv"
"""Name of the file of detections in a data-set folder."""

_COLUMNS = ("view", "point", "u_px", "v_px")
_STAMP = "pictures"
"""Name of the column with the fingerprint of the pictures and the target."""


def write_detections(
    path: Path, views: Sequence[str], pixels: Float[np.ndarray, "views points 2"], stamp: str = ""
) -> int:
    """Write one row for each detected point, and return the number of rows.

    Args:
        path: of the file.
        views: view ids.
        pixels: detected points, px; NaN where a point was not detected.
        stamp: fingerprint of the pictures and target; empty for a file that is no cache.
    """
    seen = np.asarray(np.isfinite(pixels).all(axis=2))
    mark = _marked(stamp, int(np.count_nonzero(seen)))
    rows = [
        (view, int(point), float(where[point, 0]), float(where[point, 1]), mark)
        for view, where, points in zip(views, pixels, seen, strict=True)
        for point in np.flatnonzero(points)
    ]
    write_table(path, (*_COLUMNS, _STAMP), rows)
    return len(rows)


def read_detections(
    path: Path, views: Sequence[str], count: int, rows: int | None = None
) -> Float[np.ndarray, "views points 2"]:
    """Read the detected points, px; NaN where a point was not detected.

    Args:
        path: of the file.
        views: ids of all views.
        count: number of points of the target.
        rows: number of rows that the data set's description states; None where it states none.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a view without a pose, a point that the target does not have or that a view
            has twice, a pixel that is not a number, or rows are missing.
    """
    table = read_table(path, _COLUMNS)
    refuse_cut(path, table, rows)
    return _pixels(path, table, views, count)


def read_stamped(
    path: Path, stamp: str, views: Sequence[str], count: int
) -> Float[np.ndarray, "views points 2"] | None:
    """Read cached detections; None if the file is missing, truncated or has another stamp."""
    if not path.is_file():
        return None
    table = read_table(path, (*_COLUMNS, _STAMP))
    # A truncated file has fewer rows than its stamp counts, and so another stamp.
    mark = _marked(stamp, len(table))
    if not table or any(row[_STAMP] != mark for row in table):
        return None
    return _pixels(path, table, views, count)


def _marked(stamp: str, rows: int) -> str:
    """Return the stamp with the number of rows appended; it reveals a truncated file."""
    return f"{stamp}-{rows}" if stamp else ""


def _pixels(
    path: Path, table: list[dict[str, str]], views: Sequence[str], count: int
) -> Float[np.ndarray, "views points 2"]:
    """Return the table's pixels, `(views, points, 2)`; NaN where a point has no row."""
    index = {view: k for k, view in enumerate(views)}
    pixels = np.full((len(views), count, 2), np.nan)
    for row in table:
        view = row["view"]
        if view not in index:
            raise ValueError(f"{path}: view {shown(view)} has no pose")
        point, u, v = numbers(path, row, _COLUMNS[1:], view)
        if point != int(point) or not 0 <= point < count:
            raise ValueError(f"{path}: view {view}: the target has no point {point:g}")
        if np.isfinite(pixels[index[view], int(point)]).any():
            raise ValueError(f"{path}: view {view}: point {point:g} has more than one row")
        pixels[index[view], int(point)] = u, v
    return pixels
