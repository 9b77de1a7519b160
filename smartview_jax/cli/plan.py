"""Define `smartview plan`, which says which views to take first, or next, and what they bring."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from . import options
from .fit_options import StartOption
from .json_document import print_document
from .option_groups import with_option_groups
from .plan_situation import ViewLimits, first_views, next_views
from .plan_words import plan_entries, plan_words
from .robot_commands import CommandSheet, RobotOptions
from .terminal import errors_reported, progress_line

if TYPE_CHECKING:
    import numpy as np

    from ..viewpoints import InformationModel, ViewPlan


@with_option_groups
def plan(
    paths: Annotated[
        list[Path],
        typer.Argument(
            help="calibration.yaml and its data-set folder, for the next views; with --start the "
            "folder alone (smartview new), for the first."
        ),
    ],
    start: StartOption = None,
    camera: Annotated[
        Path | None, typer.Option(help="With --start: a known camera, as for calibrate.")
    ] = None,
    views: Annotated[
        int | None, typer.Option(min=1, max=50, help="Most views; by default 10, with --start 15.")
    ] = None,
    goal: Annotated[
        float | None, typer.Option(min=0.0, help="Stop where the error is this small, mm.")
    ] = None,
    gain: Annotated[
        float, typer.Option(min=0.0, max=100.0, help="Stop where one more view gains less, %.")
    ] = 5.0,
    distance: Annotated[
        tuple[float, float] | None,
        typer.Option(help="Least and greatest distance from the target, m."),
    ] = None,
    tilt: Annotated[
        float, typer.Option(min=1.0, max=80.0, help="Greatest, from straight above, degrees.")
    ] = 40.0,
    roll: Annotated[
        float, typer.Option(min=1.0, max=180.0, help="Greatest, about the optical axis, degrees.")
    ] = 90.0,
    below: options.BelowOption = None,
    *,
    robot: RobotOptions,
    json: options.JsonOption = False,
    debug: options.DebugOption = False,
) -> None:
    """Print commands of the views to take next, and what they bring; best first.

    The error that is made small is that of a point before the camera, as the hand-eye transform
    places it; what is promised holds to some 20 % where only few views were taken. With --start
    the first views, from where camera and target roughly are.
    """
    with errors_reported(debug):
        import math

        from ..geometry import host_transforms
        from ..viewpoints import SAFETY_CHECKS, plan_views, unchecked, viewpoint_commands

        codec = robot.codec()
        span = ViewLimits(distance, math.radians(tilt), math.radians(roll), below)
        with progress_line() as progress:
            if start:
                situation = first_views(paths, start, camera, span)
            else:
                situation = next_views(paths, camera, span, robot)
            arm, readings = robot.arm_and_readings(situation.calibration)
            found = plan_views(
                _with_readings(situation.model, readings),
                situation.views,
                views or (15 if start else 10),
                goal=None if goal is None else 1e-3 * goal,
                # First views are all needed; the rule is about views that come on top.
                least_gain=0.0 if start else 0.01 * gain,
                border_margin=situation.border_margin,
                arm=arm,
                progress=progress,
            )
        words = (*situation.assumptions, *plan_words(found, 0.01 * gain, goal, bool(start)))
        if len(found.camera_from_world) == 0:
            _give_nothing(found, words, json)
            return
        wanted = host_transforms(found.camera_from_world)
        commands = viewpoint_commands(
            situation.calibration, wanted, situation.points, arm, readings
        )
        names = _new_names(situation.names, len(found.camera_from_world))
        sheet = CommandSheet(
            names,
            commands,
            codec,
            arm,
            SAFETY_CHECKS,
            unchecked(situation.calibration, arm is not None),
        )
        # The words come after the table: they are what a person is to remember.
        say = partial(typer.echo, "\n".join(words))
        sheet.give("plan", robot.out, robot.allow, json, say, **plan_entries(found), words=words)


def _give_nothing(found: "ViewPlan", words: tuple[str, ...], json: bool) -> None:
    """Print that there is no view to take, and why; no file is written that a robot could get."""
    if json:
        content = {"commands": [], **plan_entries(found), "words": words, "file": None}
        print_document("plan", content)
    else:
        typer.echo("\n".join(words))


def _with_readings(model: "InformationModel", readings: "np.ndarray | None") -> "InformationModel":
    """Return the model with the joint readings near which inverse kinematics looks for views."""
    import equinox as eqx

    from ..runtime.array_namespace import to_device

    # A calibration of an arm's joints has its readings already.
    if readings is None or model.near is not None:
        return model
    near = to_device(readings)
    return eqx.tree_at(lambda m: m.near, model, near, is_leaf=lambda leaf: leaf is None)


def _new_names(taken: tuple[str, ...], count: int) -> tuple[str, ...]:
    """Return names of views that the data set does not have: v16, v17, ..."""
    numbers = range(1 + len(taken), 1 + 2 * len(taken) + count)
    # A name that exists already would make two rows of one view.
    return tuple(f"v{k}" for k in numbers if f"v{k}" not in taken)[:count]
