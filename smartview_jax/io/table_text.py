"""Split the text of a CSV table into fields, for any spreadsheet program and locale.

Spreadsheets write tables with the separator, the decimal sign and the encoding of the user's
settings. An unambiguous format is recognised and listed in `seen`, for the user; an ambiguous table
is refused, with advice how to write it.
"""

import codecs
import csv
import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from ..argument_checks import NUMBER_PATTERN
from ..files import require_file

DELIMITERS = {",": "commas", ";": "semicolons", "\t": "tabs"}
"""The separators that are recognised, with their names; the first is the default."""

_NUMBER_SEPARATORS = (r"[ \t]*;[ \t]*", r" *\t *", r"[ \t,]+", r"[ \t]+", r"[ \t,;]+")
"""Separators of numbers in rows without a header, best first; else a comma is a decimal comma."""

VIEW_COLUMN = "view"
"""The column of names, in which a comma is not a decimal comma."""

_BYTE_ORDER_MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
_LINE_END = re.compile(r"\r\n|\r|\n")
_DECIMAL_COMMA = re.compile(r"[-+]?[0-9]*,[0-9]+(?:[eE][-+]?[0-9]+)?")
_DECIMAL_POINT = re.compile(r"[-+]?[0-9]*\.[0-9]+(?:[eE][-+]?[0-9]+)?")
_THOUSANDS = re.compile(r"[-+]?[1-9][0-9]{0,2}(?:,[0-9]{3})+")
_MANY_COMMAS = re.compile(r"[-+]?[0-9]+(?:,[0-9]+){2,}")
_THOUSANDS_OF_POINTS = re.compile(r"[-+]?[1-9][0-9]{0,2}(?:\.[0-9]{3})+,[0-9]+")
_THOUSANDS_OF_COMMAS = re.compile(r"[-+]?[1-9][0-9]{0,2}(?:,[0-9]{3})+\.[0-9]+")
# Non-breaking spaces and Swiss apostrophes. A plain space is not among them, because it may also
# separate two numbers.
_THOUSANDS_OF_BLANKS = re.compile(
    "[-+]?[1-9][0-9]{0,2}([\u00a0\u2009\u202f'\u2019])[0-9]{3}(?:\\1[0-9]{3})*(?:[.,][0-9]+)?"
)
_MINUS_SIGNS = {0x2212: "-", 0x2013: "-"}
"""Map the Unicode minus sign and the en dash to a hyphen."""

_WITH_MINUS_SIGN = re.compile(
    "[-+\u2212\u2013]?[0-9.,\u00a0\u2009\u202f'\u2019]+(?:[eE][-+\u2212\u2013]?[0-9]+)?"
)
_NUMBER = re.compile(rf"{NUMBER_PATTERN}|[-+]?(?:nan|inf|infinity)", re.IGNORECASE)
_SEPARATOR_LINE = re.compile(r"sep=[,;\t]?", re.IGNORECASE)
_INTEGER = re.compile(r"[-+]?[0-9]+")
_OPENING, _CLOSING = ("[", "("), ("]", ")")
_UNIT_NAMES = {"°": "deg", "degree": "deg", "degrees": "deg", "º": "deg"}


class TableText(NamedTuple):
    """The fields of a table, and what was recognised in its text.

    Attributes:
        rows: fields of each row, as many as the header has.
        seen: differences from a UTF-8 table with commas and decimal points, for the user.
        comments: lines that begin with "#".
    """

    header: list[str]
    rows: list[list[str]]
    seen: tuple[str, ...]
    comments: tuple[str, ...] = ()


class NumberRows(NamedTuple):
    """Rows of numbers without a header, and what was recognised in their text.

    Attributes:
        fields: fields of each row, equally many in all rows.
        lines: line number of each row, from 1.
        seen: as in `TableText`.
    """

    fields: list[list[str]]
    lines: list[int]
    seen: tuple[str, ...]


def decoded_lines(path: Path) -> tuple[list[str], str]:
    """Return the lines of a table's file, and the name of its encoding unless it is UTF-8."""
    require_file(path)
    content = path.read_bytes()
    marked = next((e for mark, e in _BYTE_ORDER_MARKS.items() if content.startswith(mark)), None)
    # UTF-8 is tried first, because text in a Windows code page is hardly ever valid UTF-8.
    for encoding in (marked,) if marked else ("utf-8", "cp1252"):
        try:
            text = content.decode(encoding)
        except UnicodeDecodeError:
            continue
        if "\0" in text:
            break
        # `splitlines` would also split at rarer characters, such as U+2028 within a name.
        return _LINE_END.split(text), "" if encoding.startswith("utf-8") else encoding.upper()
    raise ValueError(f"{path}: not a text in UTF-8, UTF-16 or cp1252: save it as 'CSV UTF-8'")


