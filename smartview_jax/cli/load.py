"""Load the data set, or the pictures of an object, that a subcommand works on."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import typer

if TYPE_CHECKING:
    from ..dataset import Dataset
    from ..robots import Command


def load_named(
    dataset: Path | None,
    bad_views: str,
    progress: Callable[[str], None],
    base_from_world: str | None = None,
    tracked_poses: bool = False,
) -> "tuple[Dataset, str]":
    """Load a data set (the sample if none is named), and return it with its name.

    Args:
        dataset: its folder; None for the sample.
        bad_views: as in `load_dataset`.
        progress: called with a line of text for each step.
        base_from_world: rough pose of the target as a person writes it.
        tracked_poses: whether poses of a tracker may take the place of pictures.

    Raises:
        ValueError: several cameras, or poses of a tracker where pictures are needed; and the
            errors of `load_dataset`.
    """
    from ..dataset import PoseDataset
    from ..io import load_dataset, parse_rough_pose, sample_folder

    rough_pose = None
    if base_from_world is not None:
        rough_pose = parse_rough_pose("--base-from-world", base_from_world)

    if dataset is None:
        # The sample belongs to the installed package, and nothing is written to its folder.
        progress("no data set given: the sample of the package")
        return load_dataset(sample_folder(), progress=progress, keep_detections=False), "the sample"
    data = load_dataset(dataset, bad_views, progress=progress, holder_from_world=rough_pose)
    if isinstance(data, PoseDataset) and not tracked_poses:
        raise ValueError(
            f"{dataset}: has poses of a tracker or a depth sensor in place of pictures: only "
            "smartview calibrate takes it"
        )
    return data, dataset.resolve().name


def load_samples(file: Path, mount: str | None) -> "tuple[Dataset, str]":
    """Read a file of easy_handeye2's samples, and return them with their name.

    Raises:
        ValueError: the mount is not stated, which the file does not tell; or a wrong file.
    """
    from ..dataset import PoseDataset
    from ..io import DESCRIPTION_FILE, read_easy_handeye

    if file.name == DESCRIPTION_FILE:
        raise ValueError(f"{file}: describes a data set: give its folder, {file.parent}")
    if mount is None:
        raise ValueError(
            f"{file}: the file does not tell where the camera is: give --mount eye_in_hand, or "
            "eye_to_hand for a fixed camera"
        )
    samples = read_easy_handeye(file, mount)
    data = PoseDataset.from_poses(samples.base_from_tool, samples.camera_from_world, mount)
    return data, file.stem


def with_estimated_clock(
    data: "Dataset", dataset: Path | None, lens: str, progress: Callable[[str], None]
) -> "Dataset":
    """Return the data set with poses interpolated at the pictures' times, for the estimated clock.

    Raises:
        ValueError: the data set has a pose for each view instead of a robot's log.
    """
    import dataclasses

    from ..clocks import estimate_time_offset
    from ..io import load_pose_log

    log = None if dataset is None else load_pose_log(dataset)
    if log is None:
        raise ValueError(
            "--time-offset: expected a data set whose robot logged its poses over time "
            "(poses.picture_times); this one has a pose for each view"
        )
    estimate = estimate_time_offset(
        data, log.trajectory, log.picture_times, lens, progress=progress
    )
    note = f"{estimate} (in dataset.yaml: poses.time_offset: {estimate.seconds:.6f})"
    return dataclasses.replace(estimate.data, notes=(*data.notes, note))


class NamedViews(NamedTuple):
    """The views of a folder.

    Attributes:
        names: of the views.
        pictures: their files.
        command: reported poses; None without a robot.
        cameras: name of the camera of each view; empty for a folder of one camera.
        states: name of the robot's state in each view; empty for a folder of one camera.
    """

    names: list[str]
    pictures: list[Path]
    command: "Command | None"
    cameras: tuple[str, ...] = ()
    states: tuple[str, ...] = ()


def load_views(folder: Path) -> NamedViews:
    """Return the views in a folder."""
    from ..io import (
        OBJECT_VIEWS_FILE,
        is_rig_object_views,
        load_object_views,
        load_rig_object_views,
        load_view_pictures,
    )

    # A data set of a board may keep the pictures of the object in a separate folder.
    for candidate in (folder, folder / "object"):
        if is_rig_object_views(candidate):
            seen = load_rig_object_views(candidate)
            _print_notes(seen.notes)
            names, files = list(seen.view_ids), list(seen.paths)
            return NamedViews(names, files, seen.command, seen.cameras, seen.states)
        if (candidate / OBJECT_VIEWS_FILE).is_file():
            object_views = load_object_views(candidate)
            _print_notes(object_views.notes)
            names, files = list(object_views.view_ids), list(object_views.paths)
            return NamedViews(names, files, object_views.command)
    views = load_view_pictures(folder)
    _print_notes(views.notes)
    return NamedViews(views.view_ids, views.pictures, views.command)


def _print_notes(notes: Sequence[str]) -> None:
    """Print notes to stderr, because they are not part of a command's result."""
    for note in notes:
        typer.echo(note, err=True)
