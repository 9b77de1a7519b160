"""Define `smartview plan`, which plans the first or next views and their expected gain."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

import smartview_jax as sv

from ..argument_checks import errors_at
from ..files import require_folder
from . import options
from .fit_options import StartOption, parse_transforms
from .options import parse_numbers, with_option_groups
from .plan_rig import is_rig_plan, plan_rig
from .plan_words import give_no_commands, new_names, plan_entries, plan_words
from .robot_commands import CommandSheet, RobotOptions
from .terminal import errors_reported, print_lines, progress_line


@dataclass(frozen=True)
class RoughStart:
    """The options of first views, which are planned from a rough calibration."""

    start: StartOption = None
    camera: Annotated[
        Path | None,
        typer.Option(
            help="With --start: a known camera, as for calibrate, such as calibration.yaml."
        ),
    ] = None


@dataclass(frozen=True)
class EnoughViews:
    """The options that say when a plan has enough views."""

    views: Annotated[
        int | None,
        typer.Option(
            min=1, max=50, help="Most views, a number such as 8; by default 10, or 15 with --start."
        ),
    ] = None
    goal: Annotated[
        float | None,
        typer.Option(min=0.0, help="Stop when the error is this small, mm, such as 0.5."),
    ] = None
    gain: Annotated[
        float,
        typer.Option(min=0.0, max=100.0, help="Stop when one more view gains less, %, such as 2."),
    ] = 5.0

    def stop(self, first: bool) -> "sv.viewpoints.StopRule":
        """Return the rule in the library's units, for first or for next views."""
        goal = None if self.goal is None else 1e-3 * self.goal
        # All first views are needed; the least gain is a rule for additional ones.
        gain = 0.0 if first else 0.01 * self.gain
        return sv.viewpoints.StopRule(self.views or (15 if first else 10), goal, gain)


@dataclass(frozen=True)
class ViewSpan:
    """The options that say from where the target is looked at."""

    distance: Annotated[
        str | None,
        typer.Option(help="Smallest and largest distance from the target, m, such as 0.3,0.5."),
    ] = None
    tilt: Annotated[
        float,
        typer.Option(
            min=1.0, max=80.0, help="Largest tilt of the camera from vertical, degrees, such as 30."
        ),
    ] = 40.0
    roll: Annotated[
        float,
        typer.Option(
            min=1.0, max=180.0, help="Largest roll about the optical axis, degrees, such as 180."
        ),
    ] = 90.0
    below: options.BelowOption = None

    def limits(self) -> "sv.viewpoints.ViewLimits":
        """Return the limits in the library's units."""
        distances = None
        if self.distance is not None:
            smallest, largest = parse_numbers(
                "--distance", self.distance, 2, "smallest,largest (m)"
            )
            distances = smallest, largest
        return sv.viewpoints.ViewLimits(
            distances, math.radians(self.tilt), math.radians(self.roll), self.below
        )


@with_option_groups
def plan(
    paths: Annotated[
        list[Path],
        typer.Argument(
            help="For the next views: calibration.yaml and its data-set folder; of several "
            "cameras, the folder that calibrate wrote and the data-set folder. For the first "
            "views, with --start: the data-set folder alone (smartview new)."
        ),
    ],
    *,
    rough: RoughStart,
    enough: EnoughViews,
    span: ViewSpan,
    robot: RobotOptions,
    json: options.JsonOption = False,
    debug: options.DebugOption = False,
) -> None:
    """Print commands of the views to take next, best first, and the error they lead to.

    Views minimise the position error of a point in front of the camera. With few views so far the
    stated error is good to about 20 %. With --start the first views are planned, from rough poses
    of camera and target. Of several cameras, each command is a view of one of them, and counts for
    all.
    """
    with errors_reported(debug):
        robot.refuse_unusable()
        limits, stop, start = span.limits(), enough.stop(bool(rough.start)), rough.start
        if is_rig_plan(paths, bool(start)):
            if rough.camera is not None:
                raise ValueError("--camera: only with --start; the calibrations have their cameras")
            plan_rig(paths, limits, stop, robot, json)
            return
        _refuse_other_paths(paths, bool(start))
        with progress_line() as progress:
            if start:
                progress("reading the description of the data set")
                situation, taken = first_views(paths, start, rough.camera, limits), ()
            else:
                progress("reading the calibration and its data set")
                situation, taken = next_views(paths, rough.camera, limits, robot, progress)
            arm, readings = robot.arm_and_readings(situation.calibration)
            view_plan = sv.viewpoints.plan_views(
                _with_readings(situation.model, readings),
                situation.views,
                stop,
                needs=sv.viewpoints.ViewRequirements(situation.border_margin),
                arm=arm,
                progress=progress,
            )
        reasons = plan_words(view_plan, 0.01 * enough.gain, enough.goal, bool(start))
        words = (*situation.assumptions, *reasons)
        if len(view_plan.camera_from_world) == 0:
            give_no_commands({**plan_entries(view_plan), "words": words}, json)
            return
        wanted = sv.geometry.host_transforms(view_plan.camera_from_world)
        commands = sv.viewpoint_commands(
            situation.calibration, wanted, situation.points, arm, readings
        )
        names = new_names(taken, len(view_plan.camera_from_world))
        sheet = CommandSheet(
            robot, situation.calibration, names, commands, arm, sv.viewpoints.SAFETY_CHECKS
        )
        # After the table, where the result is seen last.
        say = partial(print_lines, *words)
        sheet.give("plan", json, say, **plan_entries(view_plan), words=words)