def read_table_text(path: Path, is_header: Callable[[Sequence[str]], bool]) -> TableText:
    """Read a table's fields, with the separator that gives a header which the caller accepts."""
    lines, encoding = decoded_lines(path)
    seen = [f"in the encoding {encoding}"] if encoding else []
    comments = tuple(line for line in lines if line.startswith("#"))
    lines = [line for line in lines if line.strip() and line[0] != "#"]
    # Excel's first line names the separator, which is recognised from the header anyway.
    if lines and _SEPARATOR_LINE.fullmatch(lines[0].strip()):
        lines = lines[1:]
    try:
        table, delimiter = _split(lines, is_header)
    except csv.Error as error:
        raise ValueError(f"{path}: not readable as a table: {error}") from error
    if not table:
        return TableText([], [], (), comments)
    if delimiter != ",":
        seen.append(f"separated by {DELIMITERS[delimiter]}")
    header, rows = table[0], [row for row in table[1:] if any(row)]
    if len(rows) < len(table) - 1:
        seen.append(f"{len(table) - 1 - len(rows)} rows without a value left out")
    while header and not header[-1]:
        header = header[:-1]
    if repeated := duplicates(header):
        raise ValueError(f"{path}: column {', '.join(repeated)} comes twice")
    trimmed = _without_empty_ends(rows, len(header))
    if trimmed != rows or len(header) < len(table[0]):
        seen.append("separators at the ends of rows ignored")
    for number, fields in enumerate(trimmed, start=1):
        if len(fields) != len(header):
            raise ValueError(f"{path}: row {number} has {_wrong_count(fields, header, delimiter)}")
    # View names are never numbers, even if they look like numbers.
    numeric = [k for k, name in enumerate(header) if name.lower() != VIEW_COLUMN]
    columns, recognised = _plain_numbers(path, [[row[k] for k in numeric] for row in trimmed])
    if recognised:
        for row, fields in zip(trimmed, columns, strict=True):
            for k, field in zip(numeric, fields, strict=True):
                row[k] = field
    return TableText(header, trimmed, (*seen, *recognised), comments)


def read_number_rows(path: Path, count: int) -> NumberRows:
    """Read rows of `count` numbers each, separated by blanks, tabs, commas or semicolons."""
    lines, encoding = decoded_lines(path)
    texts = {number: line.split("#")[0].strip() for number, line in enumerate(lines, start=1)}
    texts = {number: text for number, text in texts.items() if text}
    # The first separator that gives the right number of fields in all rows.
    for separator in _NUMBER_SEPARATORS:
        rows = [re.split(separator, text.rstrip(",;")) for text in texts.values()]
        if all(len(row) == count for row in rows):
            break
    else:
        for number, text in texts.items():
            fields = re.split(_NUMBER_SEPARATORS[-1], text)
            if not all(is_number(field) for field in fields):
                raise ValueError(f"{path}: line {number} is not a row of numbers")
            if len(fields) != count:
                raise ValueError(f"{path}: line {number} has {len(fields)} numbers, not {count}")
        raise ValueError(f"{path}: lines have different separators between the numbers")
    rows, recognised = _plain_numbers(path, rows)
    seen = (*((f"in the encoding {encoding}",) if encoding else ()), *recognised)
    return NumberRows(rows, list(texts), seen)


def _plain_numbers(path: Path, rows: list[list[str]]) -> tuple[list[list[str]], tuple[str, ...]]:
    """Return fields with numbers as Python writes them, and notes on what was changed."""
    seen: list[str] = []
    given = [field for row in rows for field in row]

    def changed(pattern: re.Pattern[str], change: Callable[[str], str], note: str) -> None:
        """Change every field that fits a pattern, and add a note if there was any."""
        nonlocal rows
        before = rows
        rows = [[change(f) if pattern.fullmatch(f) else f for f in row] for row in rows]
        if rows != before:
            seen.append(note)

    # Most tables have none of these characters; checking first saves passes over all fields.
    text = "\n".join(given)
    if not text.isascii():
        note = "with Unicode minus signs"
        changed(_WITH_MINUS_SIGN, lambda field: field.translate(_MINUS_SIGNS), note)
    if not text.isascii() or "'" in text:
        note = "with blanks or apostrophes between thousands"
        changed(_THOUSANDS_OF_BLANKS, lambda field: re.sub("[^-+0-9.,]", "", field), note)
    if "," in text:
        note = "with points between thousands"
        changed(_THOUSANDS_OF_POINTS, lambda field: field.replace(".", ""), note)
        note = "with commas between thousands"
        changed(_THOUSANDS_OF_COMMAS, lambda field: field.replace(",", ""), note)
        fields = [field for row in rows for field in row]
        if _has_decimal_commas(path, list(zip(fields, given, strict=True))):
            note = "with a decimal comma"
            changed(_DECIMAL_COMMA, lambda field: field.replace(",", "."), note)
    return rows, tuple(seen)


