"""Read a data-set folder of a depth sensor: points of a target, or depth pictures of it.

Points that the sensor's own program found, one file for each view:

    smartview_dataset: 1
    target: {kind: chessboard, rows: 9, columns: 6, square: 0.025}
    mount: eye_in_hand
    poses: {file: poses.csv, codec: quaternion_xyzw, length_unit: m, angle_unit: rad,
            direction: base_from_tool}
    measured_points: {pattern: "points/{view}.csv", unit: mm}

A file is a table with the columns `point,x,y,z`, where `point` counts the target's points from 0
and points that were not measured have no row; or an array of NumPy (`.npy`, or `.npz` with one
array), or a PLY file, with a row for each point of the target, NaN where it was not measured. The
frame is the sensor's, z along its optical axis.

Or depth pictures, with a picture of grey values or colour of the same camera for each, in which the
target is detected:

    camera: {image_size: [640, 480]}
    pictures: {pattern: "grey/{view}.png"}
    depth_pictures: {pattern: "depth/{view}.png", unit: mm, camera: camera.yaml}

`unit` is m, cm, mm, or metres by number, such as 0.0001; the camera's file has any format of
`read_camera`. Without a camera its lens is to be found too (`point_depths.py`).
"""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..argument_checks import errors_at
from ..dataset import Dataset, PoseDataset
from ..depth import cloud_from_depth, points_at_pixels, poses_from_points, read_depth_picture
from ..extras import import_extra
from ..geometry import LENGTH_UNITS
from ..targets import AbstractTarget, StackedTarget
from .csv_tables import parse_numbers, read_table
from .folder_description import DescribedFolder, read_target
from .folder_pictures import LoadOptions, picture_files
from .known_camera import read_camera
from .poses import RobotReadings
from .robot_readings import read_robot_readings

POINT_FORMATS = (".csv", ".npy", ".npz", ".ply")
"""Endings of the files of measured points."""

_COLUMNS = ("x", "y", "z")


