"""Read and write the depths that a camera measured at the detected points of a data-set folder.

Depth pictures registered to the pictures in which the target is detected, of the same camera, whose
lens is to be found (with `camera:` it is known, and the folder is one of `depth_folder.py`):

    pictures: {pattern: "grey/{view}.png"}
    depth_pictures: {pattern: "depth/{view}.png", unit: mm,
                     noise: {constant: 5e-4, quadratic: 1e-3}}

Or the table `depths.csv` with the columns `view,point,depth_m`, a row for each point with a depth:

    depths: {rows: 810, noise: {constant: 5e-4, quadratic: 1e-3}}

Depths are along the optical axis. `noise` is the standard deviation of a single depth z, in m the
root of constant^2 + (quadratic z^2)^2; `common`, m, of the error that all depths of a view have in
common. What is not stated is estimated.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..argument_checks import errors_at
from ..dataset import Dataset, DepthNoise
from ..depth import points_at_pixels, read_depth_picture
from .csv_tables import read_table, refuse_truncated, write_table
from .detections import values_of_points
from .folder_description import DescribedFolder
from .folder_pictures import LoadOptions, picture_files
from .view_names import with_names_of

DEPTHS_FILE = "depths.csv"
"""The name of the table of depths in a data-set folder."""

_COLUMNS = ("view", "point", "depth_m")


def with_folder_depths(
    data: Dataset, described: DescribedFolder, options: LoadOptions, table: str = DEPTHS_FILE
) -> Dataset:
    """Return the data set of a folder with the depths at its points, if it has any."""
    content, notes = described.content, ()
    if "depth_pictures" in content:
        entry = content["depth_pictures"]
        depths, notes = _depths_of_pictures(data, described, options)
    elif "depths" in content:
        entry = content["depths"]
        depths = _read_depths(described.folder / table, data, entry.get("rows"))
    else:
        return data
    noise = entry.get("noise")
    with errors_at(described.path):
        data = data.with_depths(depths, None if noise is None else DepthNoise(**noise))
    return dataclasses.replace(data, notes=(*data.notes, *notes))


def _depths_of_pictures(
    data: Dataset, described: DescribedFolder, options: LoadOptions
) -> tuple[Float[np.ndarray, "views points"], tuple[str, ...]]:
    """Return depths at the detected points, else NaN, and notes on pictures left out."""
    entry = described.content["depth_pictures"]
    files = picture_files(described, entry["pattern"], data.view_ids, data.target)
    pixels, notes = np.asarray(data.pixels), []
    depths = np.full(pixels.shape[:2], np.nan)
    for number, view in enumerate(data.view_ids):
        if not np.isfinite(pixels[number]).any():
            continue
        if options.progress is not None:
            options.progress(f"depths of view {view} ({number + 1} of {len(files)})")
        try:
            depths[number] = _depths_at(
                files[view][0], entry["unit"], pixels[number], data.image_size
            )
        except (ValueError, FileNotFoundError) as error:
            if options.bad_views == "raise":
                raise
            notes.append(f"view {view} has no depths: {error}")
    return depths, tuple(notes)


def _depths_at(
    path: Path,
    unit: str | float,
    pixels: Float[np.ndarray, "points 2"],
    image_size: tuple[int, int],
) -> Float[np.ndarray, "points"]:
    """Return the depths of a picture at some pixels, m."""
    picture = read_depth_picture(path, unit)
    if picture.shape != image_size[::-1]:
        raise ValueError(
            f"{path}: expected {image_size[0]} x {image_size[1]} px, as of the other pictures, "
            f"found {picture.shape[1]} x {picture.shape[0]}"
        )
    # With x and y of zero, only the depth is averaged over the patch.
    return points_at_pixels(picture[..., None] * [0.0, 0.0, 1.0], pixels)[:, 2]


def _read_depths(
    path: Path, data: Dataset, stated_rows: int | None
) -> Float[np.ndarray, "views points"]:
    """Return the depths of a table, m; NaN for points without a row."""
    table = read_table(path, _COLUMNS, ())
    refuse_truncated(path, table.rows, stated_rows)
    rows, _ = with_names_of(table, data.view_ids)
    return values_of_points(path, rows, data.view_ids, data.visible.shape[1], _COLUMNS[2:])[..., 0]


def write_depths(data: Dataset, path: Path) -> dict[str, Any]:
    """Write the depths of a data set, if it has any, and return the entry that describes them.

    Depths that were left out as outliers have no row.
    """
    if data.depths is None or data.depth_noise is None:
        return {}
    measured = np.asarray(data.depths.measured)
    rows = [
        (data.view_ids[view], int(point), float(measured[view, point]))
        for view, point in np.argwhere(data.depths.used)
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_table(path, _COLUMNS, rows)
    noise = dataclasses.asdict(data.depth_noise)
    if noise["common"] is None:
        del noise["common"]
    return {"depths": {"rows": len(rows), "noise": noise}}
