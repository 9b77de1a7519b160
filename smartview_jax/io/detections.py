"""`detections.csv`: which point of the target was seen where (view, point, u_px, v_px)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..schemas.words import shown
from .tables import numbers, read_table, refuse_cut, write_table

DETECTIONS = "detections.csv"

_COLUMNS = ("view", "point", "u_px", "v_px")
_STAMP = "pictures"


def write_detections(
    path: Path, views: Sequence[str], pixels: Float[np.ndarray, "views points 2"], stamp: str = ""
) -> int:
    """Write what was seen, point by point, and return how many rows that are.

    Args:
        path: of the file.
        views: names.
        pixels: px; NaN where not seen.
        stamp: says which pictures and target these are of.
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
    """Read what was seen of a target; NaN where nothing.

    Args:
        path: of the file.
        views: names of all views.
        count: of the target's points.
        rows: how many there are, where the data set's description says so.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a view without a pose, a point that the target has not or that the view has
            twice, a pixel that is no number, or rows are missing.
    """
    table = read_table(path, _COLUMNS)
    refuse_cut(path, table, rows)
    return _pixels(path, table, views, count)


def read_stamped(
    path: Path, stamp: str, views: Sequence[str], count: int
) -> Float[np.ndarray, "views points 2"] | None:
    """Read the same, if the file is there, carries this stamp and has all its rows."""
    if not path.is_file():
        return None
    table = read_table(path, (*_COLUMNS, _STAMP))
    mark = _marked(stamp, len(table))
    if not table or any(row[_STAMP] != mark for row in table):
        return None
    return _pixels(path, table, views, count)


def _marked(stamp: str, rows: int) -> str:
    """Return a stamp that also says how many rows there are: a file that was cut has fewer."""
    return f"{stamp}-{rows}" if stamp else ""


def _pixels(
    path: Path, table: list[dict[str, str]], views: Sequence[str], count: int
) -> Float[np.ndarray, "views points 2"]:
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
