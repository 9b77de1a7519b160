"""Turn a bag into a data-set folder that every other function and command reads.

    images/            pictures without loss, one for each view
    poses.csv          the robot's pose for each view; or log.csv and times.csv, see `io.pose_log`
    joints.csv         joint readings, if they were asked for
    tracker.csv        poses of a tag, instead of pictures
    camera_info.yaml   the known camera, if the bag has it
    import.yaml        what was taken from where, what was left out and why, and the stamps
    dataset.yaml       the description

The folder is written whole or not at all.
"""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..argument_checks import errors_at
from ..export_text import OpenCVDistortion, camera_info_text
from ..files import folder_transaction, write_atomically
from ..geometry import as_se3
from ..io import (
    TRACKED_POSES_FILE,
    joints_entry,
    poses_entry,
    write_joints,
    write_pose_log,
    write_poses,
)
from ..targets import AbstractTarget
from .bag import Bag, open_bag
from .bag_content import BagSources, read_content
from .imported_folder import (
    POSE_FORMAT,
    ImportedFolder,
    TargetText,
    target_text,
    view_names,
    write_description,
)
from .moments import NANOSECONDS, MomentChoice, choose_moments, log_step, thinned
from .picture_messages import PictureFile, picture_file
from .transform_tree import stamp_of

CAMERA_FILE = "camera_info.yaml"
"""The name of the file with the known camera."""

_COUNTS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
"""Number of coefficients of ROS's lens models that are read."""


def import_bag(
    bag: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    sources: BagSources,
    target: AbstractTarget | str | Path | None = None,
    mount: str = "eye_in_hand",
    choice: MomentChoice | None = None,
    progress: Callable[[str], None] | None = None,
) -> ImportedFolder:
    """Write a data-set folder from a recording of ROS.

    Args:
        bag: a `.bag` file of ROS 1, a folder or `.db3` file of ROS 2, or an `.mcap` file.
        folder: the new folder, which must not exist yet or be empty.
        target: the target in the pictures; or its kind, such as `"charuco"`, whose lengths are
            then to be filled in; or a file, as in `target_text`. Not with poses of a tag.
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        choice: which pictures become views; by default `MomentChoice()`, one of every stop.
        progress: called with a line of text for each step of the work.

    Raises:
        FileNotFoundError: there is no such bag or file of a target.
        FileExistsError: the folder has files already.
        ValueError: something is missing or wrong in the bag; the message names the bag, what was
            expected, and what there is. Nothing is written.
        ImportError: `rosbags` is not installed.

    For example:

        >>> sources = sv.BagSources(image="/camera/image_raw", base="base_link", tool="tool0")
        >>> sv.import_bag("run.mcap", "my_folder", sources, "charuco")
        Traceback (most recent call last):
            ...
        FileNotFoundError: run.mcap: no such bag
    """
    choice = choice or MomentChoice()
    if (target is None) != (sources.tag is not None):
        raise ValueError("target: expected for pictures, and not with poses of a tag")
    text = None if target is None else target_text(target)
    with folder_transaction(folder) as temporary, open_bag(Path(bag)) as recording:
        written = _Import(recording, sources, mount, choice, text, progress).write(temporary)
    folder = Path(folder)
    camera = None if written.camera_file is None else folder / CAMERA_FILE
    return written._replace(folder=folder, camera_file=camera)


