"""Read and write `detections.csv`: detected target points in pixels (view, point, u_px, v_px).

If the points were detected in pictures, the last column holds a key of everything that a view's
detection depends on, so that detection is repeated only if something has changed. Comments at the
end of the file keep what else is known of a view, such as the reason why nothing was found.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..argument_checks import shortened_repr
from ..detection import Detection
from .csv_tables import parse_numbers, read_table, refuse_truncated, write_table
from .view_names import with_names_of

DETECTIONS_FILE = "detections.csv"
"""The name of the file of detections in a data-set folder."""

_COLUMNS = ("view", "point", "u_px", "v_px")
_KEY_COLUMN = "pictures"
"""The name of the column with the key of the view's pictures."""


class KeptDetection(NamedTuple):
    """A view's detection as kept in the file.

    Attributes:
        key: hash of everything that the detection depends on.
        detection: the detection, with the reason if nothing was found.
    """

    key: str
    detection: Detection


def write_detections(
    path: Path,
    view_ids: Sequence[str],
    pixels: Float[np.ndarray, "views points 2"],
) -> int:
    """Write one row for each detected point (px, else NaN), and return the number of rows."""
    rows = [
        row
        for view, view_pixels in zip(view_ids, pixels, strict=True)
        for row in _rows(view, view_pixels, "")
    ]
    write_table(path, (*_COLUMNS, _KEY_COLUMN), rows)
    return len(rows)


def write_kept_detections(path: Path, kept: Mapping[str, KeptDetection]) -> None:
    """Write detections to the file, to be reused as long as their keys stay the same."""
    rows, comments = [], []
    for view, (key, detection) in kept.items():
        # The number of rows reveals a truncated file.
        marked = f"{key}-{np.count_nonzero(detection.visible)}"
        rows += _rows(view, detection.pixels, marked)
        note = {
            "view": view,
            "pictures": marked,
            "reason": detection.reason,
            "left_out": detection.left_out,
            "noise": round(detection.noise, 4),
            "edge_width": detection.edge_width and round(detection.edge_width, 2),
        }
        comments.append(json.dumps(note))
    write_table(path, (*_COLUMNS, _KEY_COLUMN), rows, comments)


def _rows(view: str, pixels: Float[np.ndarray, "points 2"], key: str) -> list[tuple[object, ...]]:
    """Return a row for each detected point of a view."""
    visible = np.asarray(np.isfinite(pixels).all(axis=1))
    return [
        (view, int(point), float(pixels[point, 0]), float(pixels[point, 1]), key)
        for point in np.flatnonzero(visible)
    ]


def read_detections(
    path: Path, view_ids: Sequence[str], point_count: int, stated_rows: int | None = None
) -> tuple[Float[np.ndarray, "views points 2"], tuple[str, ...]]:
    """Read the detected points, px, NaN where a point was not detected, and notes on the table."""
    table = read_table(path, _COLUMNS, ())
    refuse_truncated(path, table.rows, stated_rows)
    rows, notes = with_names_of(table, view_ids)
    pixels = values_of_points(path, rows, view_ids, point_count, _COLUMNS[2:])
    return pixels, (*table.notes, *notes)


def read_kept_detections(
    path: Path, view_ids: Sequence[str], point_count: int
) -> dict[str, KeptDetection]:
    """Read the complete views of a file of `write_kept_detections`; none if there is no file."""
    if not path.is_file():
        return {}
    wanted = set(view_ids)
    rows: dict[str, list[dict[str, str]]] = {}
    table = read_table(path, _COLUMNS, ())
    for row in table.rows:
        if row["view"] in wanted and row.get(_KEY_COLUMN):
            rows.setdefault(row["view"], []).append(row)
    notes = _kept_notes(table.comments)
    kept = {}
    for view in view_ids:
        view_rows, note = rows.get(view, []), notes.get(view, {})
        marked = view_rows[0][_KEY_COLUMN] if view_rows else str(note.get("pictures", ""))
        key, _, count = marked.rpartition("-")
        if (
            not key
            or count != str(len(view_rows))
            or any(row[_KEY_COLUMN] != marked for row in view_rows)
        ):
            continue
        # A point beyond the target's means another target, and so another key.
        if any(row["point"].isdecimal() and int(row["point"]) >= point_count for row in view_rows):
            continue
        pixels = values_of_points(path, view_rows, [view], point_count, _COLUMNS[2:])[0]
        visible = np.asarray(np.isfinite(pixels).all(axis=1))
        # A note about other pictures, or one that was edited, is ignored.
        note = note if note.get("pictures") == marked else {}
        reason, left_out = note.get("reason"), note.get("left_out")
        noise, edge_width = note.get("noise"), note.get("edge_width")
        detection = Detection(
            pixels,
            visible,
            reason if isinstance(reason, str) else None,
            noise if isinstance(noise, float) else 0.0,
            left_out if type(left_out) is int else 0,
            edge_width if isinstance(edge_width, float) else None,
        )
        kept[view] = KeptDetection(key, detection)
    return kept


def _kept_notes(comments: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the notes in a file's comments by view id; other comments are ignored."""
    notes = {}
    for line in comments:
        if line.startswith("# {"):
            try:
                note = json.loads(line[2:])
                notes[str(note["view"])] = note
            except (ValueError, KeyError, TypeError, RecursionError):
                continue
    return notes


def values_of_points(
    path: Path,
    rows: Sequence[Mapping[str, str]],
    view_ids: Sequence[str],
    point_count: int,
    columns: Sequence[str],
) -> Float[np.ndarray, "views points columns"]:
    """Return a table's numbers for points of the target, by view and point; NaN without a row."""
    index = {view: k for k, view in enumerate(view_ids)}
    values = np.full((len(view_ids), point_count, len(columns)), np.nan)
    for row in rows:
        view = row["view"]
        if view not in index:
            raise ValueError(f"{path}: view {shortened_repr(view)} has no pose")
        point, *numbers = parse_numbers(path, row, ("point", *columns), view)
        if point not in range(point_count):
            raise ValueError(f"{path}: view {view}: the target has no point {point:g}")
        if np.isfinite(values[index[view], int(point)]).any():
            raise ValueError(f"{path}: view {view}: point {point:g} has more than one row")
        values[index[view], int(point)] = numbers
    return values
