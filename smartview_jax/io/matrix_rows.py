"""Read and write text files with one 4x4 pose matrix on each line, in row-major order."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxlie import SE3

from ..dataset import Dataset
from ..detection import DetectionLimits
from ..files import read_text, write_atomically
from ..geometry import pose_codec
from ..targets import AbstractTarget
from .csv_tables import is_number, refuse_out_of_range
from .pictures import dataset_from_pictures, numbered_pictures


def read_matrix_rows(path: str | Path, length_unit: str) -> SE3:
    """Read poses from a text file with one 4x4 matrix, in row-major order, on each line.

    Args:
        path: of the file; numbers are separated by blanks, tabs, commas or semicolons.
        length_unit: unit of the translations: m, cm or mm.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: a line that is not a rigid transform, named by its number from 1.
    """
    path = Path(path)
    lines = read_text(path).splitlines()
    rows, names = [], []
    for number, line in enumerate(lines, start=1):
        fields = re.split(r"[\s,;]+", line.split("#")[0].strip())
        if fields == [""]:
            continue
        if not all(is_number(field) for field in fields):
            raise ValueError(f"{path}: line {number} is not a row of numbers")
        rows.append([float(field) for field in fields])
        if len(rows[-1]) != 16:
            raise ValueError(f"{path}: line {number} has {len(rows[-1])} numbers, not 16")
        names.append(str(number))
    if not rows:
        raise ValueError(f"{path}: no poses")
    try:
        poses = pose_codec("matrix").decode(np.array(rows), length_unit, labels=names)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    refuse_out_of_range(path, np.asarray(poses.translation()), names)
    return poses


def write_matrix_rows(path: str | Path, poses: SE3, length_unit: str) -> None:
    """Write poses as a text file that `read_matrix_rows` reads, with every digit."""
    rows = pose_codec("matrix").encode(poses, length_unit)
    lines = [" ".join(repr(float(number)) for number in row) for row in rows]
    write_atomically(path, "\n".join(lines) + "\n")


def import_matrix_rows(
    path: str | Path,
    length_unit: str,
    pictures: str,
    target: AbstractTarget,
    mount: str = "eye_in_hand",
    first: int = 0,
    bad_views: str = "raise",
    progress: Callable[[str], None] | None = None,
    detection_limits: DetectionLimits | None = None,
) -> Dataset:
    """Import a data set from a file of pose matrices and pictures numbered by its lines.

    Args:
        path: of the file of base_from_tool, one pose on each line.
        length_unit: unit of the translations: m, cm or mm.
        pictures: pattern of the pictures' names, relative to the file's folder, with the number as
            in `str.format`, such as `"images/{view:03d}.png"`. There must be one picture for each
            line, and no others.
        target: the calibration target in the pictures.
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        first: number of the first line's picture.
        bad_views: as in `load_dataset`.
        progress: called with a line of text for each step of the work.
        detection_limits: as in `load_dataset`.

    Raises:
        FileNotFoundError: the file or a picture is missing.
        ValueError: a line that is not a rigid transform, or a picture without a line.
    """
    path = Path(path)
    poses = read_matrix_rows(path, length_unit)
    numbers = range(first, first + len(poses.wxyz_xyz))
    files = numbered_pictures(path.parent, pictures, numbers, path)
    return dataset_from_pictures(
        files,
        poses,
        target,
        mount,
        bad_views=bad_views,
        progress=progress,
        detection_limits=detection_limits,
    )
