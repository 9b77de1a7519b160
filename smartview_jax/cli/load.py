"""Load the data set, or the pictures of an object with their calibration, for a subcommand."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

import smartview_jax as sv


def load_named(
    dataset: Path | None,
    bad_views: str,
    progress: Callable[[str], None],
    base_from_world: str | None = None,
    tracked_poses: bool = False,
) -> "tuple[sv.Dataset, str]":
    """Load a data set (the sample if none is named), and return it with its name.

    The rough pose of the target is as a person writes it. Poses of a tracker take the place of
    pictures only if allowed.
    """
    rough_pose = None
    if base_from_world is not None:
        rough_pose = sv.io.parse_rough_pose("--base-from-world", base_from_world)

    if dataset is None:
        # The sample belongs to the installed package, and nothing is written to its folder.
        progress("no data set given: the sample of the package")
        return sv.load_dataset(
            sv.io.sample_folder(), progress=progress, keep_detections=False
        ), "the sample"
    data = sv.load_dataset(dataset, bad_views, progress=progress, holder_from_world=rough_pose)
    if isinstance(data, sv.dataset.PoseDataset) and not tracked_poses:
        raise ValueError(
            f"{dataset}: has poses of a tracker or a depth sensor in place of pictures: only "
            "smartview calibrate takes it"
        )
    return data, dataset.resolve().name


def load_samples(file: Path, mount: str | None) -> "tuple[sv.Dataset, str]":
    """Read a file of easy_handeye2's samples, and return them with their name."""
    if file.name == sv.io.DESCRIPTION_FILE:
        raise ValueError(f"{file}: describes a data set: give its folder, {file.parent}")
    try:
        samples = sv.io.read_easy_handeye(file, mount or "eye_in_hand")
    except ValueError as error:
        raise ValueError(
            f"{error}; expected the folder of a data set, or a file of easy_handeye2's samples"
        ) from error
    if mount is None:
        raise ValueError(
            f"{file}: the file does not tell where the camera is: give --mount eye_in_hand, or "
            "eye_to_hand for a fixed camera"
        )
    data = sv.dataset.PoseDataset.from_poses(
        samples.base_from_tool, samples.camera_from_world, mount
    )
    return data, file.stem


def with_estimated_clock(
    data: "sv.Dataset", dataset: Path | None, lens: str, progress: Callable[[str], None]
) -> "sv.Dataset":
    """Return the data set with poses interpolated at the pictures' times by the estimated clock."""
    log = None if dataset is None else sv.io.load_pose_log(dataset)
    if log is None:
        raise ValueError(
            "--time-offset: expected a data set whose robot logged its poses over time "
            "(poses.picture_times); this one has a pose for each view"
        )
    estimate = sv.estimate_time_offset(
        data, log.trajectory, log.picture_times, lens, progress=progress
    )
    note = f"{estimate} (in dataset.yaml: poses.time_offset: {estimate.seconds:.6f})"
    return dataclasses.replace(estimate.data, notes=(*data.notes, note))


class NamedViews(NamedTuple):
    """The views of a folder.

    Attributes:
        command: reported poses; None without a robot.
        cameras: name of the camera of each view; empty for a folder of one camera.
        states: name of the robot's state in each view; empty for a folder of one camera.
    """

    names: list[str]
    pictures: list[Path]
    command: "sv.robots.Command | None"
    cameras: tuple[str, ...] = ()
    states: tuple[str, ...] = ()


def load_views(folder: Path) -> NamedViews:
    """Return the views in a folder."""
    # A data set of a board may keep the pictures of the object in a separate folder.
    for candidate in (folder, folder / "object"):
        if sv.io.is_rig_object_views(candidate):
            seen = sv.io.load_rig_object_views(candidate)
            _print_notes(seen.notes)
            names, files = list(seen.view_ids), list(seen.paths)
            return NamedViews(names, files, seen.command, seen.cameras, seen.states)
        if (candidate / sv.io.OBJECT_VIEWS_FILE).is_file():
            object_views = sv.io.load_object_views(candidate)
            _print_notes(object_views.notes)
            names, files = list(object_views.view_ids), list(object_views.paths)
            return NamedViews(names, files, object_views.command)
    views = sv.io.load_view_pictures(folder)
    _print_notes(views.notes)
    return NamedViews(views.view_ids, views.pictures, views.command)


def _print_notes(notes: Sequence[str]) -> None:
    """Print notes to stderr, because they are not part of a command's result."""
    for note in notes:
        typer.echo(note, err=True)


@dataclasses.dataclass(frozen=True)
class RigOptions:
    """The options of a subcommand that may be given the calibration of a rig.

    Attributes:
        camera: the camera that took the views; None where the views say so.
        frame: frame of the results.
    """

    camera: Annotated[
        str | None,
        typer.Option(
            help="With a rig's calibration and pictures of one camera: its name, such as left.",
        ),
    ] = None
    frame: Annotated[
        str,
        typer.Option(
            help="With a rig's calibration: frame of the results, such as base (of the robot, for "
            "cameras on the hand and next to the arm) or world (of the target that all cameras "
            "saw).",
        ),
    ] = "world"


def load_calibrated_views(
    path: Path, views: NamedViews, wanted: RigOptions
) -> "tuple[sv.modeling.AnyCalibration, sv.joint.SavedEstimate | None, bool]":
    """Return the calibration of views, its covariance, and whether it is taken as exact.

    The path is of a calibration file, or of the folder or file of a calibrated rig.
    """
    camera, frame = wanted.camera, wanted.frame
    if not sv.joint.is_rig(path):
        if views.cameras:
            raise ValueError(
                f"{path}: the views are of cameras {', '.join(dict.fromkeys(views.cameras))}: give "
                "the calibration of their rig, the folder that smartview calibrate wrote"
            )
        if camera is not None or frame != "world":
            raise ValueError(f"{path}: --camera and --frame are for the calibration of a rig")
        loaded, estimate = sv.joint.load_with_uncertainty(path)
        return loaded, estimate, estimate is None
    calibrations, joint = sv.joint.load_calibrated_rig(path)
    names = views.cameras
    if not names:
        if camera is None:
            raise ValueError(
                f"{path}: a rig of {', '.join(calibrations)}, and pictures of one camera: name it "
                "by --camera"
            )
        names = (camera,) * len(views.names)
    elif camera is not None:
        raise ValueError(f"--camera {camera}: the folder names the cameras of its pictures")
    states = views.states or None
    rig = calibrations if joint is None else joint
    return sv.RigViews(rig, names, states, frame), None, joint is None
