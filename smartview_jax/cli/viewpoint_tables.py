"""Print the tables of commands: poses and joint readings."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from ..io import pose_columns

if TYPE_CHECKING:
    from ..geometry import PoseCodec
    from ..robots import SerialArm
    from ..viewpoints import ViewpointCommands


def print_viewpoints(
    names: Sequence[str], commands: "ViewpointCommands", codec: "PoseCodec"
) -> None:
    """Print the commanded poses in a manufacturer's format.

    Where a line is too narrow for a pose, it takes several lines of at most four numbers.
    """
    headings = [name.replace("_", " ") for name in pose_columns(codec)]
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
