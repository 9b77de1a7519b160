"""Print, check and write the robot's commands, for all subcommands that compute commands."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

import smartview_jax as sv

from ..files import refuse_unwritable
from . import options
from .documents import print_document
from .options import parse_numbers
from .terminal import print_lines


@dataclass(frozen=True)
class RobotOptions:
    """The options of a subcommand that prints commands: the robot, its format, the file."""

    arm: options.ArmOption = None
    near: options.NearOption = None
    out: options.CommandsOutOption = None
    pose_format: options.PoseFormatOption = "val_oat"
    allow: options.AllowOption = None

    @property
    def codec(self) -> "sv.geometry.PoseCodec":
        """The pose format of the robot's manufacturer."""
        return sv.geometry.pose_codec(self.pose_format)

    def refuse_unusable(self) -> None:
        """Refuse a wrong option before anything is computed."""
        if self.out is not None:
            refuse_unwritable(self.out.parent, "--out")
        _ = self.codec

    def arm_and_readings(
        self, calibration: "sv.Calibration"
    ) -> "tuple[sv.robots.SerialArm | None, np.ndarray | None]":
        """Return the arm and its joint readings now (rad, m); None for both without an arm.

        The arm is the named one; by default the one whose errors the calibration corrects.
        """
        text, arm = self.arm, sv.robot_errors.nominal_arm(calibration.field)
        if text is not None:
            arm = named_arm(text)
        return arm, _joint_readings(self.near, arm)


class CommandSheet(NamedTuple):
    """The commands of a subcommand, which are printed, checked and written for the robot.

    Attributes:
        robot: the robot's format, its file, and the checks that a person overrides.
        arm: the arm of the joint readings; None where none is known.
        refused_for: names of the checks that every command must pass.
    """

    robot: RobotOptions
    calibration: "sv.Calibration"
    names: tuple[str, ...]
    commands: "sv.viewpoints.ViewpointCommands"
    arm: "sv.robots.SerialArm | None"
    refused_for: tuple[str, ...]

    def give(self, subcommand: str, json: bool, say: Callable[[], None], **content: Any) -> None:
        """Print the commands, then what `say` prints, and write them; refuse unsafe ones."""
        if not json:
            self.print()
            say()
        self.refuse_unsafe()
        out = self.robot.out
        if out is not None:
            sv.io.write_viewpoints(
                out,
                self.commands.base_from_tool,
                self.names,
                self._joints(),
                self.robot.pose_format,
            )
        if json:
            entries = {"commands": self.document(), "unchecked": self.unchecked}
            print_document(subcommand, {**entries, **content, "file": out})
        elif out is not None:
            typer.echo(out)

    @property
    def unchecked(self) -> tuple[str, ...]:
        """The safety checks that could not be made, in words."""
        return sv.viewpoints.unchecked(self.calibration, self.arm is not None)

    def print(self) -> None:
        """Print poses, joint readings and the remarks of the checks."""
        # Before any refusal, which names views as the table does.
        print_viewpoints(self.names, self.commands, self.robot.codec)
        joints = self._joints()
        if self.arm is not None and joints is not None:
            print_joints(self.names, joints, self.arm)
        # All remarks, also those that refuse nothing.
        print_lines(*self._named(self.commands.checks.reasons()))
        print_lines(*(f"not checked: {sentence}" for sentence in self.unchecked))

    def document(self) -> list[dict[str, Any]]:
        """Return the commands as entries for programs: pose, joint readings (rad, m), reasons."""
        # In the manufacturer's units, which the column names state.
        codec, reasons = self.robot.codec, self.commands.checks.reasons()
        rows = codec.encode(self.commands.base_from_tool, *codec.units)
        refusals = self.commands.checks.reasons(self.refused_for)
        joints = self._joints()
        return [
            {
                "name": name,
                "format": codec.name,
                "pose": dict(zip(sv.io.pose_columns(codec), rows[k].tolist(), strict=True)),
                "joints": None if joints is None else joints[k].tolist(),
                "remarks": reasons[k],
                "refused": bool(refusals[k]),
            }
            for k, name in enumerate(self.names)
        ]

    def refuse_unsafe(self) -> None:
        """Raise a ValueError that names every unsafe command whose check is not overridden."""
        words = sv.viewpoints.ALLOWING_WORDS
        allowed = {name for word in self.robot.allow or () for name in words[word]}
        required = tuple(name for name in self.refused_for if name not in allowed)
        checks = self.commands.checks
        failed = checks.failed(required)
        if not failed:
            return
        violations = self._named(checks.reasons(required))
        overriding = [f"--allow {word}" for word in words if set(words[word]) & set(failed)]
        raise ValueError(
            f"refused, nothing is written: {'; '.join(violations)}. To write the file anyway: "
            f"{' '.join(overriding)}"
        )

    def _joints(self) -> np.ndarray | None:
        """Return the joint readings on the host."""
        return None if self.commands.joints is None else np.asarray(self.commands.joints)

    def _named(self, texts: Sequence[str]) -> list[str]:
        """Return the texts that are not empty, each with its command's name."""
        return [f"{name}: {text}" for name, text in zip(self.names, texts, strict=True) if text]


