"""Read and write CSV tables with a header; errors name the file, the row and the column."""

import csv
import dataclasses
import io
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..argument_checks import (
    MAX_COORDINATE,
    name_problem,
    no_name,
    require_readable,
    shortened_repr,
)
from ..files import write_atomically
from .table_text import VIEW_COLUMN, TableText, is_number, named_unit, read_table_text
from .table_text import duplicates as duplicates


@dataclasses.dataclass(frozen=True)
class Table:
    """The rows of a CSV file as mappings from its header, and what was recognised in its text.

    Attributes:
        rows: fields by the name of their column.
        notes: sentences for the user; none for a table as this package writes it.
        comments: comment lines of the file.
        written_header: names of the columns as the file has them.
    """

    path: Path
    rows: list[dict[str, str]]
    notes: tuple[str, ...]
    comments: tuple[str, ...]
    written_header: tuple[str, ...]

    def view_ids(self, content: str = "") -> list[str]:
        """Return the views' names, one for each row; an error names content of no rows."""
        views = [row[VIEW_COLUMN] for row in self.rows]
        if repeated := duplicates(views):
            raise ValueError(f"{self.path}: view {', '.join(repeated)} has more than one row")
        if content and not views:
            raise ValueError(f"{self.path}: no {content}")
        return views

    def requiring(self, required: Sequence[str], units: Collection[str] = ("s",)) -> "Table":
        """Return the table with more required columns than were known when it was read."""
        header, missing = _named(self.written_header, required, units)
        if missing:
            raise ValueError(
                f"{self.path}: expected the columns {', '.join(required)}; missing "
                f"{', '.join(missing)}"
                + _other_units(self.written_header, missing)
                + _no_header(self.written_header)
            )
        if repeated := duplicates(header):
            raise ValueError(f"{self.path}: column {', '.join(repeated)} comes twice")
        if header == list(next(iter(self.rows), ())):
            return self
        rows = [dict(zip(header, row.values(), strict=True)) for row in self.rows]
        return dataclasses.replace(self, rows=rows)


def read_table(path: Path, required: Sequence[str], units: Collection[str] = ("s",)) -> Table:
    """Read a CSV file.

    Separator, decimal sign and encoding are recognised (see `table_text`). A column that is written
    as `X [mm]` or `A (°)` is `x_mm`, `a_deg`; one that differs from a required column by its case,
    or by a unit among `units`, is this column.

    Args:
        required: names of columns that the table must have.
        units: units that a required column may have in its name, such as `time_s` for `time`.
    """
    text = read_table_text(path, lambda header: _named(header, required, units)[1] == [])
    rows = [dict(zip(text.header, fields, strict=True)) for fields in text.rows]
    written = Table(path, rows, _notes(path, text), text.comments, tuple(text.header))
    table = written.requiring(required, units)
    # Tables of detections have many rows of each view: each name is checked once.
    views = [row.get(VIEW_COLUMN, "?") for row in table.rows]
    for view in dict.fromkeys(views):
        if (reason := name_problem(view)) is not None:
            problem = f"a view, {no_name(view, reason)}" if view else "an empty view"
            raise ValueError(f"{path}: row {1 + views.index(view)} has {problem}")
    return table


def _notes(path: Path, text: TableText) -> tuple[str, ...]:
    """Return a sentence about what was recognised in a table's text; empty if nothing was."""
    header = _named(text.header, (), ())[0]
    changed = [
        f"{old!r} as {new}" for old, new in zip(text.header, header, strict=True) if old != new
    ]
    seen = (*text.seen, *((f"columns {', '.join(changed)}",) if changed else ()))
    return (f"{path.name} was read {'; '.join(seen)}",) if seen else ()


