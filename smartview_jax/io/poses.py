"""Read and write the robot's reported poses of a data-set folder, `poses.csv`.

    poses: {file: poses.csv, codec: matrix, length_unit: m, angle_unit: rad,
            direction: base_from_tool}

The file has a column `view` and the columns of the codec.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxlie import SE3

from ..geometry import LENGTH_UNITS, PoseCodec, as_se3, host_matrices, pose_codec
from .csv_tables import (
    duplicates,
    parse_numbers,
    read_table,
    refuse_out_of_range,
    refuse_truncated,
    write_table,
)

POSES_FILE = "poses.csv"
"""The name of the file that `write_poses` writes."""


def read_poses(
    folder: Path, content: dict[str, Any], bad_views: str
) -> tuple[list[str], SE3, dict[str, str]]:
    """Read view ids and poses, and the reasons by view id of those that are masked.

    Args:
        folder: of the data set.
        content: the entry `poses`, as `schemas.dataset` defines it.
        bad_views: `"mask"` to mask views whose row is no valid pose, `"raise"` to raise for them.

    Raises:
        ValueError: naming the file and the view that is wrong.
        FileNotFoundError: the table is missing.
    """
    path, codec = folder / content["file"], pose_codec(content["codec"])
    table = read_table(path, ("view", *codec.columns))
    refuse_truncated(path, table, content.get("rows"))
    view_ids = [row["view"] for row in table]
    if duplicates(view_ids):
        raise ValueError(f"{path}: view {', '.join(duplicates(view_ids))} has more than one row")
    if not view_ids:
        raise ValueError(f"{path}: no poses")
    # NaN passes here: `bad_views` decides below whether it is an error or a masked view.
    rows = np.stack([parse_numbers(path, row, codec.columns, row["view"], False) for row in table])
    positions = rows[:, list(codec.length_columns)] * LENGTH_UNITS[content["length_unit"]]
    # Infinity becomes NaN, which passes: the message about units would be misleading for it.
    refuse_out_of_range(path, np.where(np.isfinite(positions), positions, np.nan), view_ids)
    units = (content["length_unit"], content["angle_unit"])
    masked_views = _decoding_errors(codec, rows, units, view_ids) if bad_views == "mask" else {}
    is_valid = [view not in masked_views for view in view_ids]
    # Decoding needs a valid row for every view. A masked view's pose is never used, so the first
    # valid row takes its place.
    rows = np.where(
        np.array(is_valid)[:, None], rows, rows[is_valid.index(True) if any(is_valid) else 0]
    )
    try:
        poses = codec.decode(rows, *units, labels=view_ids)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if content["direction"] != "base_from_tool":
        poses = as_se3(np.linalg.inv(host_matrices(poses)))
    return view_ids, poses, masked_views


def write_poses(folder: Path, view_ids: Sequence[str], base_from_tool: SE3) -> dict[str, Any]:
    """Write `poses.csv`, and return the entry `poses` of the description."""
    # Matrices need no convention of angles, whatever the robot reports.
    codec = pose_codec("matrix")
    rows = codec.encode(base_from_tool)
    write_table(
        folder / POSES_FILE,
        ("view", *codec.columns),
        [(view, *map(float, row)) for view, row in zip(view_ids, rows, strict=True)],
    )
    return {
        "file": POSES_FILE,
        "codec": codec.name,
        "length_unit": "m",
        "angle_unit": "rad",
        "direction": "base_from_tool",
        "rows": len(rows),
    }


def _decoding_errors(
    codec: PoseCodec, rows: np.ndarray, units: tuple[str, str], view_ids: list[str]
) -> dict[str, str]:
    """Return the decoding error of every view whose row is not a valid pose, by view id."""
    # Row by row, since decoding a whole table stops at the first invalid row.
    errors = {}
    for view, row in zip(view_ids, rows, strict=True):
        try:
            codec.decode(row[None], *units, labels=[view])
        except ValueError as error:
            errors[view] = str(error)
    return errors
