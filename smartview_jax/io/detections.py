"""Read and write `detections.csv`: detected target points in pixels (view, point, u_px, v_px)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..schemas.messages import shortened_repr
from .csv_tables import parse_numbers, read_table, refuse_truncated, write_table

DETECTIONS_FILE = "detections.csv"
"""The name of the file of detections in a data-set folder."""

_COLUMNS = ("view", "point", "u_px", "v_px")
_FINGERPRINT_COLUMN = "pictures"
"""The name of the column with the fingerprint of the pictures and the target."""


def write_detections(
    path: Path,
    view_ids: Sequence[str],
    pixels: Float[np.ndarray, "views points 2"],
    fingerprint: str = "",
) -> int:
    """Write one row for each detected point, and return the number of rows.

    Args:
        path: of the file.
        view_ids: view ids.
        pixels: detected points, px; NaN where a point was not detected.
        fingerprint: fingerprint of the pictures and target; empty for a file that is no cache.
    """
    visible = np.asarray(np.isfinite(pixels).all(axis=2))
    # The key stands in every row; `read_cached_detections` requires that all of them match.
    cache_key = _cache_key(fingerprint, int(np.count_nonzero(visible)))
    rows = [
        (view, int(point), float(view_pixels[point, 0]), float(view_pixels[point, 1]), cache_key)
        for view, view_pixels, view_visible in zip(view_ids, pixels, visible, strict=True)
        for point in np.flatnonzero(view_visible)
    ]
    write_table(path, (*_COLUMNS, _FINGERPRINT_COLUMN), rows)
    return len(rows)


def read_detections(
    path: Path, view_ids: Sequence[str], point_count: int, stated_rows: int | None = None
) -> Float[np.ndarray, "views points 2"]:
    """Read the detected points, px; NaN where a point was not detected.

    Args:
        path: of the file.
        view_ids: ids of all views.
        point_count: number of points of the target.
        stated_rows: number of rows that the data set's description states; None where it states
            none.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a view without a pose, a point that the target does not have or that a view
            has twice, a pixel that is not a number, or rows are missing.
    """
    table = read_table(path, _COLUMNS)
    refuse_truncated(path, table, stated_rows)
    return _pixels_from_table(path, table, view_ids, point_count)


def read_cached_detections(
    path: Path, fingerprint: str, view_ids: Sequence[str], point_count: int
) -> Float[np.ndarray, "views points 2"] | None:
    """Read cached detections; None if the file is missing, truncated or has another cache key."""
    if not path.is_file():
        return None
    table = read_table(path, (*_COLUMNS, _FINGERPRINT_COLUMN))
    # A truncated file has fewer rows than its key states, and so another key.
    cache_key = _cache_key(fingerprint, len(table))
    if not table or any(row[_FINGERPRINT_COLUMN] != cache_key for row in table):
        return None
    return _pixels_from_table(path, table, view_ids, point_count)


def _cache_key(fingerprint: str, row_count: int) -> str:
    """Return the fingerprint with the number of rows appended, which reveals a truncated file."""
    return f"{fingerprint}-{row_count}" if fingerprint else ""


def _pixels_from_table(
    path: Path, table: list[dict[str, str]], view_ids: Sequence[str], point_count: int
) -> Float[np.ndarray, "views points 2"]:
    """Return the table's pixels, `(views, points, 2)`; NaN where a point has no row."""
    index = {view: k for k, view in enumerate(view_ids)}
    pixels = np.full((len(view_ids), point_count, 2), np.nan)
    for row in table:
        view = row["view"]
        if view not in index:
            raise ValueError(f"{path}: view {shortened_repr(view)} has no pose")
        point, u, v = parse_numbers(path, row, _COLUMNS[1:], view)
        if point != int(point) or not 0 <= point < point_count:
            raise ValueError(f"{path}: view {view}: the target has no point {point:g}")
        if np.isfinite(pixels[index[view], int(point)]).any():
            raise ValueError(f"{path}: view {view}: point {point:g} has more than one row")
        pixels[index[view], int(point)] = u, v
    return pixels
