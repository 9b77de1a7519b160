"""Read and write CSV tables with a header; errors name the file, the row and the column."""

import csv
import io
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..files import read_text, write_atomically
from ..schemas.messages import shortened_repr

MAX_COORDINATE = 100.0
"""Largest coordinate of a pose, m: a larger one was given in another unit, such as mm."""

MAX_NAME_LENGTH = 200
"""Largest number of characters of a view's name, which is a part of file names."""

_NUMBER = re.compile(
    r"[-+]?(?:(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|nan|inf|infinity)", re.IGNORECASE
)


def read_table(path: Path, required: Sequence[str]) -> list[dict[str, str]]:
    """Read the rows of a CSV file as mappings from its header.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: it is not a CSV text, a required column is missing, a column occurs twice, a
            row has another number of fields than the header, or a view's name is empty or too long.
    """
    # Empty lines are ignored, and comments, which begin with "#".
    lines = (line for line in read_text(path).splitlines() if line.strip() and line[0] != "#")
    try:
        table = [[field.strip() for field in fields] for fields in csv.reader(lines)]
    except csv.Error as error:
        raise ValueError(f"{path}: not readable as a table: {error}") from error
    header, rows = table[0] if table else [], table[1:]
    missing = [name for name in required if name not in header]
    if missing:
        raise ValueError(
            f"{path}: expected the columns {', '.join(required)}; missing {', '.join(missing)}"
        )
    if repeated := duplicates(header):
        raise ValueError(f"{path}: column {', '.join(repeated)} comes twice")
    for number, fields in enumerate(rows, start=1):
        if len(fields) != len(header):
            raise ValueError(
                f"{path}: row {number} has {len(fields)} fields, the header {len(header)}"
            )
    records = [dict(zip(header, fields, strict=True)) for fields in rows]
    for number, row in enumerate(records, start=1):
        if not 0 < len(row.get("view", "?")) <= MAX_NAME_LENGTH:
            problem = "too long a name of a" if row["view"] else "an empty"
            raise ValueError(f"{path}: row {number} has {problem} view")
    return records


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


def is_number(text: str) -> bool:
    """Return whether a text is a decimal number in ASCII digits, NaN or infinity.

    The check is needed because `float` also accepts 1_0 and the digits of other scripts.
    """
    return _NUMBER.fullmatch(text) is not None


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
    """
    # `repr` gives the shortest text from which Python reads the same float again.
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([repr(float(x)) if isinstance(x, float) else x for x in row] for row in rows)
    text.writelines(f"# {comment}\n" for comment in comments)
    write_atomically(path, text.getvalue())


def duplicates(ids: Sequence[str]) -> list[str]:
    """Return the ids that occur more than once, sorted."""
    return sorted(name for name, count in Counter(ids).items() if count > 1)
