"""Read and write text files with one 4x4 pose matrix on each line, in row-major order."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Unpack

import numpy as np
from jaxlie import SE3

from ..argument_checks import errors_at
from ..dataset import Dataset
from ..files import write_atomically
from ..geometry import pose_codec
from ..targets import AbstractTarget
from .csv_tables import refuse_out_of_range
from .folder_pictures import ImportOptions, LoadOptions, numbered_pictures
from .picture_detections import ShownTarget
from .pictures import dataset_from_pictures
from .table_text import is_number, read_number_rows


def read_matrix_rows(
    path: str | Path, length_unit: str, progress: Callable[[str], None] | None = None
) -> SE3:
    """Read poses from a text file with one 4x4 matrix, in row-major order, on each line.

    Args:
        path: of the file; numbers are separated by blanks, tabs, commas or semicolons.
        length_unit: unit of the translations: m, cm or mm.
        progress: called with a line of text for what was recognised in the file.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: a line that is not a rigid transform, named by its number from 1.
    """
    path = Path(path)
    table = read_number_rows(path, 16)
    if table.seen and progress is not None:
        progress(f"{path.name} was read {'; '.join(table.seen)}")
    return _decoded(path, table.fields, [str(number) for number in table.lines], length_unit)


def _decoded(
    path: Path, fields: Sequence[Sequence[str]], names: Sequence[str], length_unit: str
) -> SE3:
    """Return the poses of the lines; raise a ValueError that names a line that is not a pose."""
    if not fields:
        raise ValueError(f"{path}: no poses")
    for name, row in zip(names, fields, strict=True):
        if not all(is_number(field) for field in row):
            raise ValueError(f"{path}: line {name} is not a row of numbers")
    with errors_at(path):
        rows = np.array([[float(field) for field in row] for row in fields])
        poses = pose_codec("matrix").decode(rows, length_unit, labels=names)
    refuse_out_of_range(path, np.asarray(poses.translation()), names)
    return poses


def write_matrix_rows(path: str | Path, poses: SE3, length_unit: str) -> None:
    """Write poses as a text file that `read_matrix_rows` reads, with every digit.

    Raises:
        ValueError: a value with which the file could not be read back; nothing is written.
    """
    rows = pose_codec("matrix").encode(poses, length_unit)
    fields = [[repr(float(number)) for number in row] for row in rows]
    _decoded(Path(path), fields, [str(k) for k in range(1, 1 + len(fields))], length_unit)
    write_atomically(path, "\n".join(" ".join(row) for row in fields) + "\n")


def import_matrix_rows(
    path: str | Path,
    length_unit: str,
    pictures: str,
    target: AbstractTarget,
    mount: str = "eye_in_hand",
    first: int = 0,
    **options: Unpack[ImportOptions],
) -> Dataset:
    """Import a data set from a file of pose matrices and pictures numbered by its lines.

    Args:
        path: of the file of base_from_tool, one pose on each line.
        length_unit: unit of the translations: m, cm or mm.
        pictures: pattern of the pictures' names, relative to the file's folder, with the number as
            in `str.format`, such as `"images/{view:03d}.png"`. There must be one picture for each
            line, and no others.
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        first: number of the first line's picture.
        options: `bad_views`, `progress` and `detection_limits`, as in `load_dataset`.

    Raises:
        FileNotFoundError: the file or a picture is missing.
        ValueError: a line that is not a rigid transform, or a picture without a line.
    """
    path = Path(path)
    poses = read_matrix_rows(path, length_unit, options.get("progress"))
    numbers = range(first, first + len(poses.wxyz_xyz))
    files = numbered_pictures(path.parent, pictures, numbers, path)
    return dataset_from_pictures(
        files,
        poses,
        ShownTarget(target, mount),
        options=LoadOptions(**options),
    )