def _refuse_other_paths(paths: list[Path], first: bool) -> None:
    """Raise an error unless a calibration and its data set are given, or at first a folder."""
    given = ", ".join(map(str, paths))
    for path in paths:
        if not path.exists():
            raise FileNotFoundError(f"{path}: no such file or folder")
    if first and len(paths) != 1:
        raise ValueError(
            f"--start: expected the data-set folder alone (smartview new begins one), found {given}"
        )
    if not first and len(paths) != 2:
        raise ValueError(
            "expected calibration.yaml and its data-set folder, or with --start the folder alone; "
            f"found {given}"
        )
    require_folder(paths[-1], "the folder of a data set")


def _with_readings(
    model: "sv.viewpoints.InformationModel", readings: np.ndarray | None
) -> "sv.viewpoints.InformationModel":
    """Return the model with the joint readings near which inverse kinematics looks for views."""
    import equinox as eqx

    from ..runtime.array_namespace import to_device

    # The calibration of an arm by its joints has readings already.
    if readings is None or model.near is not None:
        return model
    near = to_device(readings)
    return eqx.tree_at(lambda m: m.near, model, near, is_leaf=lambda leaf: leaf is None)


def next_views(
    paths: list[Path],
    camera: Path | None,
    limits: "sv.viewpoints.ViewLimits",
    robot: RobotOptions,
    progress: Callable[[str], None],
) -> "tuple[sv.viewpoints.Situation, tuple[str, ...]]":
    """Return the situation given a calibration and its data set, and the names of its views.

    Args:
        paths: the calibration, and the folder of its data set.
        camera: a known camera, which is refused.
    """
    if camera is not None:
        raise ValueError("--camera: only with --start; the calibration contains its camera")
    estimate = sv.load_estimate(paths[0])
    data = sv.load_dataset(paths[1], "mask", progress=progress, keep_detections=False)
    # Without an arm there are no readings, and the robot is commanded by poses.
    _, readings = robot.arm_and_readings(estimate.calibration)
    progress("computing what the views so far tell")
    with errors_at(paths[0]):
        situation = sv.viewpoints.situation_of_estimate(
            estimate, np.asarray(data.points[0]), limits, readings, data.depth_noise
        )
    return situation, data.view_ids


def first_views(
    paths: list[Path],
    start: list[str],
    camera_file: Path | None,
    limits: "sv.viewpoints.ViewLimits",
) -> "sv.viewpoints.Situation":
    """Return the situation given rough transforms and the description of a folder."""
    described = sv.io.read_folder_description(paths[0])
    transforms = parse_transforms(start, described.mount)
    # dataset.yaml may state the target's pose; the option takes precedence.
    if described.holder_from_world is not None:
        transforms.setdefault(
            sv.calibration.transform_names(described.mount)[1], described.holder_from_world
        )
    return sv.viewpoints.situation_of_drawing(
        transforms,
        described.mount,
        np.asarray(described.target.points),
        described.image_size,
        None if camera_file is None else sv.io.read_camera(camera_file),
        limits,
    )
