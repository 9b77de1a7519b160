"""Define the options that several subcommands share, groups of options, and lists of numbers."""

import dataclasses
import functools
import inspect
import math
import webbrowser
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

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
    str,
    typer.Option(
        help="Lens model (such as radial): pinhole, radial, weng, opencv4, opencv5, opencv8 or "
        "fisheye."
    ),
]
NoiseOption = Annotated[
    NoiseModel,
    typer.Option(
        help="Estimate the noise of pixels and robot poses (estimated), or take the robot's poses "
        "as exact (trusted)."
    ),
]
BadViewsOption = Annotated[
    BadViews,
    typer.Option(
        help="What to do with a view that has invalid values: stop (raise) or leave it out (mask)."
    ),
]
BaseFromWorldOption = Annotated[
    str | None,
    typer.Option(
        help="Rough pose of the target, needed if its pattern looks the same when turned: "
        "x,y,z in m and yaw,pitch,roll in degrees, such as 0.5,0,0.02,90,0,180 (tool_from_world "
        "for a fixed camera)."
    ),
]
TimeOffsetOption = Annotated[
    bool,
    typer.Option(
        "--time-offset",
        help="Estimate the offset of the robot's clock from the camera's (poses logged in motion).",
    ),
]


class Mount(StrEnum):
    """The two places of a camera: on the robot, or fixed."""

    EYE_IN_HAND = "eye_in_hand"
    EYE_TO_HAND = "eye_to_hand"


MountOption = Annotated[
    Mount | None,
    typer.Option(
        help="Where the camera is, for a file of samples, which does not tell: on the robot's tool "
        "(eye_in_hand), or fixed (eye_to_hand)."
    ),
]
PoseFormatOption = Annotated[
    str,
    typer.Option(
        "--format",
        help="Pose format of the robot's manufacturer (such as kuka_abc): val_oat, kawasaki_oat, "
        "kuka_abc, ur, fanuc_wpr, abb, staubli_val3, yaskawa, ..., or euler_XYZ_fixed to "
        "euler_ZYZ_moving; .val files use VAL's own.",
    ),
]
ArmOption = Annotated[
    str | None,
    typer.Option(
        help="Also compute joint readings, for an arm by name, such as puma_560, or a .urdf file."
    ),
]
NearOption = Annotated[
    str | None,
    typer.Option(
        help="The arm's joint readings now, degrees (m for a sliding joint), such as 0,-10,40; the "
        "nearest inverse-kinematics solution is taken."
    ),
]
CommandsOutOption = Annotated[
    Path | None,
    typer.Option(help="Also write the commands to a file, such as commands.val; or .csv, .json."),
]


class Allowed(StrEnum):
    """The safety checks that a person may override, named as in `viewpoints.ALLOWING_WORDS`."""

    OUTSIDE_REGION = "outside-region"
    UNREACHABLE = "unreachable"
    BEHIND_TARGET = "behind-target"


AllowOption = Annotated[
    list[Allowed] | None,
    typer.Option(
        "--allow",
        help="Write the commands even if this safety check fails; may be repeated. "
        "outside-region: the pose is far from the calibrated views, and the robot may miss it by "
        "much more than stated. unreachable: the arm may stop at a joint limit or take an "
        "unexpected path. behind-target: camera or tool may hit the target or the table under it.",
    ),
]
BelowOption = Annotated[
    bool | None,
    typer.Option(
        "--below/--above",
        help="Look from the side where the world's z is negative, or positive; by default from the "
        "side on which the calibration views were.",
    ),
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON document for programs, instead of tables.")
]
DebugOption = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]


@dataclasses.dataclass(frozen=True)
class PageOptions:
    """The options of a subcommand that serves a page to this machine."""

    port: Annotated[
        int, typer.Option(help="Port of the page, such as 8765; 0 takes a free one.")
    ] = 0
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")
    ] = True

    def announcement(self, page: str, kept: str) -> Callable[[str], None]:
        """Return a function that prints where a page is and what a stop keeps, and opens it."""

        def announce(address: str) -> None:
            typer.echo(f"{page} is at\n{address}\nCtrl-C stops it; {kept}")
            if self.browser:
                webbrowser.open(address)

        return announce


def with_option_groups(subcommand: Callable[..., None]) -> Callable[..., None]:
    """Return a subcommand whose options are its own parameters and the fields of its groups.

    A group is a parameter annotated with a dataclass, or a field of a group that is. On the command
    line its fields take its place, one option each; the subcommand is called with one object.
    """
    options = options_of(subcommand)

    @functools.wraps(subcommand)
    def call_with_groups(**values: Any) -> None:
        _called_with(subcommand, values)

    # Typer reads its options from the signature and the annotations.
    named = [option.replace(kind=inspect.Parameter.KEYWORD_ONLY) for option in options]
    call_with_groups.__signature__ = inspect.Signature(named)  # pyright: ignore[reportAttributeAccessIssue]
    call_with_groups.__annotations__ = {option.name: option.annotation for option in named}
    return call_with_groups


def options_of(function: Callable[..., Any]) -> list[inspect.Parameter]:
    """Return the parameters of a function, with the fields of each group in the group's place."""
    options = []
    for parameter in inspect.signature(function, eval_str=True).parameters.values():
        group = parameter.annotation
        options += options_of(group) if _is_group(group) else [parameter]
    return options


def _called_with(function: Callable[..., Any], values: dict[str, Any]) -> Any:
    """Return what a function returns for the values of its options, by their names."""
    arguments = {}
    for name, parameter in inspect.signature(function, eval_str=True).parameters.items():
        group = parameter.annotation
        arguments[name] = _called_with(group, values) if _is_group(group) else values[name]
    return function(**arguments)


def _is_group(annotation: Any) -> bool:
    """Return whether an annotation is a dataclass, whose fields are options."""
    return isinstance(annotation, type) and dataclasses.is_dataclass(annotation)


def parse_numbers(option: str, text: str, count: int, form: str) -> tuple[float, ...]:
    """Return the finite numbers of an option, with the form of the text for errors: `x,y,z (m)`.

    Parentheses and spaces are accepted, so that a vector can be pasted as it is printed.
    """
    words = text.strip().removeprefix("(").removesuffix(")").split(",")
    try:
        numbers = tuple(float(word) for word in words)
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(
            f"{option}: expected {count} numbers between commas, {form}, found {text!r}"
        )
    return numbers