def named_unit(column: str) -> tuple[str, str] | None:
    """Return name and unit of a column such as `X [mm]` or `A (°)`; None without brackets."""
    # By hand: a regular expression needs hours for a field of a million brackets.
    if not column.endswith(_CLOSING):
        return None
    text = column[:-1]
    begin = max(text.rfind(bracket) for bracket in _CLOSING) + 1
    places = [place for bracket in _OPENING if (place := text.find(bracket, begin)) >= 0]
    if not places:
        return None
    unit = text[min(places) + 1 :].strip().lower()
    return text[: min(places)].rstrip(), _UNIT_NAMES.get(unit, unit)


def _split(
    lines: Sequence[str], is_header: Callable[[Sequence[str]], bool]
) -> tuple[list[list[str]], str]:
    """Return the fields of all lines, and the separator that gives the header best."""

    def fields(delimiter: str, some: Sequence[str]) -> list[list[str]]:
        """Return the fields of some lines."""
        # With line ends, so that an unclosed quote makes a field with a line end, which is refused.
        rows = csv.reader(
            [f"{line}\n" for line in some], delimiter=delimiter, skipinitialspace=True
        )
        return [[text.strip() for text in row] for row in rows]

    def quality(delimiter: str) -> tuple[bool, int]:
        """Return whether the header has the needed columns, and its number of columns."""
        header = next(iter(fields(delimiter, lines[:1])), [])
        return is_header(header), len(header)

    # `max` takes the first of equals, the comma.
    delimiter = max(DELIMITERS, key=quality)
    return fields(delimiter, lines), delimiter


def _without_empty_ends(rows: list[list[str]], count: int) -> list[list[str]]:
    """Return rows without the empty fields beyond the number of columns.

    A row that ends in a separator has one more field, which is empty. Where only some rows have it
    and the last column has gaps, such a row may as well have a decimal comma in it and a gap.
    """
    has_gaps = any(len(row) >= count > 0 and not row[count - 1] for row in rows)
    if has_gaps and len({len(row) for row in rows}) > 1:
        return rows
    return [row[:count] if not any(row[count:]) else row for row in rows]


def _wrong_count(fields: Sequence[str], header: Sequence[str], delimiter: str) -> str:
    """Return the error text for a row whose number of fields differs from the header's."""
    text = f"{len(fields)} fields, the header {len(header)}"
    if delimiter == "," and len(fields) == 2 * len(header) - (VIEW_COLUMN in header):
        text += (
            ": decimal commas in a table separated by commas? Write numbers with a decimal point, "
            "or separate the columns by semicolons"
        )
    elif delimiter == "," and len(fields) > len(header):
        text += (
            ": a comma within a name or a number? Quote the name, and write numbers without "
            "thousands separators"
        )
    return text


def is_number(text: str) -> bool:
    """Return whether a text is a decimal number in ASCII digits, NaN or infinity.

    The check is needed because `float` also accepts 1_0 and the digits of other scripts.
    """
    return _NUMBER.fullmatch(text) is not None


def _has_decimal_commas(path: Path, fields: Sequence[tuple[str, str]]) -> bool:
    """Return whether the numbers among some fields have decimal commas.

    Each field is given without unambiguous thousands separators, and as it was written.
    """

    def fitting(pattern: re.Pattern[str], mark: str) -> list[tuple[str, str]]:
        """Return the fields that contain a mark and fit a pattern."""
        return [pair for pair in fields if mark in pair[0] and pattern.fullmatch(pair[0])]

    with_comma = fitting(_DECIMAL_COMMA, ",")
    many = next((given for _, given in fitting(_MANY_COMMAS, ",")), None)
    advice = "write numbers with a decimal point and without thousands separators"
    if many is not None:
        raise ValueError(f"{path}: {many!r} has several commas: {advice}")
    if not with_comma:
        return False
    pointed = next((given for _, given in fitting(_DECIMAL_POINT, ".")), None)
    if pointed is not None:
        raise ValueError(
            f"{path}: {with_comma[0][1]!r} has a comma and {pointed!r} a decimal point: {advice}"
        )
    # Three digits after every comma may mean thousands, if smaller numbers have no comma.
    grouped = all(_THOUSANDS.fullmatch(field) for field, _ in with_comma)
    if grouped and any(_INTEGER.fullmatch(field) for field, _ in fields):
        raise ValueError(
            f"{path}: the comma in {with_comma[0][1]!r} may be a decimal comma or separate "
            f"thousands: {advice}"
        )
    return True


def duplicates(names: Sequence[str]) -> list[str]:
    """Return the names that occur more than once, sorted."""
    return sorted(name for name, count in Counter(names).items() if count > 1)
