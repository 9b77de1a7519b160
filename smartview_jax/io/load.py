"""Load a data set from any kind of folder that the package can read, such as its own samples."""

import logging
import os
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

from ..dataset import Dataset
from ..detection import DetectionLimits
from ..files import require_folder
from ..geometry import PoseLike
from .dataset_folder import load_dataset_folder
from .folder_description import DESCRIPTION_FILE, DescribedFolder
from .folder_pictures import LoadOptions
from .pose_log import PoseLog, read_pose_log
from .robot_cal_tools import DATA_FILE, import_robot_cal_tools
from .robot_readings import suffix_in_names

_log = logging.getLogger(__name__)


SAMPLE_NAME = "rct_circle10x10"
"""The name of the folder of the sample data set."""

OBJECT_SAMPLE_NAME = "stepped_block"
"""The name of the folder of the object sample."""


def load_dataset(
    folder: str | os.PathLike[str],
    bad_views: str = "raise",
    progress: Callable[[str], None] | None = None,
    keep_detections: bool = True,
    holder_from_world: PoseLike | None = None,
    detection_limits: DetectionLimits | None = None,
) -> Dataset:
    """Load pictures (or detections), robot poses and target of a data-set folder.

    The format of a folder with a `dataset.yaml` is described in `io.dataset_folder`; a folder with
    a `cal_data.yaml` and a `target.yaml` is read as robot_cal_tools writes it. Detections are
    cached in the folder, and repeated when a picture or the target's description changes.

    Args:
        folder: of the data set.
        bad_views: treatment of a view with invalid values (an unreadable picture, a pose that is
            not rigid): `"raise"` an error that names it, or `"mask"` it with its reason. A picture
            in which the target is not found is always kept as a masked view.
        progress: called with a line of text for each step of the work.
        keep_detections: whether to write the detections to the folder, to be read the next time.
        holder_from_world: approximate pose of the target (`base_from_world`, or `tool_from_world`
            for a fixed camera), for patterns that look the same when rotated; by default the
            folder's own, or else the orientation with the smallest rotation.
        detection_limits: largest distance of a point from the position that the other points of
        its view predict, for detected points and for points from a file; by default
        `DetectionLimits()`.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: something is wrong; the message names the file and the view.

    For example:

        >>> sample = sv.load_dataset(sv.io.sample_folder(), keep_detections=False)
        >>> print(sample.view_count, sample.observation_count, sample.image_size)
        15 1500 (640, 480)
    """
    folder = Path(folder)
    require_folder(folder, "the folder of a data set")
    if (folder / DESCRIPTION_FILE).is_file():
        options = LoadOptions(bad_views, progress, keep_detections, detection_limits)
        data = load_dataset_folder(folder, options, holder_from_world)
    elif (folder / DATA_FILE).is_file():
        data = import_robot_cal_tools(
            folder, bad_views=bad_views, progress=progress, detection_limits=detection_limits
        )
    else:
        raise FileNotFoundError(
            f"{folder}: has neither {DESCRIPTION_FILE} nor {DATA_FILE}: "
            "not a data set in a known format"
        )
    points, masked = data.observation_count, len(data.masked_views)
    _log.info("%s: %d views, %d points, %d masked", folder, data.view_count, points, masked)
    return data


def load_pose_log(folder: str | os.PathLike[str]) -> PoseLog | None:
    """Read the pose log of a data-set folder; None if every view has its own pose.

    Raises:
        FileNotFoundError: a table is missing.
        ValueError: something is wrong in it; the message names the file and the row or view.
    """
    if not (Path(folder) / DESCRIPTION_FILE).is_file():
        return None
    described, description = DescribedFolder.of(folder).of_one_camera()
    if description.poses is None or description.poses.picture_times is None:
        return None
    log = read_pose_log(described.folder, described.content["poses"])
    suffix = suffix_in_names(described, log.view_ids)
    return log._replace(view_ids=tuple(view.removesuffix(suffix) for view in log.view_ids))


def sample_folder() -> Path:
    """Return the sample's folder: 15 pictures of a 10 x 10 circle grid by a camera on a robot."""
    return Path(str(files("smartview_jax") / "samples" / SAMPLE_NAME))


def object_sample_folder() -> Path:
    """Return the folder of the object sample: pictures of a board, and of a block with a step.

    The pictures are rendered (`simulation.write_object_example`). The folder itself is the data set
    that calibrates the rig (`load_dataset`), its folder `object` has the pictures of the object
    from five viewpoints (`load_object_views`), and `truth.json` the object's vertices and faces.
    """
    return Path(str(files("smartview_jax") / "samples" / OBJECT_SAMPLE_NAME))