def _named(
    header: Sequence[str], required: Sequence[str], units: Collection[str]
) -> tuple[list[str], list[str]]:
    """Return the header in the package's names, and the required columns that it lacks."""
    named = []
    for column in header:
        name_unit = named_unit(column)
        named.append(column if name_unit is None else "_".join(filter(None, name_unit)).lower())
    missing = []
    for name in required:
        if name in named:
            continue
        # Case is ignored; a unit is allowed if it is one of the caller's.
        wanted = {name.lower(), *(f"{name}_{unit}".lower() for unit in units)}
        fitting = [k for k, column in enumerate(named) if column.lower() in wanted]
        if len(fitting) == 1:
            named[fitting[0]] = name
        else:
            missing.append(name)
    return named, missing


def _no_header(header: Sequence[str]) -> str:
    """Return a clause that the first row is no header; empty if it may be one."""
    if sum(map(is_number, header)) <= 0.5 * len(header):
        return ""
    return f": its first row, {','.join(header[:3])}, ..., has numbers: write a header above it"


def _other_units(header: Sequence[str], missing: Sequence[str]) -> str:
    """Return a clause that lists missing columns found in another unit; empty without any."""
    names = {name.lower() for name in missing}
    other = [
        repr(column)
        for column in header
        if (name_unit := named_unit(column)) is not None and name_unit[0].lower() in names
    ]
    return f" (found {', '.join(other)}, in an unexpected unit)" if other else ""


def refuse_truncated(path: Path, rows: Sequence[object], stated_rows: int | None) -> None:
    """Raise a ValueError if the number of rows differs from the one in the description."""
    if stated_rows is not None and len(rows) != stated_rows:
        raise ValueError(
            f"{path}: {len(rows)} rows, but the description states {stated_rows}: truncated file?"
        )


def parse_numbers(
    path: Path,
    row: Mapping[str, str],
    columns: Sequence[str],
    view: str,
    require_finite: bool = True,
) -> np.ndarray:
    """Return some columns of a row as numbers, finite ones unless the caller can mask the view."""
    values = np.empty(len(columns))
    for k, column in enumerate(columns):
        if not is_number(row[column]):
            raise ValueError(
                f"{path}: view {view}: {column} is {shortened_repr(row[column])}, not a number"
            )
        values[k] = float(row[column])
        if require_finite and not np.isfinite(values[k]):
            raise ValueError(f"{path}: view {view}: {column} is {row[column]}, not a finite number")
    return values


def refuse_out_of_range(path: str | Path, positions: np.ndarray, labels: Sequence[str]) -> None:
    """Raise a ValueError for the first position (m) beyond `MAX_COORDINATE`; NaN passes."""
    for label, position in zip(labels, positions, strict=True):
        for axis, value in zip("xyz", position, strict=True):
            if abs(value) > MAX_COORDINATE:
                raise ValueError(
                    f"{path}: view {label}: {axis} is {value:.6g} m, more than "
                    f"{MAX_COORDINATE:g} m from the origin: millimetres or inches given as metres?"
                )


def write_table(
    path: Path,
    header: Sequence[str],
    rows: Sequence[Sequence[object]],
    comments: Sequence[str] = (),
) -> None:
    """Write a CSV file and comments after it, completely or not at all; floats keep every digit."""
    if VIEW_COLUMN in header:
        column = list(header).index(VIEW_COLUMN)
        require_readable(f"{path}: view", dict.fromkeys(row[column] for row in rows))
    lines = [row_text(row) for row in (header, *rows)]
    lines += [f"# {comment}\n" for comment in comments]
    write_atomically(path, "".join(lines))


def write_view_table(
    path: Path,
    view_ids: Sequence[str],
    columns: Sequence[str],
    numbers: Float[np.ndarray, "views numbers"],
) -> None:
    """Write a CSV file with a row of numbers for each view, completely or not at all."""
    rows = [(view, *map(float, row)) for view, row in zip(view_ids, numbers, strict=True)]
    write_table(path, (VIEW_COLUMN, *columns), rows)


def row_text(row: Sequence[object]) -> str:
    """Return a row as a line of a CSV file; floats keep every digit."""
    text = io.StringIO()
    # `repr` gives the shortest text from which Python reads the same float again.
    fields = [repr(float(x)) if isinstance(x, float) else x for x in row]
    csv.writer(text, lineterminator="\n").writerow(fields)
    return text.getvalue()
