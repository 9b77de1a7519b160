"""Read the pictures and poses of a data-set folder without looking for a target in them."""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..geometry import host_matrices
from ..robots import Command
from .dataset_folder import camera_pictures
from .folder_description import DescribedFolder, described_camera
from .object_views import OBJECT_VIEWS_FILE
from .robot_readings import read_sound_readings


class ViewPictures(NamedTuple):
    """Pictures with the robot's poses.

    Attributes:
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
    described, description = DescribedFolder.of(folder).of_one_camera(
        f"; {OBJECT_VIEWS_FILE} describes pictures of an object by several cameras"
    )
    if description.pictures is None:
        raise ValueError(
            f"{described.path}: entry 'pictures' is missing: a model needs pictures of the object"
        )
    readings = read_sound_readings(described)
    camera = described_camera(described, description)
    # A board at several heights has several pictures in a view; the first one is taken.
    files = camera_pictures(camera, readings, described, description.pictures.pattern)
    return ViewPictures(
        list(readings.view_ids),
        [files[view][0] for view in readings.view_ids],
        readings.command,
        readings.notes,
    )
