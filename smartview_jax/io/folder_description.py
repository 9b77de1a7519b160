"""Read the description of a data-set folder before it has any pictures."""

from pathlib import Path
from typing import NamedTuple

from jaxlie import SE3

from ..files import read_yaml
from ..targets import AbstractTarget
from .dataset_folder import DESCRIPTION_FILE
from .rough_pose import rough_pose
from .target_file import read_target


class FolderDescription(NamedTuple):
    """The description of a data set whose pictures may not have been taken yet.

    Attributes:
        target: the target.
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        image_size: width and height of the pictures, px.
        holder_from_world: rough pose of the target; None if the file does not state it.
    """

    target: AbstractTarget
    mount: str
    image_size: tuple[int, int]
    holder_from_world: SE3 | None


def read_folder_description(folder: str | Path) -> FolderDescription:
    """Read target, mount and picture size from a folder that `smartview new` began.

    Raises:
        FileNotFoundError: the folder has no `dataset.yaml`.
        ValueError: a wrong entry; the message names it and the file.
    """
    from ..schemas.dataset import DATASET_SCHEMA
    from ..schemas.validation import validate_content

    path = Path(folder) / DESCRIPTION_FILE
    content = read_yaml(path)
    description = validate_content(content, DATASET_SCHEMA, path)
    if description.camera is None:
        form = "tracked_poses" if description.target is None else "measured_points"
        raise ValueError(f"{path}: {form}: expected a data set with pictures of a target")
    width, height = description.camera.image_size
    try:
        target = read_target(Path(folder), content["target"])
        pose = rough_pose(description)
    except ValueError as error:
        # Both read parts of the file and do not know its name.
        raise ValueError(f"{path}: {error}") from error
    return FolderDescription(target, description.mount, (width, height), pose)
