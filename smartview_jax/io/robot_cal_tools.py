"""Folders of robot_cal_tools and industrial_calibration: `cal_data.yaml`, poses, `target.yaml`."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..dataset import Dataset
from ..files import parse_yaml, read_text, read_yaml
from ..geometry import pose_codec
from ..targets import AbstractTarget, CircleGrid
from .pictures import from_pictures
from .tables import duplicates

DATA_FILE = "cal_data.yaml"
_POSE_KEYS = ("x", "y", "z", "qx", "qy", "qz", "qw")


def import_robot_cal_tools(
    folder: str | Path,
    mount: str = "eye_in_hand",
    bad_views: str = "raise",
    progress: Callable[[str], None] | None = None,
) -> Dataset:
    """A data set from a folder with a modified circle grid.

    A view is named by its picture's file, not by its place in `cal_data.yaml`, whose order is that
    of the alphabet (0, 1, 10, ...).

    Args:
        folder: with `cal_data.yaml`, `target.yaml`, and what they name.
        mount: where the camera is; the folder does not say.
        bad_views: as in `load_dataset`.
        progress: told what is being done.
    """
    folder = Path(folder)
    entries = _entries(folder / DATA_FILE)
    views = [Path(image).stem for image, _ in entries]
    rows = np.stack([_pose(folder / pose) for _, pose in entries])
    try:
        poses = pose_codec("quaternion_xyzw").decode(rows, labels=views)
    except ValueError as error:
        raise ValueError(f"{folder / DATA_FILE}: {error}") from error
    return from_pictures(
        {view: [folder / image] for view, (image, _) in zip(views, entries, strict=True)},
        poses,
        _target(folder / "target.yaml"),
        mount,
        bad_views=bad_views,
        progress=progress,
    )


def _entries(path: Path) -> list[tuple[str, str]]:
    """Return the files of picture and pose of every view, in the order of the pictures' names."""
    from ..schemas.imported import CAL_DATA
    from ..schemas.reading import checked

    entries = checked(parse_yaml(read_text(path), path), CAL_DATA, path)
    views = duplicates([Path(entry.image).stem for entry in entries])
    if views:
        raise ValueError(f"{path}: view {', '.join(views)} has more than one entry")
    # Names that are numbers in the order of numbers, whatever the list's own order.
    return sorted(
        ((entry.image, entry.pose) for entry in entries),
        key=lambda files: (len(Path(files[0]).stem), files[0]),
    )


def _pose(path: Path) -> np.ndarray:
    from ..schemas.imported import POSE
    from ..schemas.reading import checked

    pose = checked(read_yaml(path), POSE, path)
    return np.array([getattr(pose, key) for key in _POSE_KEYS])


def _target(path: Path) -> AbstractTarget:
    from ..schemas.imported import TARGET
    from ..schemas.reading import checked

    finder = checked(read_yaml(path), TARGET, path).target_finder
    if "ModifiedCircleGrid" not in finder.type:
        raise ValueError(f"{path}: expected a modified circle grid, found {finder.type!r}")
    return CircleGrid(finder.rows, finder.cols, finder.spacing, origin_mark=True)
