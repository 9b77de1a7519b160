"""Define the arguments and options that several subcommands share."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class BadViews(StrEnum):
    """The treatments of a view whose picture or pose is invalid."""

    RAISE = "raise"
    MASK = "mask"


class NoiseModel(StrEnum):
    """The assumptions of the joint fit on errors of the robot's reported poses."""

    ESTIMATED = "estimated"
    TRUSTED = "trusted"


DatasetArgument = Annotated[
    Path | None, typer.Argument(help="Data-set folder; the sample of the package if not given.")
]
LensOption = Annotated[
    str, typer.Option(help="pinhole, radial, weng, opencv4, opencv5, opencv8 or fisheye.")
]
NoiseOption = Annotated[
    NoiseModel,
    typer.Option(help="Find the sizes of all errors, or take the robot's poses as exact."),
]
BadViewsOption = Annotated[
    BadViews, typer.Option(help="A view with wrong values: an error, or masked with its reason.")
]
BaseFromWorldOption = Annotated[
    str | None,
    typer.Option(
        help="Where the target stands, roughly, for a pattern that looks the same when turned: "
        "x,y,z in m and yaw,pitch,roll in degrees (tool_from_world if the camera stands)."
    ),
]
TimeOffsetOption = Annotated[
    bool,
    typer.Option(
        "--time-offset",
        help="Estimate how much later the robot's clock is, where it logged poses in motion.",
    ),
]
PoseFormatOption = Annotated[
    str,
    typer.Option(
        "--format",
        help="How the robot's maker writes poses: val_oat, kawasaki_oat, kuka_abc, ur, "
        "fanuc_wpr, abb, staubli_val3, yaskawa, ..., or euler_XYZ_fixed to euler_ZYZ_moving; "
        ".val files have VAL's.",
    ),
]
ArmOption = Annotated[
    str | None,
    typer.Option(help="Joint readings too: an arm's name (puma_560, ...) or a .urdf file."),
]
NearOption = Annotated[
    str | None,
    typer.Option(help="Readings to set out from, degrees (m where a joint slides): 0,-10,40."),
]
CommandsOutOption = Annotated[
    Path | None, typer.Option(help="Also write the commands: a .val, .csv or .json file.")
]


class Allowed(StrEnum):
    """The safety checks that a person may override, by the words of `viewpoints.ALLOWING_WORDS`."""

    OUTSIDE_REGION = "outside-region"
    UNREACHABLE = "unreachable"
    BEHIND_TARGET = "behind-target"


AllowOption = Annotated[
    list[Allowed] | None,
    typer.Option(
        "--allow",
        help="Write the commands although this check fails; give it once for each check. "
        "outside-region: the pose is far from the calibrated views, and the robot may miss it by "
        "much more than stated. unreachable: the arm may stop at a joint limit, or move by a way "
        "that nobody expects. behind-target: camera or tool may hit the target, or the table that "
        "it lies on.",
    ),
]
BelowOption = Annotated[
    bool | None,
    typer.Option(
        "--below/--above",
        help="Seen from where the world's z is negative, or positive; by default from the side "
        "from which the calibration saw the target.",
    ),
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON document for programs, instead of tables.")
]
DebugOption = Annotated[bool, typer.Option("--debug", help="Show where an error came from.")]
