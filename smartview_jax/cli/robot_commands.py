"""Print, check and write the robot's commands, for all subcommands that compute commands."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import typer

from ..files import refuse_unwritable
from . import options
from .json_document import print_document
from .options import parse_numbers

if TYPE_CHECKING:
    import numpy as np

    from ..calibration import Calibration
    from ..geometry import PoseCodec
    from ..robots import SerialArm
    from ..viewpoints import ViewpointCommands


@dataclass(frozen=True)
class RobotOptions:
    """The options of a subcommand that prints commands: the robot, its format, the file."""

    arm: options.ArmOption = None
    near: options.NearOption = None
    out: options.CommandsOutOption = None
    pose_format: options.PoseFormatOption = "val_oat"
    allow: options.AllowOption = None

    def codec(self) -> "PoseCodec":
        """Return the pose format.

        Called first, so that a wrong option is reported before anything is computed.

        Raises:
            ValueError: the format has no such name.
            OSError: the file of `--out` could not be written.
        """
        from ..geometry import pose_codec

        if self.out is not None:
            refuse_unwritable(self.out.parent, "--out")
        return pose_codec(self.pose_format)

    def arm_and_readings(
        self, calibration: "Calibration"
    ) -> "tuple[SerialArm | None, np.ndarray | None]":
        """Return the arm and its joint readings now (rad, m); None for both without an arm."""
        arm = _arm(self.arm, calibration)
        return arm, _joint_readings(self.near, arm)


class CommandSheet(NamedTuple):
    """The commands of a subcommand, and how they are checked and written.

    Attributes:
        names: one name for each command.
        commands: poses, joint readings and checks.
        codec: pose format of the robot's manufacturer.
        arm: the arm of the joint readings; None where none is known.
        refused_for: names of the checks that every command must pass.
        unchecked: which safety checks could not be made, in words.
    """

    names: tuple[str, ...]
    commands: "ViewpointCommands"
    codec: "PoseCodec"
    arm: "SerialArm | None"
    refused_for: tuple[str, ...]
    unchecked: tuple[str, ...]

    @classmethod
    def of(
        cls,
        calibration: "Calibration",
        names: tuple[str, ...],
        commands: "ViewpointCommands",
        codec: "PoseCodec",
        arm: "SerialArm | None",
        refused_for: tuple[str, ...],
    ) -> "CommandSheet":
        """Return the commands of a calibration, with the checks that it and the arm do not allow.

        Args:
            calibration: with it the commands were computed.
            names, commands, codec, arm, refused_for: as the class's attributes.
        """
        from ..viewpoints import unchecked

        could_not = unchecked(calibration, arm is not None)
        return cls(names, commands, codec, arm, refused_for, could_not)

    def give(
        self,
        subcommand: str,
        out: Path | None,
        allow: Sequence[str] | None,
        json: bool,
        say: Callable[[], None] | None = None,
        **content: Any,
    ) -> None:
        """Print the commands and write them for the robot; refuse unsafe ones.

        Args:
            subcommand: name of the subcommand.
            out: the robot's file; None writes none.
            allow: words of `ALLOWING_WORDS`, whose checks are overridden.
            json: print a document instead of a table.
            say: prints further text after the table.
            content: further entries of the document.

        Raises:
            ValueError: a command is unsafe; the table was printed, no file was written.
        """
        if not json:
            self.print()
            if say is not None:
                say()
        self.refuse_unsafe(allow or ())
        if out is not None:
            self.write(out)
        if json:
            print_document(
                subcommand,
                {"commands": self.document(), "unchecked": self.unchecked, **content, "file": out},
            )
        elif out is not None:
            typer.echo(out)

    def print(self) -> None:
        """Print poses, joint readings and the remarks of the checks."""
        from .viewpoint_tables import print_joints, print_viewpoints

        # Before any refusal, which names views as the table does.
        print_viewpoints(self.names, self.commands, self.codec)
        joints = self._joints()
        if self.arm is not None and joints is not None:
            print_joints(self.names, joints, self.arm)
        # All remarks, also those that refuse nothing.
        for text in self._named(self.commands.checks.reasons()):
            typer.echo(text)
        for sentence in self.unchecked:
            typer.echo(f"not checked: {sentence}")

    def document(self) -> list[dict[str, Any]]:
        """Return the commands as entries for programs: pose, joint readings (rad, m), reasons."""
        from ..io import pose_columns

        # In the manufacturer's units, which the column names state.
        rows = self.codec.encode(self.commands.base_from_tool, *self.codec.units)
        columns, reasons = pose_columns(self.codec), self.commands.checks.reasons()
        refusals = self.commands.checks.reasons(self.refused_for)
        joints = self._joints()
        return [
            {
                "name": name,
                "format": self.codec.name,
                "pose": dict(zip(columns, rows[k].tolist(), strict=True)),
                "joints": None if joints is None else joints[k].tolist(),
                "remarks": reasons[k],
                "refused": bool(refusals[k]),
            }
            for k, name in enumerate(self.names)
        ]

    def refuse_unsafe(self, allow: Sequence[str] = ()) -> None:
        """Raise a ValueError that names every unsafe command.

        Args:
            allow: words of `ALLOWING_WORDS`, whose checks are overridden.
        """
        from ..viewpoints import ALLOWING_WORDS

        allowed = {name for word in allow for name in ALLOWING_WORDS[word]}
        required = tuple(name for name in self.refused_for if name not in allowed)
        checks = self.commands.checks
        failed = checks.failed(required)
        if not failed:
            return
        violations = self._named(checks.reasons(required))
        words = [word for word, names in ALLOWING_WORDS.items() if set(names) & set(failed)]
        raise ValueError(
            f"refused, nothing is written: {'; '.join(violations)}. To write the file anyway: "
            + " ".join(f"--allow {word}" for word in words)
        )

    def write(self, path: Path) -> None:
        """Write the commands for the robot: a .val, .csv or .json file."""
        from ..io import write_viewpoints

        write_viewpoints(
            path, self.commands.base_from_tool, self.names, self._joints(), self.codec.name
        )

    def _joints(self) -> "np.ndarray | None":
        """Return the joint readings on the host."""
        import numpy as np

        return None if self.commands.joints is None else np.asarray(self.commands.joints)

    def _named(self, texts: Sequence[str]) -> list[str]:
        """Return the texts that are not empty, each with its command's name."""
        return [f"{name}: {text}" for name, text in zip(self.names, texts, strict=True) if text]


def numbered_names(count: int) -> tuple[str, ...]:
    """Return default names of commands: v1, v2, ..."""
    return tuple(f"v{1 + k}" for k in range(count))


def _arm(text: str | None, calibration: "Calibration") -> "SerialArm | None":
    """Return the named arm; by default the arm whose errors the calibration corrects, or None."""
    from ..robot_errors import nominal_arm

    return nominal_arm(calibration.field) if text is None else named_arm(text)


def named_arm(text: str) -> "SerialArm":
    """Return the arm of a name or of a .urdf file."""
    from ..io import load_urdf
    from ..robots import arm_by_name

    return load_urdf(text) if text.endswith(".urdf") else arm_by_name(text)


def _joint_readings(text: str | None, arm: "SerialArm | None") -> "np.ndarray | None":
    """Return joint readings (rad, m) from text in degrees and metres; None without an arm."""
    import numpy as np

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