def numbered_names(count: int) -> tuple[str, ...]:
    """Return default names of commands: v1, v2, ..."""
    return tuple(f"v{1 + k}" for k in range(count))


def named_arm(text: str) -> "sv.robots.SerialArm":
    """Return the arm of a name or of a .urdf file."""
    return sv.io.load_urdf(text) if text.endswith(".urdf") else sv.robots.arm_by_name(text)


def _joint_readings(text: str | None, arm: "sv.robots.SerialArm | None") -> np.ndarray | None:
    """Return joint readings (rad, m) from text in degrees and metres; None without an arm."""
    if arm is None:
        if text is not None:
            raise ValueError("--near: needs an arm; give --arm")
        return None
    if text is None:
        raise ValueError(
            "--near: missing; an arm reaches a pose in several ways, and the solution nearest to "
            "these joint readings is taken"
        )
    form = "degrees (m for a sliding joint)"
    readings = np.array(parse_numbers("--near", text, arm.joint_count, form))
    return np.where(arm.prismatic, readings, np.deg2rad(readings))


def print_viewpoints(
    names: Sequence[str],
    commands: "sv.viewpoints.ViewpointCommands",
    codec: "sv.geometry.PoseCodec",
) -> None:
    """Print the commanded poses in a manufacturer's format.

    Where a line is too narrow for a pose, it takes several lines of at most four numbers.
    """
    headings = [name.replace("_", " ") for name in sv.io.pose_columns(codec)]
    rows = codec.encode(commands.base_from_tool, *codec.units)
    numbers = [[_format_number(x, codec, n) for n, x in enumerate(row)] for row in rows]
    console = Console()
    table = _table(headings, names, numbers)
    if Measurement.get(console, console.options.update(max_width=1000), table).maximum > (
        console.width
    ):
        tall = [_columns(texts) for texts in numbers]
        table = _table(_columns(headings), names, tall, end_section=True)
    console.print(table)


def _table(
    headings: Sequence[str],
    names: Sequence[str],
    rows: Sequence[Sequence[str]],
    end_section: bool = False,
) -> Table:
    """Return a table of named rows of numbers."""
    table = Table("view", box=box.SIMPLE)
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    for name, row in zip(names, rows, strict=True):
        table.add_row(name, *row, end_section=end_section)
    return table


def _columns(texts: Sequence[str]) -> list[str]:
    """Return the cells of four columns, of several lines each.

    Lines are filled from the end: the position's three texts stand over a quaternion's four.
    """
    lines = -(-len(texts) // 4)
    first = len(texts) - 4 * (lines - 1)
    filled = [*texts[:first], *[""] * (4 - first), *texts[first:]]
    return ["\n".join(filled[k::4]) for k in range(4)]


def _format_number(value: float, codec: "sv.geometry.PoseCodec", column: int) -> str:
    """Return a number of a pose as text: three decimals for mm and degrees, else six."""
    millimetres = column in codec.length_columns and codec.units[0] == "mm"
    degrees = column in codec.angle_columns and codec.units[1] == "deg"
    return f"{value:.3f}" if millimetres or degrees else f"{value:.6f}"


def print_joints(names: Sequence[str], joints: np.ndarray, arm: "sv.robots.SerialArm") -> None:
    """Print joint readings, in degrees (mm for a prismatic joint)."""
    units = ["mm" if is_prismatic else "deg" for is_prismatic in arm.prismatic]
    columns = (f"q{1 + k} {unit}" for k, unit in enumerate(units))
    table = Table("view", *columns, box=box.SIMPLE)
    shown = joints * np.where(arm.prismatic, 1e3, 180.0 / np.pi)
    for view, row in zip(names, shown, strict=True):
        table.add_row(view, *(f"{value:.3f}" for value in row))
    Console().print(table)
