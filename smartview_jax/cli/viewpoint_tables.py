"""Print the tables of commands: poses and joint readings."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from ..io import pose_columns

if TYPE_CHECKING:
    from ..geometry import PoseCodec
    from ..robots import SerialArm
    from ..viewpoints import ViewpointCommands


def print_viewpoints(
    names: Sequence[str], commands: "ViewpointCommands", codec: "PoseCodec"
) -> None:
    """Print the commanded poses in a manufacturer's format."""
    table = Table("view", box=box.SIMPLE)
    for name in pose_columns(codec):
        table.add_column(name.replace("_", " "), justify="right", no_wrap=True)
    rows = codec.encode(commands.base_from_tool, *codec.units)
    for view, row in zip(names, rows, strict=True):
        table.add_row(view, *(_format_number(value, codec, n) for n, value in enumerate(row)))
    Console().print(table)


def _format_number(value: float, codec: "PoseCodec", column: int) -> str:
    """Return a number of a pose as text: three decimals for mm and degrees, else six."""
    millimetres = column in codec.length_columns and codec.units[0] == "mm"
    degrees = column in codec.angle_columns and codec.units[1] == "deg"
    return f"{value:.3f}" if millimetres or degrees else f"{value:.6f}"


def print_joints(names: Sequence[str], joints: np.ndarray, arm: "SerialArm") -> None:
    """Print joint readings, in degrees (mm for a prismatic joint)."""
    units = ["mm" if is_prismatic else "deg" for is_prismatic in arm.prismatic]
    columns = (f"q{1 + k} {unit}" for k, unit in enumerate(units))
    table = Table("view", *columns, box=box.SIMPLE)
    shown = joints * np.where(arm.prismatic, 1e3, 180.0 / np.pi)
    for view, row in zip(names, shown, strict=True):
        table.add_row(view, *(f"{value:.3f}" for value in row))
    Console().print(table)
