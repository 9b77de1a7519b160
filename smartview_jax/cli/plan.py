"""Define `smartview plan`, which plans the first or next views and their expected gain."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from . import options
from .fit_options import StartOption
from .number_lists import parse_numbers
from .option_groups import with_option_groups
from .plan_rig import Stop, is_rig_plan, plan_rig
from .plan_situation import first_views, next_views
from .plan_words import give_no_commands, new_names, plan_entries, plan_words
from .robot_commands import CommandSheet, RobotOptions
from .terminal import errors_reported, progress_line

if TYPE_CHECKING:
    import numpy as np

    from ..viewpoints import InformationModel


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
    start: StartOption = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            help="With --start: a known camera, as for calibrate, such as calibration.yaml."
        ),
    ] = None,
    views: Annotated[
        int | None,
        typer.Option(
            min=1, max=50, help="Most views, a number such as 8; by default 10, or 15 with --start."
        ),
    ] = None,
    goal: Annotated[
        float | None,
        typer.Option(min=0.0, help="Stop when the error is this small, mm, such as 0.5."),
    ] = None,
    gain: Annotated[
        float,
        typer.Option(min=0.0, max=100.0, help="Stop when one more view gains less, %, such as 2."),
    ] = 5.0,
    distance: Annotated[
        str | None,
        typer.Option(help="Smallest and largest distance from the target, m, such as 0.3,0.5."),
    ] = None,
    tilt: Annotated[
        float,
        typer.Option(
            min=1.0, max=80.0, help="Largest tilt of the camera from vertical, degrees, such as 30."
        ),
    ] = 40.0,
    roll: Annotated[
        float,
        typer.Option(
            min=1.0, max=180.0, help="Largest roll about the optical axis, degrees, such as 180."
        ),
    ] = 90.0,
    below: options.BelowOption = None,
    *,
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
        import math

        from ..geometry import host_transforms
        from ..viewpoints import (
            SAFETY_CHECKS,
            ViewLimits,
            plan_views,
            unchecked,
            viewpoint_commands,
        )

        codec = robot.codec()
        span = ViewLimits(_distance_range(distance), math.radians(tilt), math.radians(roll), below)
        if is_rig_plan(paths, bool(start)):
            if camera is not None:
                raise ValueError("--camera: only with --start; the calibrations have their cameras")
            stop = Stop(views or 10, None if goal is None else 1e-3 * goal, 0.01 * gain)
            plan_rig(paths, span, stop, robot, json)
            return
        with progress_line() as progress:
            if start:
                progress("reading the description of the data set")
                situation, taken = first_views(paths, start, camera, span), ()
            else:
                progress("reading the calibration and its data set")
                situation, taken = next_views(paths, camera, span, robot, progress)
            arm, readings = robot.arm_and_readings(situation.calibration)
            view_plan = plan_views(
                _with_readings(situation.model, readings),
                situation.views,
                views or (15 if start else 10),
                goal=None if goal is None else 1e-3 * goal,
                # All first views are needed; the least gain is a rule for additional ones.
                least_gain=0.0 if start else 0.01 * gain,
                border_margin=situation.border_margin,
                arm=arm,
                progress=progress,
            )
        words = (*situation.assumptions, *plan_words(view_plan, 0.01 * gain, goal, bool(start)))
        if len(view_plan.camera_from_world) == 0:
            give_no_commands({**plan_entries(view_plan), "words": words}, json)
            return
        wanted = host_transforms(view_plan.camera_from_world)
        commands = viewpoint_commands(
            situation.calibration, wanted, situation.points, arm, readings
        )
        names = new_names(taken, len(view_plan.camera_from_world))
        sheet = CommandSheet(
            names,
            commands,
            codec,
            arm,
            SAFETY_CHECKS,
            unchecked(situation.calibration, arm is not None),
        )
        # After the table, where the result is seen last.
        say = partial(typer.echo, "\n".join(words))
        sheet.give(
            "plan", robot.out, robot.allow, json, say, **plan_entries(view_plan), words=words
        )


def _distance_range(text: str | None) -> tuple[float, float] | None:
    """Return the smallest and the largest distance, m; None to choose them."""
    if text is None:
        return None
    smallest, largest = parse_numbers("--distance", text, 2, "smallest,largest (m)")
    return smallest, largest


def _with_readings(model: "InformationModel", readings: "np.ndarray | None") -> "InformationModel":
    """Return the model with the joint readings near which inverse kinematics looks for views."""
    import equinox as eqx

    from ..runtime.array_namespace import to_device

    # The calibration of an arm by its joints has readings already.
    if readings is None or model.near is not None:
        return model
    near = to_device(readings)
    return eqx.tree_at(lambda m: m.near, model, near, is_leaf=lambda leaf: leaf is None)
