"""Turn a data set of LeRobot into a data-set folder that every other function and command reads.

The folder has the files of an imported bag (`import_bag`), with pictures in PNG or as they are.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..argument_checks import errors_at
from ..files import folder_transaction
from ..geometry import ANGLE_UNITS, as_se3, host_matrices, pose_codec
from ..io import joints_entry, poses_entry, write_joints, write_poses
from ..robots import SerialArm
from ..targets import AbstractTarget
from .camera_names import ONE_CAMERA, by_camera, check_cameras
from .imported_folder import (
    POSE_FORMAT,
    ImportedFolder,
    TargetText,
    picture_entries,
    target_text,
    view_names,
    write_description,
)
from .lerobot_dataset import Frames, LeRobotDataset
from .moments import MomentChoice, choose_moments
from .picture_messages import PictureFile, checked_file, png_of

STATE = "observation.state"
"""The feature that usually has the robot's state."""

MAX_RADIANS = 4.0 * np.pi
"""Largest joint reading that is believed in radians: no joint turns twice."""


MAX_STEPS = 4095
"""Largest number of steps between the ends of a joint's motion: the encoders have 12 bits."""

MIN_STEPS = 100
"""Smallest number of steps that is looked for: a joint that moves by 9 degrees."""

STEP_TOLERANCE = 2e-4
"""Largest distance from a whole step: readings in float32 are rounded by 0.8e-4 of a step."""

MIN_READINGS = 4
"""Smallest number of different readings that tell: by chance so many fit some N in 1e-10 cases."""

MAX_READINGS = 200
"""Largest number of different readings that are looked at, evenly spread."""

DECIMALS = 3
"""Readings with so few decimals were rounded: their steps are of the decimals."""


@dataclasses.dataclass(frozen=True)
class LeRobotSources:
    """Features of a data set of LeRobot, by their meaning.

    The description of a data set does not tell units. Joint readings that were recorded in percent
    of each joint's range (-100 to 100, the default of some arms) are no angles, and refused where
    their steps show it.

    Attributes:
        image: feature of the pictures; None for the only one. Of several cameras: the feature of
            each, by the camera's name.
        state: feature of the robot's state.
        names: names of the numbers used, in the order of the arm's joints or of the pose format;
            by default all numbers of the state.
        arm: arm whose joint readings the state has; None if it has poses.
        angle_unit: of joint readings, `"deg"` or `"rad"`; of poses, None for the format's own.
        pose_format: format of the poses `base_from_tool`, such as `"quaternion_xyzw"`; None for
            joint readings.
        episodes: numbers of the episodes used; all of them if empty.

    Raises:
        ValueError: both an arm and a pose format, or neither; joint readings without a unit; names
            or features of several cameras that cannot be told apart.

    For example:

        >>> sources = sv.LeRobotSources(pose_format="quaternion_xyzw", episodes=(0,))
        >>> print(sources.state, sources.image)
        observation.state None
    """

    image: str | Mapping[str, str] | None = None
    state: str = STATE
    names: tuple[str, ...] = ()
    arm: SerialArm | None = None
    angle_unit: str | None = None
    pose_format: str | None = None
    episodes: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Refuse contradictions, and units that nobody stated."""
        if (self.arm is None) == (self.pose_format is None):
            raise ValueError(
                "the robot's state: expected an arm, for joint readings, or the format of its poses"
            )
        if self.arm is not None and self.angle_unit is None:
            raise ValueError(
                "angle_unit: expected deg or rad; the data set does not tell in which its joint "
                "readings are"
            )
        if self.angle_unit is not None and self.angle_unit not in ANGLE_UNITS:
            units = " or ".join(ANGLE_UNITS)
            raise ValueError(f"angle_unit: expected {units}, found {self.angle_unit!r}")
        if self.pose_format is not None:
            pose_codec(self.pose_format)
        check_cameras(self.image, "feature")

    @property
    def images(self) -> dict[str, str | None]:
        """The feature of each camera's pictures; one camera has the name `ONE_CAMERA`."""
        return by_camera(self.image)


