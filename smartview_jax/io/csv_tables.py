"""Read and write CSV tables with a header; errors name the file, the row and the column."""

import csv
import dataclasses
import io
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from ..argument_checks import name_problem, no_name, require_readable
from ..files import write_atomically
from ..schemas.messages import shortened_repr
from .table_text import VIEW_COLUMN, TableText, is_number, named_unit, read_table_text
from .table_text import duplicates as duplicates

MAX_COORDINATE = 100.0
"""Largest coordinate of a pose, m: a larger one was given in another unit, such as mm."""


@dataclasses.dataclass(frozen=True)
class Table:
    """The rows of a CSV file as mappings from its header, and what was recognised in its text.

    Attributes:
        path: of the file.
        rows: fields by the name of their column.
        notes: sentences for the user; none for a table as this package writes it.
        comments: lines of the file that are no rows.
        written_header: names of the columns as they are written in the file.
    """

    path: Path
    rows: list[dict[str, str]]
    notes: tuple[str, ...]
    comments: tuple[str, ...]
    written_header: tuple[str, ...]

    def requiring(self, required: Sequence[str], units: Collection[str] = ("s",)) -> "Table":
        """Return the table with further required columns under their names, as `read_table` does.

        The columns that are needed may be known only after a look at the table.

        Raises:
            ValueError: a required column is missing.
        """
        header, missing = _named(self.written_header, required, units)
        if missing:
            raise ValueError(
                f"{self.path}: expected the columns {', '.join(required)}; missing "
                f"{', '.join(missing)}" + _other_units(self.written_header, missing)
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
        path: of the file.
        required: names of columns that the table must have.
        units: in which the caller takes required columns whose names have no unit.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: it is not a CSV text, a required column is missing, a column occurs twice, a
            row has another number of fields than the header, a view's name is no name, or numbers
            have two readings.
    """
    text = read_table_text(path, lambda header: _named(header, required, units)[1] == [])
    rows = [dict(zip(text.header, fields, strict=True)) for fields in text.rows]
    written = Table(path, rows, _notes(path, text), text.comments, tuple(text.header))
    table = written.requiring(required, units)
    # Tables of detections have many rows of each view: each name is looked at once, in its first.
    views = [row.get(VIEW_COLUMN, "?") for row in table.rows]
    for view in dict.fromkeys(views):
        if (reason := name_problem(view)) is not None:
            problem = f"a view, {no_name(view, reason)}" if view else "an empty view"
            raise ValueError(f"{path}: row {1 + views.index(view)} has {problem}")
    return table


def _notes(path: Path, text: TableText) -> tuple[str, ...]:
    """Return what was recognised in the text of a table, as a sentence, or none."""
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
        found = named_unit(column)
        named.append(column if found is None else "_".join(filter(None, found)).lower())
    missing = []
    for name in required:
        if name in named:
            continue
        # Without regard to case; a unit is allowed where it is the caller's own.
        wanted = {name.lower(), *(f"{name}_{unit}".lower() for unit in units)}
        fitting = [k for k, column in enumerate(named) if column.lower() in wanted]
        if len(fitting) == 1:
            named[fitting[0]] = name
        else:
            missing.append(name)
    return named, missing


def _other_units(header: Sequence[str], missing: Sequence[str]) -> str:
    """Return the columns with a missing name in another unit, as a clause; empty without any."""
    names = {name.lower() for name in missing}
    other = [
        repr(column)
        for column in header
        if (found := named_unit(column)) is not None and found[0].lower() in names
    ]
    return f" (found {', '.join(other)}: a unit that is not expected here)" if other else ""


def refuse_truncated(path: Path, rows: Sequence[object], stated_rows: int | None) -> None:
    """Raise a ValueError if a table has another number of rows than its description states."""
    if stated_rows is not None and len(rows) != stated_rows:
        raise ValueError(
            f"{path}: {len(rows)} rows, but the description says {stated_rows}: was the file cut?"
        )


def parse_numbers(
    path: Path, row: dict[str, str], columns: Sequence[str], view: str, require_finite: bool = True
) -> np.ndarray:
    """Return some columns of a row as numbers.

    Args:
        path: of the table, for error messages.
        row: one row of the table, by column name.
        columns: names of the columns to return.
        view: id of the row's view, for error messages.
        require_finite: whether to refuse NaN and infinity; False where the caller may mask such a
            view.

    Raises:
        ValueError: a field is not a number; the message names the file, the view and the column.
    """
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
    """Raise a ValueError that names the first position beyond the reach of any robot.

    Args:
        path: of the file that the positions are from, for the error message.
        positions: `(views, 3)`, m; each coordinate is limited by `MAX_COORDINATE`, and NaN passes.
        labels: one view id for each position.
    """
    for label, position in zip(labels, positions, strict=True):
        for axis, value in zip("xyz", position, strict=True):
            if abs(value) > MAX_COORDINATE:
                raise ValueError(
                    f"{path}: view {label}: {axis} is {value:.6g} m, more than "
                    f"{MAX_COORDINATE:g} m from the origin: millimetres given as metres?"
                )


def write_table(
    path: Path,
    header: Sequence[str],
    rows: Sequence[Sequence[object]],
    comments: Sequence[str] = (),
) -> None:
    """Write a CSV file, complete or not at all; floats keep every digit.

    Args:
        path: of the file.
        header: names of the columns.
        rows: the fields of each row.
        comments: lines to write at the end, which readers ignore.

    Raises:
        ValueError: a view's name with which the file could not be read back; nothing is written.
    """
    if VIEW_COLUMN in header:
        column = list(header).index(VIEW_COLUMN)
        require_readable(f"{path}: view", dict.fromkeys(row[column] for row in rows))
    # `repr` gives the shortest text from which Python reads the same float again.
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([repr(float(x)) if isinstance(x, float) else x for x in row] for row in rows)
    text.writelines(f"# {comment}\n" for comment in comments)
    write_atomically(path, text.getvalue())
