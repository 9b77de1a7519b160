"""`detections.csv`: which point of the target was seen where (view, point, u_px, v_px)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from .tables import numbers, read_table, write_table

DETECTIONS = "detections.csv"

_COLUMNS = ("view", "point", "u_px", "v_px")
_STAMP = "pictures"


def write_detections(
    path: Path, views: Sequence[str], pixels: Float[np.ndarray, "views points 2"], stamp: str = ""
) -> None:
    """Write what was seen, point by point.

    Args:
        path: of the file.
        views: names.
        pixels: NaN where not seen.
        stamp: says which pictures and target these are of.
    """
    rows = [
        (view, int(point), float(where[point, 0]), float(where[point, 1]), stamp)
        for view, where in zip(views, pixels, strict=True)
        for point in np.flatnonzero(np.isfinite(where).all(axis=1))
    ]
    write_table(path, (*_COLUMNS, _STAMP), rows)


def read_detections(
    path: Path, views: Sequence[str], count: int
) -> Float[np.ndarray, "views points 2"]:
    """What was seen of a target with `count` points; NaN where nothing.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a view without a pose, or a point that the target has not.
    """
    return _pixels(path, read_table(path, _COLUMNS), views, count)


def read_stamped(
    path: Path, stamp: str, views: Sequence[str], count: int
) -> Float[np.ndarray, "views points 2"] | None:
    """The same, if the file is there and carries this stamp."""
    if not path.is_file():
        return None
    table = read_table(path, (*_COLUMNS, _STAMP))
    if not table or any(row[_STAMP] != stamp for row in table):
        return None
    return _pixels(path, table, views, count)


def _pixels(
    path: Path, table: list[dict[str, str]], views: Sequence[str], count: int
) -> Float[np.ndarray, "views points 2"]:
    index = {view: k for k, view in enumerate(views)}
    pixels = np.full((len(views), count, 2), np.nan)
    for row in table:
        view = row["view"]
        if view not in index:
            raise ValueError(f"{path}: view {view} has no pose")
        point, u, v = numbers(path, row, _COLUMNS[1:], view)
        if point != int(point) or not 0 <= point < count:
            raise ValueError(f"{path}: view {view}: the target has no point {point:g}")
        pixels[index[view], int(point)] = u, v
    return pixels
