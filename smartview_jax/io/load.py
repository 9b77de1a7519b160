"""One door for every kind of data set on disk."""

import os
from collections.abc import Callable
from pathlib import Path

from ..dataset import Dataset
from ..geometry import PoseLike
from .dataset_folder import DESCRIPTION, load_folder
from .robot_cal_tools import DATA_FILE, import_robot_cal_tools


def load_dataset(
    folder: str | os.PathLike[str],
    bad_views: str = "raise",
    progress: Callable[[str], None] | None = None,
    keep_detections: bool = True,
    holder_from_world: PoseLike | None = None,
) -> Dataset:
    """Pictures, or detections, with the robot's poses and the target, from a folder.

    A folder with a `dataset.yaml` is read as described in `io.dataset_folder`, one with a
    `cal_data.yaml` and a `target.yaml` as robot_cal_tools writes them. Detections are kept beside
    the pictures and made anew when a picture or the target's description changes.

    Args:
        folder: where the data set is.
        bad_views: what to do about a view with wrong values (an unreadable picture, a pose that is
            not rigid): `"raise"` an error that names it, or `"mask"` it with its reason. A picture
            in which the target is not found is always kept as a masked view.
        progress: told what is being done.
        keep_detections: write what was detected beside the pictures, to be read the next time.
        holder_from_world: where the target stands, roughly (`base_from_world`, or for a camera that
            stands beside the arm `tool_from_world`), for patterns that look the same when turned;
            by default as the folder says, or else the way round that is turned least.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: something is wrong; the message names the file and the view.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder")
    if (folder / DESCRIPTION).is_file():
        return load_folder(folder, bad_views, progress, keep_detections, holder_from_world)
    if (folder / DATA_FILE).is_file():
        return import_robot_cal_tools(folder, bad_views=bad_views, progress=progress)
    raise FileNotFoundError(
        f"{folder}: neither {DESCRIPTION} nor {DATA_FILE} here: not a data set this library knows"
    )
