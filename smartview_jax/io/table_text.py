"""Split the text of a CSV table into fields, whichever program and country wrote it.

Spreadsheets write tables with the separator, the decimal sign and the encoding of the user's
settings. Each of them is recognised where only one reading is possible, and listed in `seen`, so
that the user is told; where two readings are possible, the table is refused with the cure.
"""

import codecs
import csv
import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

DELIMITERS = {",": "commas", ";": "semicolons", "\t": "tabs"}
"""The separators that are recognised, with their names; the first is the usual one."""

VIEW_COLUMN = "view"
"""The column of names, in which a comma is no decimal comma."""

_BYTE_ORDER_MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
_DECIMAL_COMMA = re.compile(r"[-+]?[0-9]*,[0-9]+(?:[eE][-+]?[0-9]+)?")
_DECIMAL_POINT = re.compile(r"[-+]?[0-9]*\.[0-9]+(?:[eE][-+]?[0-9]+)?")
_THOUSANDS = re.compile(r"[-+]?[1-9][0-9]{0,2}(?:,[0-9]{3})+")
_MANY_COMMAS = re.compile(r"[-+]?[0-9]+(?:,[0-9]+){2,}")
_SEPARATOR_LINE = re.compile(r"sep=[,;\t]?", re.IGNORECASE)
_INTEGER = re.compile(r"[-+]?[0-9]+")
_UNIT_IN_HEADER = re.compile(r"(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]")
_UNIT_NAMES = {"°": "deg", "degree": "deg", "degrees": "deg", "º": "deg"}


class TableText(NamedTuple):
    """The fields of a table, and what was recognised in its text.

    Attributes:
        header: names of the columns.
        rows: fields of each row, as many as the header has unless the table is wrong.
        seen: what differs from a table of commas and decimal points in UTF-8, for the user.
    """

    header: list[str]
    rows: list[list[str]]
    seen: tuple[str, ...]


