"""Turn a bag into a data-set folder that every other function and command reads.

    images/            pictures without loss, one for each view; of several cameras, a folder each
    poses.csv          the robot's pose for each view; or log.csv and times.csv, see `io.pose_log`
    joints.csv         joint readings, if they were asked for
    tracker.csv        poses of a tag, instead of pictures
    camera_info.yaml   the known camera, if the bag has it; of several, known_cameras/NAME.yaml
    import.yaml        what was taken from where, what was left out and why, and the stamps
    dataset.yaml       the description

The folder is written whole or not at all.
"""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Int64

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
from .bag_content import BagContent, Measurements, read_content
from .bag_sources import BagSources
from .camera_names import ONE_CAMERA
from .imported_folder import (
    POSE_FORMAT,
    ImportedFolder,
    TargetText,
    picture_entries,
    target_text,
    view_names,
    write_description,
)
from .moments import NANOSECONDS, Chosen, MomentChoice, choose_moments, log_step, thinned
from .picture_messages import COMPRESSED, IMAGE, PictureFile, picture_file
from .transform_tree import stamp_of

CAMERA_FILE = "camera_info.yaml"
"""The name of the file with the known camera."""

CAMERAS_FOLDER = "known_cameras"
"""The name of the folder with a file for each known camera of several."""

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
        choice: which pictures become views; by default `MomentChoice()`, one of every stop. Of
            several cameras it has to be one of every stop, because each takes its pictures at times
            of its own.
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
    if len(sources.images) > 1 and choice.every is not None:
        raise ValueError(
            "every: several cameras take their pictures at different times, so that a pose in "
            "motion is not common to them: expected one picture of every stop"
        )
    if (target is None) != (sources.tag is not None):
        raise ValueError("target: expected for pictures, and not with poses of a tag")
    text = None if target is None else target_text(target)
    with folder_transaction(folder) as temporary, open_bag(Path(bag)) as recording:
        written = _Import(recording, sources, mount, choice, text, progress).write(temporary)
    camera = written.camera_file
    camera = None if camera is None else Path(folder) / camera.name
    return written._replace(folder=Path(folder), camera_file=camera)


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
        robot = content.robot
        stamps = thinned(robot.stamps, log_step(self._choice))
        poses = robot.at(stamps)
        views = self._views(content, stamps, poses)
        notes = [*content.notes, *views.notes]
        entries: dict[str, Any] = {"mount": self._mount}
        camera_file = None
        if self._sources.tag is None:
            first = self._write_pictures(folder, content.cameras, views)
            camera_file = self._write_cameras(folder, content.cameras, first, notes)
            ordered = {name: first[name] for name in self._sources.images}
            entries |= picture_entries(self._bag.path, ordered, notes)
        else:
            tracked = content.cameras[ONE_CAMERA].tracked
            assert tracked is not None
            chosen = as_se3(tracked[views.chosen[ONE_CAMERA].indices])
            write_poses(folder, views.names, chosen, POSE_FORMAT, TRACKED_POSES_FILE)
            entries["tracked_poses"] = {
                **poses_entry(len(views.names), POSE_FORMAT),
                "file": TRACKED_POSES_FILE,
                "direction": "camera_from_world",
            }
        if robot.joints is not None:
            readings = robot.joints.at(views.moments)
            write_joints(folder, views.names, readings, robot.joints.arm)
            entries["joints"] = joints_entry(len(views.names), robot.joints.arm)
        in_motion = robot.chain is not None and self._choice.every is not None
        if in_motion:
            # From the beginning of the log: since 1970 it is too many digits for a float.
            logged, wanted = ((t - stamps[0]) / NANOSECONDS for t in (stamps, views.moments))
            entries["poses"] = write_pose_log(
                folder, logged, as_se3(poses), views.names, wanted, POSE_FORMAT
            )
        elif robot.chain is not None:
            write_poses(folder, views.names, as_se3(robot.at(views.moments)), POSE_FORMAT)
            entries["poses"] = poses_entry(len(views.names), POSE_FORMAT)
        is_template = self._target is not None and self._target.is_template
        imported = ImportedFolder(
            folder, views.names, views.left_out, tuple(notes), camera_file, in_motion, is_template
        )
        imported.write_record(self._bag.path.name, views.stamps(content.cameras))
        write_description(folder, entries, self._target)
        return imported

    def _views(
        self,
        content: BagContent,
        stamps: Int64[np.ndarray, "logged"],
        poses: Float[np.ndarray, "logged 4 4"],
    ) -> "_Views":
        """Choose the views among the pictures of all cameras; a stop is one view of all."""
        chosen: dict[str, Chosen] = {}
        for name, camera in content.cameras.items():
            known = np.isfinite(content.robot.at(camera.stamps)[:, 0, 3])
            where = f"{self._bag.path}: camera {name}" if name else self._bag.path
            with errors_at(where):
                chosen[name] = choose_moments(camera.stamps, known, stamps, poses, self._choice)
        stops, first = np.unique(
            np.concatenate([part.stops for part in chosen.values()]), return_index=True
        )
        moments = np.concatenate(
            [content.cameras[name].stamps[part.indices] for name, part in chosen.items()]
        )
        return _Views(chosen, stops, view_names(len(stops)), moments[first])

    def _write_pictures(
        self, folder: Path, cameras: Mapping[str, Measurements], views: "_Views"
    ) -> dict[str, PictureFile]:
        """Write the chosen pictures in the order of recording, and return each camera's first.

        Raises:
            ValueError: a picture is not readable, or differs in size or kind from the camera's
                first.
        """
        names = {camera.topic: name for name, camera in cameras.items() if camera.topic is not None}
        missing = {name: views.by_stamp(name, cameras[name]) for name in cameras}
        first: dict[str, PictureFile] = {}
        # Before it, all of them were recorded.
        until = 1 + max(
            int(camera.received[views.chosen[name].indices].max())
            for name, camera in cameras.items()
        )
        # The files of all cameras have one suffix, and only compressed pictures may be JPEGs.
        as_png = {self._bag.kinds[topic] for topic in names} == {IMAGE, COMPRESSED}
        for message in self._bag.messages(names, "writing pictures of", self._progress, until):
            name = names[message.topic]
            stamp = message.received if self._sources.received else stamp_of(message.content.header)
            # The first of equal stamps, as in the first pass.
            view = missing[name].pop(stamp, None)
            if view is None:
                continue
            try:
                picture = picture_file(message.content)
                picture = picture.as_png() if as_png else picture
                path = Path(name) / view
                first[name] = picture.write(folder, path.as_posix(), first.get(name))
            except ValueError as error:
                where = f"topic {message.topic}: picture at {stamp / NANOSECONDS:.3f} s"
                raise ValueError(f"{self._bag.path}: {where}: {error}") from error
        for topic, name in names.items():
            if missing[name] or name not in first:
                lost = len(missing[name])
                raise ValueError(f"{self._bag.path}: topic {topic}: {lost} pictures were lost")
        return first

    def _write_cameras(
        self,
        folder: Path,
        cameras: Mapping[str, Measurements],
        first: Mapping[str, PictureFile],
        notes: list[str],
    ) -> Path | None:
        """Write the known cameras, and return their file, or their folder if there are several."""
        path = None
        for name, camera in cameras.items():
            if camera.camera_info is None:
                continue
            rectified = _is_rectified(str(camera.topic))
            text, note = camera_text(camera.camera_info, first[name].size, rectified)
            file = Path(CAMERAS_FOLDER) / f"{name}.yaml" if name else Path(CAMERA_FILE)
            result = note if text is None else f"{file} ({note})"
            notes.append(f"camera_info{f' of {name}' if name else ''}: {result}")
            if text is not None:
                write_atomically(folder / file, text)
                path = folder / file.parts[0]
        return path


