"""CSV tables with a header, read with errors that name the file, row and column."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..files import write_atomically


def read_table(path: Path, required: Sequence[str]) -> list[dict[str, str]]:
    """Rows of a CSV file as mappings from its header.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: a required column is missing, or a row has another number of fields.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.reader(line for line in file if line.strip() and not line.startswith("#"))
        header = [name.strip() for name in next(reader, [])]
        missing = [name for name in required if name not in header]
        if missing:
            raise ValueError(
                f"{path}: expected the columns {', '.join(required)}; missing {', '.join(missing)}"
            )
        rows = []
        for number, fields in enumerate(reader, start=1):
            if len(fields) != len(header):
                raise ValueError(
                    f"{path}: row {number} has {len(fields)} fields, the header {len(header)}"
                )
            rows.append({key: field.strip() for key, field in zip(header, fields, strict=True)})
    return rows


def numbers(path: Path, row: dict[str, str], columns: Sequence[str], view: str) -> np.ndarray:
    """Some columns of a row as numbers.

    Raises:
        ValueError: naming the file, the view and the column of what is not a number.
    """
    values = np.empty(len(columns))
    for k, column in enumerate(columns):
        try:
            values[k] = float(row[column])
        except ValueError:
            raise ValueError(
                f"{path}: view {view}: {column} is {row[column]!r}, not a number"
            ) from None
    return values


def write_table(path: Path, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Write a CSV file, whole or not at all; floats keep every digit."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([repr(float(x)) if isinstance(x, float) else x for x in row] for row in rows)
    write_atomically(path, text.getvalue())


def duplicates(ids: Sequence[str]) -> list[str]:
    """What occurs more than once, in order."""
    return sorted({name for name in ids if list(ids).count(name) > 1})