def read_measured_points(
    path: str | Path, count: int, unit: str | float = "m"
) -> Float[np.ndarray, "points 3"]:
    """Return a target's points as a depth sensor measured them in one view, m; NaN for others.

    The unit is m, cm or mm, or a number of metres; the module's docstring describes the file.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file of points")
    if path.suffix.lower() not in POINT_FORMATS:
        raise ValueError(f"{path}: expected one of {', '.join(POINT_FORMATS)}")
    if path.suffix.lower() == ".csv":
        points = _points_from_table(path, count)
    else:
        points = _points_from_array(path)
        if points.shape != (count, 3):
            raise ValueError(
                f"{path}: expected {count} points of the target, shape ({count}, 3), found shape "
                f"{points.shape}"
            )
    points = points * (LENGTH_UNITS[unit] if isinstance(unit, str) else unit)
    points[~np.isfinite(points).all(axis=1)] = np.nan
    behind = np.flatnonzero(points[:, 2] <= 0.0)
    if len(behind):
        raise ValueError(
            f"{path}: point {behind[0]}: expected a depth z above 0, found "
            f"{points[behind[0], 2]:.4g} m; a point that was not measured has no row, or nan"
        )
    return points


def _points_from_table(path: Path, count: int) -> Float[np.ndarray, "points 3"]:
    """Return the points of a table; NaN for points without a row."""
    points = np.full((count, 3), np.nan)
    table = read_table(path, ("point", *_COLUMNS), LENGTH_UNITS)
    for number, row in enumerate(table.rows, start=1):
        point, *place = parse_numbers(path, row, ("point", *_COLUMNS), f"row {number}", False)
        if point not in range(count):
            raise ValueError(f"{path}: row {number}: the target has no point {point:g}")
        if np.isfinite(points[int(point)]).any():
            raise ValueError(f"{path}: row {number}: point {point:g} has more than one row")
        points[int(point)] = place
    return points


def _points_from_array(path: Path) -> np.ndarray:
    """Return the array of a file of NumPy, or the vertices of a PLY file."""
    try:
        if path.suffix.lower() == ".ply":
            trimesh = import_extra("trimesh", "objects", "a PLY file")
            return np.array(trimesh.load(path, process=False).vertices, float)
        content = np.load(path, allow_pickle=False)
        if isinstance(content, np.ndarray):
            return content.astype(float)
        with content:
            if len(content.files) != 1:
                names = ", ".join(content.files) or "none"
                raise ValueError(f"expected one array, found {names}")
            return content[content.files[0]].astype(float)
    except ImportError:
        raise
    # A parser can raise any error for a broken file.
    except Exception as error:
        raise ValueError(f"{path}: no readable points: {error}") from error


def read_points_folder(described: DescribedFolder, options: LoadOptions) -> PoseDataset:
    """Read a folder with the points of a target that a depth sensor measured."""
    content = described.content
    with errors_at(described.path):
        target = read_target(described.folder, content["target"])
    readings, entry = read_robot_readings(described, options.bad_views), content["measured_points"]
    files = picture_files(described, entry["pattern"], readings.view_ids, target)
    _refuse_heights(target, described.path)
    count = len(target.points)
    points, reasons = _of_views(
        {view: paths[0] for view, paths in files.items()},
        lambda view, path: read_measured_points(path, count, entry["unit"]),
        count,
        readings.masked_views,
        options.bad_views,
    )
    mount = content.get("mount", "eye_in_hand")
    data = _measured(points, target, readings, mount, reasons, described.path)
    return dataclasses.replace(data, notes=readings.notes, pose_format=readings.pose_format)


def read_depth_pictures(
    data: Dataset, readings: RobotReadings, described: DescribedFolder, options: LoadOptions
) -> PoseDataset:
    """Read a folder's depth pictures at the target's points, detected in its other pictures."""
    entry = described.content["depth_pictures"]
    files = picture_files(described, entry["pattern"], readings.view_ids, data.target)
    camera = read_camera(described.folder / entry["camera"])
    _refuse_heights(data.target, described.path)
    pixels = dict(zip(data.view_ids, np.asarray(data.pixels), strict=True))

    def points_of(view: str, path: Path) -> Float[np.ndarray, "points 3"]:
        """Return the target's points in a depth picture."""
        depth = read_depth_picture(path, entry["unit"])
        with errors_at(path):
            return points_at_pixels(cloud_from_depth(depth, camera), pixels[view])

    points, reasons = _of_views(
        {view: paths[0] for view, paths in files.items()},
        points_of,
        pixels[data.view_ids[0]].shape[0],
        dict(data.masked_views),
        options.bad_views,
        options.progress,
    )
    measured = _measured(points, data.target, readings, data.mount, reasons, described.path)
    return dataclasses.replace(
        measured, notes=data.notes, pose_format=data.pose_format, camera=camera
    )


def _refuse_heights(target: AbstractTarget, description_path: Path) -> None:
    """Raise a ValueError for a board at several heights, because each view shows a single one."""
    if isinstance(target, StackedTarget):
        raise ValueError(
            f"{description_path}: target.heights: expected a target at one height for a depth "
            "sensor"
        )


def _of_views(
    files: Mapping[str, Path],
    points_of: Callable[[str, Path], Float[np.ndarray, "points 3"]],
    count: int,
    masked_views: Mapping[str, str],
    bad_views: str,
    progress: Callable[[str], None] | None = None,
) -> tuple[Float[np.ndarray, "views points 3"], dict[str, str]]:
    """Return the measured points of all views, and the reasons of views without any."""
    points, reasons = np.full((len(files), count, 3), np.nan), dict(masked_views)
    for number, (view, path) in enumerate(files.items()):
        if view in masked_views:
            continue
        if progress is not None:
            progress(f"depths of view {view} ({number + 1} of {len(files)})")
        try:
            points[number] = points_of(view, path)
        except (ValueError, FileNotFoundError) as error:
            if bad_views == "raise":
                raise
            reasons[view] = str(error)
    return points, reasons


def _measured(
    points: Float[np.ndarray, "views points 3"],
    target: AbstractTarget,
    readings: RobotReadings,
    mount: str,
    reasons: Mapping[str, str],
    description_path: Path,
) -> PoseDataset:
    """Return the data set of the target's poses; errors name the description."""
    with errors_at(description_path):
        return poses_from_points(points, target.points).dataset(
            readings.poses,
            mount,
            readings.view_ids,
            list(reasons.items()),
            readings.joints,
            readings.arm,
        )