class _Views(NamedTuple):
    """The views of an import: a stop of the robot, or a moment of its motion, is one.

    Attributes:
        chosen: what was chosen of each camera.
        stops: number of the stop that each view is, increasing.
        names: of the views.
        moments: time of each view, ns: of the picture by the first camera that has one.
    """

    chosen: dict[str, Chosen]
    stops: Int[np.ndarray, "views"]
    names: tuple[str, ...]
    moments: Int64[np.ndarray, "views"]

    @property
    def left_out(self) -> dict[str, int]:
        """Number of pictures that are no views, by camera and reason."""
        return {
            f"{name}: {reason}" if name else reason: count
            for name, part in self.chosen.items()
            for reason, count in part.left_out.items()
        }

    @property
    def notes(self) -> list[str]:
        """Sentences on what was found while choosing."""
        return [
            f"{name}: {note}" if name else note
            for name, part in self.chosen.items()
            for note in part.notes
        ]

    def by_stamp(self, name: str, camera: Measurements) -> dict[int, str]:
        """Return the names of a camera's views by the stamps of their pictures, ns."""
        part = self.chosen[name]
        numbers = np.searchsorted(self.stops, part.stops).tolist()
        stamps = camera.stamps[part.indices].tolist()
        return {stamp: self.names[k] for stamp, k in zip(stamps, numbers, strict=True)}

    def stamps(self, cameras: Mapping[str, Measurements]) -> dict[str, Any]:
        """Return the stamp of every view, ns; of several cameras by the camera's name."""
        of_cameras = {
            name: {view: stamp for stamp, view in self.by_stamp(name, camera).items()}
            for name, camera in cameras.items()
        }
        return of_cameras.get(ONE_CAMERA, of_cameras)


def _is_rectified(topic: str) -> bool:
    """Return whether the pictures of a topic are rectified, by ROS's names of such topics."""
    return "rect" in topic.removesuffix("/compressed").rpartition("/")[2]


def camera_text(
    message: Any, image_size: tuple[int, int], rectified: bool
) -> tuple[str | None, str]:
    """Return the text of a camera's file, None if there is no calibrated camera, and its kind.

    Without a camera there is the reason in the place of the kind.

    Rectified pictures have no distortion, and their numbers are in the projection matrix P.
    """
    K = np.asarray(message.k if hasattr(message, "k") else message.K, dtype=float).reshape(3, 3)
    P = np.asarray(message.p if hasattr(message, "p") else message.P, dtype=float).reshape(3, 4)
    D = np.asarray(message.d if hasattr(message, "d") else message.D, dtype=float)
    size = (int(message.width), int(message.height))
    matrix = P[:, :3] if rectified else K
    if not matrix[0, 0] > 0.0:
        return None, "not calibrated (its focal length is 0)"
    if size != image_size:
        return None, (
            f"for pictures of {size[0]} x {size[1]} px, but these have "
            f"{image_size[0]} x {image_size[1]}: not used"
        )
    model = str(message.distortion_model) or "plumb_bob"
    if rectified:
        lens: OpenCVDistortion | None = OpenCVDistortion("plumb_bob", (0.0,) * 5, 0.0)
    else:
        lens = _distortion(model, D)
    if lens is None:
        return None, f"{model} with {len(D)} coefficients is not read: not used"
    numbers = {
        "image_size": size,
        "alpha_u": matrix[0, 0],
        "alpha_v": matrix[1, 1],
        "u0": matrix[0, 2],
        "v0": matrix[1, 2],
    }
    kind = "rectified, without distortion" if rectified else lens.model
    return camera_info_text(numbers, lens, "camera"), kind


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