def import_lerobot(
    dataset: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    sources: LeRobotSources,
    target: AbstractTarget | str | Path,
    mount: str = "eye_in_hand",
    choice: MomentChoice | None = None,
    progress: Callable[[str], None] | None = None,
) -> ImportedFolder:
    """Write a data-set folder from a data set of LeRobot.

    Args:
        dataset: folder with `meta/info.json`, of version 2.0, 2.1 or 3.0.
        folder: the new folder, which must not exist yet or be empty.
        target: the target in the pictures, or its kind, or a file, as for `import_bag`.
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        choice: which pictures become views; by default `MomentChoice()`, one of every stop.
        progress: called with a line of text for each step of the work.

    Raises:
        FileNotFoundError: there is no such data set, or a file of it is missing.
        FileExistsError: the folder has files already.
        ValueError: something is missing or wrong in the data set; the message names the file, what
            was expected, and what there is. Nothing is written.
        ImportError: `pyarrow`, or `av` for videos, is not installed.

    For example:

        >>> sources = sv.LeRobotSources(pose_format="quaternion_xyzw")
        >>> sv.import_lerobot("my_recordings", "my_folder", sources, "charuco")
        Traceback (most recent call last):
            ...
        FileNotFoundError: my_recordings: no data set of LeRobot: meta/info.json is missing
    """
    choice = choice or MomentChoice()
    recording, text = LeRobotDataset(Path(dataset)), target_text(target)
    with folder_transaction(folder) as temporary:
        written = _write(temporary, recording, sources, mount, choice, text, progress)
    return written._replace(folder=Path(folder))


def _write(
    folder: Path,
    recording: LeRobotDataset,
    sources: LeRobotSources,
    mount: str,
    choice: MomentChoice,
    target: TargetText,
    progress: Callable[[str], None] | None,
) -> ImportedFolder:
    report = progress or (lambda _: None)
    features = {name: recording.image_feature(feature) for name, feature in sources.images.items()}
    numbers = _columns_of_state(recording, sources)
    report("reading the robot's states")
    frames = recording.frames(sources.state, sources.episodes)
    if frames.states.ndim != 2 or frames.states.shape[1] <= max(numbers):
        raise ValueError(
            f"{recording.path}: {sources.state}: expected rows of {len(numbers)} numbers or more, "
            f"found shape {frames.states.shape}"
        )
    readings, poses = _poses(recording, sources, frames.states[:, numbers])
    known = np.isfinite(poses[:, 0, 3])
    with errors_at(recording.path):
        chosen = choose_moments(frames.stamps, known, frames.stamps, poses, choice)
    view_ids = view_names(len(chosen.indices))
    pictures = ", ".join(f"{name} {feature}".lstrip() for name, feature in features.items())
    notes = [f"pictures: {pictures}; states: {sources.state}", *chosen.notes]
    if choice.every is not None:
        notes.append("pictures in motion have wrong poses where the camera is late")
    # All cameras have a picture at every time of the robot's states.
    dtypes = {recording.features[feature]["dtype"] for feature in features.values()}
    views = _Views(frames, chosen.indices, as_png=len(dtypes) > 1)
    first = {
        name: _write_pictures(folder, recording, name, feature, views, report)
        for name, feature in features.items()
    }
    entries: dict[str, Any] = {
        "mount": mount,
        **picture_entries(recording.path, first, notes),
        "poses": poses_entry(len(view_ids), POSE_FORMAT),
    }
    write_poses(folder, view_ids, as_se3(poses[chosen.indices]), POSE_FORMAT)
    if sources.arm is not None:
        write_joints(folder, view_ids, readings[chosen.indices], sources.arm)
        entries["joints"] = joints_entry(len(view_ids), sources.arm)
    imported = ImportedFolder(
        folder, view_ids, chosen.left_out, tuple(notes), None, False, target.is_template
    )
    stamps = dict(zip(view_ids, frames.stamps[chosen.indices].tolist(), strict=True))
    by_name = stamps if ONE_CAMERA in features else {name: dict(stamps) for name in features}
    imported.write_record(recording.path.resolve().name, by_name)
    write_description(folder, entries, target)
    return imported


def _columns_of_state(recording: LeRobotDataset, sources: LeRobotSources) -> list[int]:
    """Return which numbers of the state are used, in the order of the joints or of the pose."""
    present = recording.names(sources.state)
    arm, expected = sources.arm, ()
    if sources.pose_format is not None:
        expected = pose_codec(sources.pose_format).columns
    count = len(expected) if arm is None else len(arm.prismatic)
    meaning = f"numbers of a pose ({', '.join(expected)})" if arm is None else "joints"
    if sources.names:
        if unknown := [name for name in sources.names if name not in present]:
            raise ValueError(
                f"{recording.path}: {sources.state}: no number is called {unknown[0]!r}; there are "
                f"{', '.join(present) or 'no names'}"
            )
        numbers = [present.index(name) for name in sources.names]
    else:
        shape = recording.features[sources.state].get("shape") or [0]
        numbers = list(range(int(shape[0])))
    if len(numbers) != count:
        listed = ", ".join(sources.names or present) or f"{len(numbers)} without names"
        raise ValueError(
            f"{recording.path}: {sources.state}: expected {count} {meaning}, found {listed}; name "
            "those to use"
        )
    return numbers