def decoded_lines(path: Path) -> tuple[list[str], str]:
    """Return the lines of a table's file, and the name of its encoding where it is not UTF-8.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: it is no text; the message says how to save it.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    content = path.read_bytes()
    marked = next((e for mark, e in _BYTE_ORDER_MARKS.items() if content.startswith(mark)), None)
    # Bytes of a Windows code page are hardly ever valid UTF-8, so that UTF-8 is tried first.
    for encoding in (marked,) if marked else ("utf-8", "cp1252"):
        try:
            text = content.decode(encoding)
        except UnicodeDecodeError:
            continue
        if "\0" in text:
            break
        return text.splitlines(), "" if encoding.startswith("utf-8") else encoding.upper()
    raise ValueError(
        f"{path}: not readable as a text in UTF-8, UTF-16 or cp1252: save it as 'CSV UTF-8'"
    )


def read_table_text(path: Path, is_header: Callable[[Sequence[str]], bool]) -> TableText:
    """Read the fields of a table.

    Args:
        path: of the table.
        is_header: whether the names of columns are those that the caller needs; decides between
            separators.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: it is no table, or has two readings; the message names the cure.
    """
    lines, encoding = decoded_lines(path)
    seen = [f"in the encoding {encoding}"] if encoding else []
    # Empty lines are ignored, and comments, which begin with "#".
    lines = [line for line in lines if line.strip() and line[0] != "#"]
    # Excel's own first line, which names the separator; the header shows it as well.
    if lines and _SEPARATOR_LINE.fullmatch(lines[0].strip()):
        lines = lines[1:]
    try:
        table, delimiter = _split(lines, is_header)
    except csv.Error as error:
        raise ValueError(f"{path}: not readable as a table: {error}") from error
    if not table:
        return TableText([], [], ())
    if delimiter != ",":
        seen.append(f"separated by {DELIMITERS[delimiter]}")
    header, rows = table[0], [row for row in table[1:] if any(row)]
    if len(rows) < len(table) - 1:
        seen.append(f"{len(table) - 1 - len(rows)} rows without a value left out")
    while header and not header[-1]:
        header = header[:-1]
    if repeated := duplicates(header):
        raise ValueError(f"{path}: column {', '.join(repeated)} comes twice")
    # A row that ends in a separator has one more field, which is empty.
    trimmed = [_without_empty_end(row, len(header)) for row in rows]
    if trimmed != rows or len(header) < len(table[0]):
        seen.append("separators at the ends of rows ignored")
    for number, fields in enumerate(trimmed, start=1):
        if len(fields) != len(header):
            raise ValueError(f"{path}: row {number} has {_wrong_count(fields, header, delimiter)}")
    if _has_decimal_commas(path, header, trimmed):
        seen.append("with a decimal comma")
        trimmed = [
            [
                field.replace(",", ".")
                if name != VIEW_COLUMN and _DECIMAL_COMMA.fullmatch(field)
                else field
                for name, field in zip(header, row, strict=True)
            ]
            for row in trimmed
        ]
    return TableText(header, trimmed, tuple(seen))


def named_unit(column: str) -> tuple[str, str] | None:
    """Return name and unit of a column such as `X [mm]` or `A (°)`; None without brackets."""
    found = _UNIT_IN_HEADER.fullmatch(column)
    if found is None:
        return None
    unit = found[2].lower()
    return found[1], _UNIT_NAMES.get(unit, unit)


def _split(
    lines: Sequence[str], is_header: Callable[[Sequence[str]], bool]
) -> tuple[list[list[str]], str]:
    """Return the fields of all lines, and the separator that gives the header best."""

    def fields(delimiter: str, some: Sequence[str]) -> list[list[str]]:
        """Return the fields of some lines."""
        rows = csv.reader(some, delimiter=delimiter, skipinitialspace=True)
        return [[text.strip() for text in row] for row in rows]

    def quality(delimiter: str) -> tuple[bool, int]:
        """Return whether the needed columns are found, and how many columns there are."""
        header = next(iter(fields(delimiter, lines[:1])), [])
        return is_header(header), len(header)

    # Of equal separators the first is taken, the comma.
    delimiter = max(DELIMITERS, key=quality)
    return fields(delimiter, lines), delimiter


def _without_empty_end(row: list[str], count: int) -> list[str]:
    """Return a row without the empty fields beyond the number of columns."""
    return row[:count] if not any(row[count:]) else row


def _wrong_count(fields: Sequence[str], header: Sequence[str], delimiter: str) -> str:
    """Return what is said of a row with another number of fields than the header."""
    text = f"{len(fields)} fields, the header {len(header)}"
    if delimiter == "," and len(fields) == 2 * len(header) - (VIEW_COLUMN in header):
        text += (
            ": decimal commas in a table separated by commas? Write numbers with a decimal point, "
            "or separate the columns by semicolons"
        )
    return text


def _has_decimal_commas(path: Path, header: Sequence[str], rows: Sequence[Sequence[str]]) -> bool:
    """Return whether the numbers of a table have decimal commas.

    Raises:
        ValueError: a comma may separate thousands, or some numbers have points.
    """
    fields = [
        field
        for row in rows
        for name, field in zip(header, row, strict=True)
        if name != VIEW_COLUMN
    ]
    with_comma = [field for field in fields if "," in field and _DECIMAL_COMMA.fullmatch(field)]
    many = next((field for field in fields if "," in field and _MANY_COMMAS.fullmatch(field)), None)
    cure = "write numbers with a decimal point and without separators of thousands"
    if many is not None:
        raise ValueError(f"{path}: {many!r} has several commas: {cure}")
    if not with_comma:
        return False
    pointed = next((field for field in fields if _DECIMAL_POINT.fullmatch(field)), None)
    if pointed is not None:
        raise ValueError(
            f"{path}: {with_comma[0]!r} has a comma and {pointed!r} a decimal point: {cure}"
        )
    # Three digits after every comma may be thousands, if numbers below a thousand have none.
    grouped = all(_THOUSANDS.fullmatch(field) for field in with_comma)
    if grouped and any(_INTEGER.fullmatch(field) for field in fields):
        raise ValueError(
            f"{path}: the comma in {with_comma[0]!r} may be a decimal comma or separate "
            f"thousands: {cure}"
        )
    return True


def duplicates(names: Sequence[str]) -> list[str]:
    """Return the names that occur more than once, sorted."""
    return sorted(name for name, count in Counter(names).items() if count > 1)
