"""Read the pictures and poses of a data-set folder without looking for a target in them."""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..files import read_yaml
from ..geometry import host_matrices
from ..robots import Command
from .folder_description import DESCRIPTION_FILE, without_nulls
from .folder_pictures import picture_files, read_board_heights
from .robot_readings import read_robot_readings, table_of_views
from .target_file import read_target


class ViewPictures(NamedTuple):
    """Pictures with the robot's poses.

    Attributes:
        view_ids: names of the views.
        pictures: a file for each view.
        command: reported pose of each view, with joint readings if the folder has them.
        notes: sentences on what was recognised in the tables.
    """

    view_ids: list[str]
    pictures: list[Path]
    command: Command
    notes: tuple[str, ...] = ()

    @property
    def base_from_tool(self) -> Float[np.ndarray, "views 4 4"]:
        """The reported poses."""
        return host_matrices(self.command.base_from_tool)


def load_view_pictures(folder: str | os.PathLike[str]) -> ViewPictures:
    """Read the picture files and the reported poses of a data-set folder.

    The folder has a `dataset.yaml` as for `load_dataset`; the pictures need not show its target.

    Raises:
        FileNotFoundError: the folder or its description is missing.
        ValueError: the description is wrong or names no pictures, or a pose is not valid.
    """
    from ..schemas.dataset import DATASET_SCHEMA
    from ..schemas.validation import validate_content

    folder = Path(folder)
    path = folder / DESCRIPTION_FILE
    raw = read_yaml(path)
    validate_content(raw, DATASET_SCHEMA, path)
    content = without_nulls(raw)
    if "pictures" not in content:
        raise ValueError(
            f"{path}: entry 'pictures' is missing: a model needs pictures of the object"
        )
    readings = read_robot_readings(folder, content, path, "raise")
    table = table_of_views(folder, content)
    readings.refuse_masked(table)
    target = read_target(folder, content["target"])
    # A board at several heights has several pictures in a view; the first one is taken.
    heights = read_board_heights(readings.table, target, readings.view_ids, readings.name_suffix)
    files = picture_files(
        folder, content["pictures"], readings.view_ids, target, table, path, heights
    )
    return ViewPictures(
        list(readings.view_ids),
        [files[view][0] for view in readings.view_ids],
        readings.command,
        readings.notes,
    )