def _poses(
    recording: LeRobotDataset, sources: LeRobotSources, rows: Float[np.ndarray, "frames numbers"]
) -> tuple[Float[np.ndarray, "frames numbers"], Float[np.ndarray, "frames 4 4"]]:
    """Return joint readings (rad, m) and poses `base_from_tool`, NaN where they are not known."""
    known = np.isfinite(rows).all(axis=1)
    if not known.any():
        raise ValueError(f"{recording.path}: {sources.state}: expected numbers, found NaN alone")
    poses = np.full((len(rows), 4, 4), np.nan)
    where = f"{recording.path}: {sources.state}"
    if sources.arm is None:
        codec = pose_codec(str(sources.pose_format))
        with errors_at(where):
            decoded = codec.decode(rows[known], "m", sources.angle_unit or codec.units[1])
        poses[known] = host_matrices(decoded)
        return rows, poses
    turning = ~np.asarray(sources.arm.prismatic)
    refuse_percentages(where, rows[known][:, turning])
    largest = float(np.abs(rows[known][:, turning]).max(initial=0.0))
    if sources.angle_unit == "rad" and largest > MAX_RADIANS:
        raise ValueError(f"{where}: joint readings up to {largest:.4g} are too large for radians")
    scale = ANGLE_UNITS[str(sources.angle_unit)]
    readings = np.where(turning, scale * rows, rows)
    poses[known] = host_matrices(sources.arm.base_from_tool(readings[known]))
    return readings, poses


class _Views(NamedTuple):
    """The frames that become views.

    Attributes:
        frames: all frames.
        chosen: indices of the views among them.
        as_png: whether JPEG files are written as PNG, because another camera has a video.
    """

    frames: Frames
    chosen: Int[np.ndarray, "views"]
    as_png: bool


def _write_pictures(
    folder: Path,
    recording: LeRobotDataset,
    camera: str,
    feature: str,
    views: _Views,
    report: Callable[[str], None],
) -> PictureFile:
    """Write the views' pictures by a camera, and return the first."""
    first: PictureFile | None = None
    missing = dict(zip(views.chosen.tolist(), view_names(len(views.chosen)), strict=True))
    for place, picture in recording.pictures(feature, views.frames, list(missing), report):
        view = missing.pop(place)
        with errors_at(f"{recording.path}: {feature}: view {view}"):
            file = checked_file(picture) if isinstance(picture, bytes) else png_of(picture)
            file = file.as_png() if views.as_png else file
            first = file.write(folder, (Path(camera) / view).as_posix(), first)
    if first is None or missing:
        raise ValueError(f"{recording.path}: {feature}: {len(missing)} pictures are missing")
    return first


def refuse_percentages(where: str, readings: Float[np.ndarray, "frames joints"]) -> None:
    """Refuse joint readings that are in percent of each joint's range of motion.

    The description of a data set does not tell the unit, but the readings do. An encoder counts in
    whole steps. With N = range_max - range_min steps between the two ends of a joint's motion,
    known from the arm's calibration, LeRobot records for the step number k

        in percent    -100 + 200 k / N,                    with another N in each joint
        in degrees    (k - N / 2) 360 / (resolution - 1),  with the same step in all joints

    Reference: MotorsBus._normalize in https://github.com/huggingface/lerobot
    (motors/motors_bus.py).
    """
    counts = [_steps_of_range(column) for column in readings.T]
    if len({count for count in counts if count}) < 2:
        return
    listed = ", ".join("?" if count is None else str(count) for count in counts)
    raise ValueError(
        f"{where}: expected joint readings in degrees or radians, found percent of each joint's "
        f"range of motion: they are whole steps of 200 / N from -100 on, with N = {listed}. Record "
        "with LeRobot's use_degrees=true, or convert with the arm's calibration file of LeRobot: "
        f"degrees = percent / 200 * (range_max - range_min) * 360 / {MAX_STEPS}"
    )


def _steps_of_range(readings: Float[np.ndarray, "frames"]) -> int | None:
    """Return the smallest N for which all readings are -100 + 200 k / N; None if there is none."""
    values = np.unique(readings)
    if len(values) < MIN_READINGS or np.abs(values).max() > 100.0 + STEP_TOLERANCE:
        return None
    if np.allclose(values, values.round(DECIMALS), rtol=0.0, atol=1e-5):
        return None
    values = values[np.linspace(0, len(values) - 1, min(len(values), MAX_READINGS)).astype(int)]
    counts = np.arange(MIN_STEPS, MAX_STEPS + 1)
    steps = (values + 100.0) * (counts[:, None] / 200.0)
    fitting = counts[np.all(np.abs(steps - steps.round()) < STEP_TOLERANCE, axis=1)]
    return int(fitting[0]) if len(fitting) else None
