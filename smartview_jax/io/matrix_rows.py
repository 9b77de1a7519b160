"""Text files with one 4x4 matrix a line, row by row."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxlie import SE3

from ..dataset import Dataset
from ..files import read_text, write_atomically
from ..geometry import pose_codec
from ..targets import AbstractTarget
from .pictures import from_pictures, numbered_pictures
from .tables import is_number, refuse_far


def read_matrix_rows(path: str | Path, length_unit: str) -> SE3:
    """Poses from a text file with one 4x4 matrix, row by row, on every line.

    Args:
        path: of the file; numbers are parted by blanks, tabs or commas.
        length_unit: of the translations: m, cm or mm.

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
    refuse_far(path, np.asarray(poses.translation()), names)
    return poses


def write_matrix_rows(path: str | Path, poses: SE3, length_unit: str) -> None:
    """The inverse of `read_matrix_rows`."""
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
) -> Dataset:
    """A data set from such a file and pictures that carry their line's number.

    Args:
        path: base_from_tool, one a line.
        length_unit: of the translations: m, cm or mm.
        pictures: name of a picture beside the file, with its number as `str.format` has it, such
            as `"images/{view:03d}.png"`. There must be one a line, and no others.
        target: what the pictures show.
        mount: where the camera is.
        first: number of the first line's picture.
        bad_views: as in `load_dataset`.
        progress: told what is being done.

    Raises:
        FileNotFoundError: the file or a picture is missing.
        ValueError: a line that is no transform, or a picture without a line.
    """
    path = Path(path)
    poses = read_matrix_rows(path, length_unit)
    numbers = range(first, first + len(poses.wxyz_xyz))
    files = numbered_pictures(path.parent, pictures, numbers, path)
    return from_pictures(files, poses, target, mount, bad_views=bad_views, progress=progress)