class _Import:
    """An import, whose steps share its options."""

    def __init__(
        self,
        bag: Bag,
        sources: BagSources,
        mount: str,
        choice: MomentChoice,
        target: TargetText | None,
        progress: Callable[[str], None] | None,
    ):
        self._bag, self._sources, self._mount = bag, sources, mount
        self._choice, self._target, self._progress = choice, target, progress

    def write(self, folder: Path) -> ImportedFolder:
        """Write everything to a folder."""
        content = read_content(self._bag, self._sources, self._progress)
        robot, notes = content.robot, list(content.notes)
        stamps = thinned(robot.stamps, log_step(self._choice))
        poses, at_moments = robot.at(stamps), robot.at(content.moments)
        known = np.isfinite(at_moments[:, 0, 3])
        with errors_at(self._bag.path):
            chosen = choose_moments(content.moments, known, stamps, poses, self._choice)
        notes += chosen.notes
        view_ids = view_names(len(chosen.indices))
        moments = content.moments[chosen.indices]
        entries: dict[str, Any] = {"mount": self._mount}
        camera = None
        if content.image is not None:
            named = dict(zip(moments.tolist(), view_ids, strict=True))
            until = int(content.received[chosen.indices].max()) + 1
            first = self._write_pictures(folder, content.image, named, until)
            entries["camera"] = {"image_size": list(first.size)}
            entries["pictures"] = {"pattern": f"images/{{view}}{first.suffix}"}
            if first.bits > 8:
                notes.append(f"pictures: {first.bits} bits, kept; detection stretches them to 8")
            if content.camera is not None:
                camera, note = camera_text(content.camera, first.size, _is_rectified(content.image))
                notes.append(note)
        if camera is not None:
            write_atomically(folder / CAMERA_FILE, camera)
        if content.tracked is not None:
            tracked = as_se3(content.tracked[chosen.indices])
            write_poses(folder, view_ids, tracked, POSE_FORMAT, TRACKED_POSES_FILE)
            entries["tracked_poses"] = {
                **poses_entry(len(view_ids), POSE_FORMAT),
                "file": TRACKED_POSES_FILE,
                "direction": "camera_from_world",
            }
        if robot.joints is not None:
            write_joints(folder, view_ids, robot.joints.at(moments), robot.joints.arm)
            entries["joints"] = joints_entry(len(view_ids), robot.joints.arm)
        if robot.chain is not None and self._choice.every is None:
            write_poses(folder, view_ids, as_se3(at_moments[chosen.indices]), POSE_FORMAT)
            entries["poses"] = poses_entry(len(view_ids), POSE_FORMAT)
        elif robot.chain is not None:
            # From the beginning of the log: since 1970 it is too many digits for a float.
            logged, wanted = ((times - stamps[0]) / NANOSECONDS for times in (stamps, moments))
            entries["poses"] = write_pose_log(
                folder, logged, as_se3(poses), view_ids, wanted, POSE_FORMAT
            )
        is_template = self._target is not None and self._target.is_template
        camera_file = None if camera is None else folder / CAMERA_FILE
        in_motion = robot.chain is not None and self._choice.every is not None
        imported = ImportedFolder(
            folder, view_ids, chosen.left_out, tuple(notes), camera_file, in_motion, is_template
        )
        imported.write_record(self._bag.path.name, moments)
        write_description(folder, entries, self._target)
        return imported

    def _write_pictures(
        self, folder: Path, topic: str, views: Mapping[int, str], until: int
    ) -> PictureFile:
        """Write the pictures of the views (by their time, ns), and return the first.

        All of them were recorded before the time `until`, ns.
        """
        first: PictureFile | None = None
        missing = dict(views)
        for message in self._bag.messages({topic}, "writing pictures of", self._progress, until):
            stamp = message.received if self._sources.received else stamp_of(message.content.header)
            # The first of equal stamps, as in the first pass.
            view = missing.pop(stamp, None)
            if view is None:
                continue
            try:
                first = picture_file(message.content).write(folder, view, first)
            except ValueError as error:
                where = f"topic {topic}: picture at {stamp / NANOSECONDS:.3f} s"
                raise ValueError(f"{self._bag.path}: {where}: {error}") from error
        if first is None or missing:
            raise ValueError(f"{self._bag.path}: topic {topic}: {len(missing)} pictures were lost")
        return first


def _is_rectified(topic: str) -> bool:
    """Return whether the pictures of a topic are rectified, by ROS's names of such topics."""
    return "rect" in topic.removesuffix("/compressed").rpartition("/")[2]


def camera_text(
    message: Any, image_size: tuple[int, int], rectified: bool
) -> tuple[str | None, str]:
    """Return the text of the camera's file, None if there is no calibrated camera, and a note.

    Rectified pictures have no distortion, and their numbers are in the projection matrix P.
    """
    K = np.asarray(message.k if hasattr(message, "k") else message.K, dtype=float).reshape(3, 3)
    P = np.asarray(message.p if hasattr(message, "p") else message.P, dtype=float).reshape(3, 4)
    D = np.asarray(message.d if hasattr(message, "d") else message.D, dtype=float)
    size = (int(message.width), int(message.height))
    matrix = P[:, :3] if rectified else K
    if not matrix[0, 0] > 0.0:
        return None, "camera_info: not calibrated (its focal length is 0)"
    if size != image_size:
        return None, (
            f"camera_info: for pictures of {size[0]} x {size[1]} px, but these have "
            f"{image_size[0]} x {image_size[1]}: not used"
        )
    model = str(message.distortion_model) or "plumb_bob"
    if rectified:
        lens: OpenCVDistortion | None = OpenCVDistortion("plumb_bob", (0.0,) * 5, 0.0)
    else:
        lens = _distortion(model, D)
    if lens is None:
        return None, f"camera_info: {model} with {len(D)} coefficients is not read: not used"
    numbers = {
        "image_size": size,
        "alpha_u": matrix[0, 0],
        "alpha_v": matrix[1, 1],
        "u0": matrix[0, 2],
        "v0": matrix[1, 2],
    }
    kind = "rectified, without distortion" if rectified else lens.model
    return camera_info_text(numbers, lens, "camera"), f"camera_info: {CAMERA_FILE} ({kind})"


def _distortion(model: str, coefficients: np.ndarray) -> OpenCVDistortion | None:
    """Return the lens with ROS's number of coefficients; None if there is no such lens."""
    if model not in _COUNTS:
        return None
    count = _COUNTS[model]
    # Some drivers state zeros of longer models, others nothing for a lens without distortion.
    if np.any(coefficients[count:]) or not np.all(np.isfinite(coefficients)):
        return None
    padded = np.zeros(count)
    padded[: min(count, len(coefficients))] = coefficients[:count]
    return OpenCVDistortion(model, tuple(padded.tolist()), 0.0)
