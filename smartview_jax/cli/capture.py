"""Define `smartview capture`, which takes calibration views live, with a page or unattended."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

import smartview_jax as sv

from .capture_sources import SourceOptions, Sources, open_sources
from .documents import print_document
from .fit_options import parse_transforms
from .options import (
    BelowOption,
    DebugOption,
    JsonOption,
    PageOptions,
    parse_numbers,
    with_option_groups,
)
from .terminal import errors_reported, print_lines


@dataclass(frozen=True)
class WantedViews:
    """The options that say which views are wanted, and how many."""

    goal: Annotated[
        float,
        typer.Option(
            min=0.001, help="Stop when the expected error is this small, mm, such as 0.4."
        ),
    ] = 0.4
    views: Annotated[
        int, typer.Option(min=4, max=1000, help="Most views, a number such as 30.")
    ] = 40
    known_camera: Annotated[
        Path | None,
        typer.Option(help="A known camera, which is held, such as calibration.yaml."),
    ] = None
    start: Annotated[
        list[str] | None,
        typer.Option(
            help="Rough pose of camera or target, from which the first views are planned: "
            "x,y,z,yaw,pitch,roll in m and degrees, such as camera_from_tool=0,0.05,0.06,90,0,0 "
            "(or its inverse, tool_from_camera). May be repeated."
        ),
    ] = None
    below: BelowOption = None


@dataclass(frozen=True)
class MotionOptions:
    """The options of a capture that goes on without a person, and of a robot that it moves."""

    auto: Annotated[
        bool,
        typer.Option(
            "--auto",
            help="Without a page: take views until the goal is reached. With --move the robot is "
            "moved; otherwise a view is taken wherever it stands still.",
        ),
    ] = False
    patience: Annotated[
        float,
        typer.Option(
            min=1.0,
            help="With --auto: end after this time without camera, robot or view, a number of "
            "seconds such as 60.",
        ),
    ] = 60.0
    move: Annotated[
        bool,
        typer.Option(
            "--move",
            help="Let this program move the robot, within --box and at --speed. Keep the "
            "emergency stop at hand.",
        ),
    ] = False
    box: Annotated[
        str | None,
        typer.Option(
            help="With --move: opposite corners of the box that the tool never leaves, in the base "
            "frame, x,y,z,x,y,z in m, such as 0.3,-0.4,0.2,0.9,0.4,0.8."
        ),
    ] = None
    speed: Annotated[
        float,
        typer.Option(
            min=1.0, max=250.0, help="With --move: largest speed of the tool, mm/s, such as 50."
        ),
    ] = 100.0

    def limits(self, sources: Sources) -> "sv.capture.MotionLimits | None":
        """Return the limits of motions; None if the robot is not to move."""
        if not self.move:
            if self.box is not None:
                raise ValueError("--box: only with --move")
            return None
        if self.box is None:
            if sources.simulated is None:
                raise ValueError("--move: needs --box x,y,z,x,y,z (m), which the tool never leaves")
            return sources.simulated.limits
        numbers = parse_numbers("--box", self.box, 6, "x,y,z,x,y,z (m)")
        corners = list(zip(numbers[:3], numbers[3:], strict=True))
        lowest, highest = zip(*map(sorted, corners), strict=True)
        return sv.capture.MotionLimits(tuple(lowest), tuple(highest), 1e-3 * self.speed)


@with_option_groups
def capture(
    folder: Annotated[
        Path | None,
        typer.Argument(help="Data-set folder, as smartview new begins one; views are added to it."),
    ] = None,
    *,
    named: SourceOptions,
    wanted: WantedViews,
    motion: MotionOptions,
    page: PageOptions,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """Take calibration views with a live camera and robot, fit them, and plan the next view.

    A page in the browser shows the picture, the part of it that views cover, the expected error and
    the next pose. A view is taken when target and robot stand still, and is stored at once. After a
    lost camera, a lost robot or a crash, run the same command again to continue.
    """
    with errors_reported(debug):
        if named.print_program is not None:
            typer.echo(sv.capture.controller_program(named.print_program.value), nl=False)
            return
        if folder is None:
            raise ValueError("expected the folder of a data set (smartview new begins one)")
        sources = open_sources(named, folder)

        limits = motion.limits(sources)
        with sv.io.GrowingDataset(folder) as data:
            if motion.auto and named.robot == "typed":
                raise ValueError("--auto: needs a robot that reports its poses, found typed")
            options = _options(data, wanted, limits, sources, motion.auto)
            _refuse_unplanned(motion.auto and motion.move, options, len(data.names))
            say = _say if motion.auto else (lambda _: None)
            with sv.capture.CaptureSession(
                data, sources.camera, sources.robot, options, say
            ) as session:
                if motion.auto:
                    outcome = sv.capture.capture_unattended(session, wanted.views, motion.patience)
                    _give(outcome, wanted.goal, folder, json)
                    if not outcome.is_reached:
                        raise typer.Exit(1)
                    return
                announce = page.announcement(f"capture into {folder}", "all views are stored")
                sv.capture.serve_capture(session, page.port, announce, wanted.views)


def _say(text: str) -> None:
    """Print what happens on stderr, so that a redirected result does not contain it."""
    typer.echo(text, err=True)


def _options(
    data: "sv.io.GrowingDataset",
    wanted: WantedViews,
    motion: "sv.capture.MotionLimits | None",
    sources: Sources,
    auto: bool,
) -> "sv.capture.CaptureOptions":
    described = data.description
    rough = parse_transforms(wanted.start, described.mount) if wanted.start else {}
    mount_name, holder_name = sv.calibration.transform_names(described.mount)
    if not rough and sources.simulated is not None:
        drawing = sources.simulated.drawing
        rough = {mount_name: drawing.camera_from_mount, holder_name: drawing.holder_from_world}
    # dataset.yaml may state the target's pose; the option takes precedence.
    if rough and described.holder_from_world is not None:
        rough.setdefault(holder_name, described.holder_from_world)
    camera = None if wanted.known_camera is None else sv.io.read_camera(wanted.known_camera)
    return sv.capture.CaptureOptions(
        goal=1e-3 * wanted.goal,
        limits=sv.viewpoints.ViewLimits(below=wanted.below),
        start=rough or None,
        camera=camera,
        motion=motion,
        # A person wants to see how it goes; nobody reads the first fits of an unattended run.
        first_fit=sv.dataset.MINIMUM_RELIABLE_VIEWS if auto else sv.capture.MIN_FITTED_VIEWS,
    )


def _refuse_unplanned(moves_alone: bool, options: "sv.capture.CaptureOptions", views: int) -> None:
    """Raise a ValueError where the robot is to move alone and nothing says where to."""
    if moves_alone and options.start is None and views < options.first_fit:
        raise ValueError(
            "--auto --move: needs --start with rough poses of camera and target, from which the "
            f"first views are planned, or a folder with {options.first_fit} views"
        )


def _give(outcome: "sv.capture.CaptureOutcome", goal: float, folder: Path, json: bool) -> None:
    """Print how an unattended capture ended."""
    if json:
        content = {
            "reached": outcome.is_reached,
            "views": outcome.views,
            "std_mm": 1e3 * outcome.error,
            "goal_mm": goal,
            "reason": outcome.reason,
            "folder": str(folder),
        }
        print_document("capture", content)
        return

    error = f"{1e3 * outcome.error:.2g} mm" if math.isfinite(outcome.error) else "unknown"
    print_lines(outcome.reason)
    print_lines(f"{folder}: {outcome.views} views, expected error {error} (standard deviation)")
    typer.echo(f"next: smartview calibrate {folder}")
