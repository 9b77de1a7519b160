"""Import a pair of tables: `poses.csv` (view, 4x4) and `corners.csv` (view, X, Y, Z, u, v)."""

from pathlib import Path

import numpy as np

from ..argument_checks import errors_at
from ..dataset import Dataset
from ..detection import DetectionLimits, checked_pixels
from ..geometry import pose_codec
from .csv_tables import parse_numbers, read_table, refuse_out_of_range
from .view_names import with_names_of


def import_correspondences(
    poses_csv: str | Path,
    corners_csv: str | Path,
    image_size: tuple[int, int],
    mount: str = "eye_in_hand",
    bad_views: str = "raise",
    detection_limits: DetectionLimits | None = None,
) -> Dataset:
    """Import a data set whose target points were detected by another program.

    The points of each view are checked for consistency; points or views that fail are left out,
    with the reason.

    Args:
        poses_csv: table with the columns `view, m00 .. m33`: base_from_tool, row-major, m.
        corners_csv: table with the columns `view, X, Y, Z, u, v`: a target point in m and its
            pixel. Views may show different points.
        image_size: width and height, px.
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        bad_views: `"raise"` or `"mask"`, as in `Dataset.from_arrays`.
        detection_limits: largest distance of a point from the position that the other points of
            its view predict; by default `DetectionLimits()`.

    Raises:
        FileNotFoundError: a table is missing.
        ValueError: a wrong value; the message names the file and the view.
    """
    poses_csv, corners_csv = Path(poses_csv), Path(corners_csv)
    codec = pose_codec("matrix")
    table = read_table(poses_csv, ("view", *codec.columns))
    view_ids = table.view_ids("poses")
    # NaN and infinity pass here: `Dataset.from_arrays` raises or masks the view, by `bad_views`.
    rows = [
        parse_numbers(poses_csv, row, codec.columns, row["view"], require_finite=False)
        for row in table.rows
    ]
    poses = np.stack(rows)
    positions = poses[:, list(codec.length_columns)]
    refuse_out_of_range(poses_csv, np.where(np.isfinite(positions), positions, np.nan), view_ids)

    observations: dict[str, list[np.ndarray]] = {view: [] for view in view_ids}
    corners = read_table(corners_csv, ("view", "X", "Y", "Z", "u", "v"))
    corner_rows, name_notes = with_names_of(corners, view_ids)
    for row in corner_rows:
        if row["view"] not in observations:
            raise ValueError(f"{corners_csv}: view {row['view']} has no row in {poses_csv.name}")
        columns = ("X", "Y", "Z", "u", "v")
        observations[row["view"]].append(parse_numbers(corners_csv, row, columns, row["view"]))
    # Views have different numbers of points: all are padded to the largest number, and a pixel of
    # NaN marks a point that the view does not have.
    max_point_count = max(len(rows) for rows in observations.values())
    points = np.zeros((len(view_ids), max_point_count, 3))
    pixels = np.full((len(view_ids), max_point_count, 2), np.nan)
    for k, rows in enumerate(observations.values()):
        for n, row in enumerate(rows):
            points[k, n], pixels[k, n] = row[:3], row[3:]
    refuse_out_of_range(
        corners_csv,
        points.reshape(-1, 3),
        [view for view in view_ids for _ in range(max_point_count)],
    )
    pixels, failed, notes = checked_pixels(points, pixels, view_ids, image_size, detection_limits)
    if len(failed) == len(view_ids):
        view, reason = next(iter(failed.items()))
        raise ValueError(f"{corners_csv}: view {view}: {reason}; so are all {len(failed)} views")
    with errors_at(f"{poses_csv} and {corners_csv.name}"):
        return Dataset.from_arrays(
            points,
            pixels,
            poses.reshape(-1, 4, 4),
            image_size,
            view_ids=view_ids,
            mount=mount,
            bad_views=bad_views,
            masked_views=[
                *((view, "no detections") for view, rows in observations.items() if not rows),
                *failed.items(),
            ],
            notes=(*table.notes, *corners.notes, *name_notes, *notes),
        )
