"""Mistakes in text files: encodings, line ends, characters, lines and tables."""

import random
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

Change = Callable[[bytes, random.Random], bytes | None]
"""Return a content with a mistake in it; None where it has no place for this mistake."""

TextChange = Callable[[str, random.Random], str | None]
"""The same of a text."""


class Mutation(NamedTuple):
    """A kind of mistake.

    Attributes:
        change: makes it.
        keeps_values: whether a reader that accepts the file must return the values that were in it
            before: the same numbers in another spelling or encoding, or data that were cut.
    """

    change: Change
    keeps_values: bool = False


FLOAT = re.compile(r"(?<![\w.+-])-?[0-9]+\.[0-9]+(?:[eE][-+]?[0-9]+)?(?![\w.+-])")
"""A number with a decimal point: not part of a name, a version or a date."""

MANY_LETTERS = 20_000
"""Letters of a line that is far too long."""


def of_text(change: TextChange, keeps_values: bool = False) -> Mutation:
    """Return the mutation of a content that changes its text."""

    def changed(content: bytes, rng: random.Random) -> bytes | None:
        text = change(content.decode("utf-8", "replace"), rng)
        return None if text is None else text.encode("utf-8", "surrogatepass")

    return Mutation(changed, keeps_values)


def _inserted(text: str, word: str, rng: random.Random) -> str:
    place = rng.randrange(len(text) + 1)
    return text[:place] + word + text[place:]


def inserting(*words: str) -> Mutation:
    """Return the mutation that puts one of some words anywhere."""
    return of_text(lambda text, rng: _inserted(text, rng.choice(words), rng))


def of_lines(
    change: Callable[[list[str], random.Random], list[str] | None], keeps_values: bool = False
) -> Mutation:
    """Return the mutation of a text that changes its list of lines."""

    def changed(text: str, rng: random.Random) -> str | None:
        lines = change(text.split("\n"), rng)
        return None if lines is None else "\n".join(lines)

    return of_text(changed, keeps_values)


def of_one_line(change: Callable[[str, random.Random], str | None]) -> Mutation:
    """Return the mutation that changes one line that is not empty."""

    def changed(lines: list[str], rng: random.Random) -> list[str] | None:
        full = [k for k, line in enumerate(lines) if line.strip()]
        if not full:
            return None
        k = rng.choice(full)
        line = change(lines[k], rng)
        return None if line is None else [*lines[:k], line, *lines[k + 1 :]]

    return of_lines(changed)


def of_table(
    change: Callable[[list[list[str]], random.Random], list[list[str]] | None],
    keeps_values: bool = False,
) -> Mutation:
    """Return the mutation of a table's fields; the table has commas."""

    def changed(lines: list[str], rng: random.Random) -> list[str] | None:
        rows = [line.split(",") for line in lines if line]
        is_table = len(rows) > 1 and len({len(row) for row in rows}) == 1 and len(rows[0]) > 1
        found = change(rows, rng) if is_table else None
        return None if found is None else [*(",".join(row) for row in found), ""]

    return of_lines(changed, keeps_values)


def _cut(content: bytes, rng: random.Random) -> bytes:
    return content[: rng.randrange(len(content) + 1)]


def _without_beginning(content: bytes, rng: random.Random) -> bytes:
    return content[rng.randrange(len(content) + 1) :]


def _other_byte(content: bytes, rng: random.Random) -> bytes:
    k = rng.randrange(len(content) + 1)
    return content[:k] + bytes([rng.randrange(256)]) + content[k + 1 :]


def _lost_bytes(content: bytes, rng: random.Random) -> bytes:
    k = rng.randrange(len(content) + 1)
    return content[:k] + content[k + rng.randrange(1, 9) :]


def _broken_utf8(content: bytes, rng: random.Random) -> bytes:
    k = rng.randrange(len(content) + 1)
    return content[:k] + rng.choice((b"\xff", b"\xc3", b"\xed\xa0\x80", b"\xf8\x88")) + content[k:]


def _recoded(*encodings: str, mark: str = "") -> Change:
    def change(content: bytes, rng: random.Random) -> bytes:
        text = mark + content.decode("utf-8", "replace")
        return text.encode(rng.choice(encodings), "replace")

    return change


def _accented(encoding: str, letters: str) -> Change:
    """Letters outside ASCII, in a code page."""

    def change(content: bytes, rng: random.Random) -> bytes:
        text = _inserted(content.decode("utf-8", "replace"), rng.choice(letters), rng)
        return text.encode(encoding, "replace")

    return change


def _one_line_end(text: str, end: str, rng: random.Random) -> str | None:
    ends = [k for k, letter in enumerate(text) if letter == "\n"]
    if not ends:
        return None
    k = rng.choice(ends)
    return text[:k] + end + text[k + 1 :]


def _mixed_ends(text: str, rng: random.Random) -> str:
    return "".join(rng.choice(("\r\n", "\r", "\n")) if x == "\n" else x for x in text)


ENCODINGS: dict[str, Mutation] = {
    "cut": Mutation(_cut),
    "beginning lost": Mutation(_without_beginning),
    "byte changed": Mutation(_other_byte),
    "bytes lost": Mutation(_lost_bytes),
    "broken UTF-8": Mutation(_broken_utf8),
    "byte order mark": Mutation(lambda content, rng: b"\xef\xbb\xbf" + content, True),
    "byte order mark twice": Mutation(lambda content, rng: b"\xef\xbb\xbf" * 2 + content, True),
    "byte order mark inside": inserting("\ufeff"),
    "UTF-16": Mutation(_recoded("utf-16-le", "utf-16-be", mark="\ufeff"), True),
    "UTF-16 without a mark": Mutation(_recoded("utf-16-le", "utf-16-be"), True),
    "UTF-32": Mutation(_recoded("utf-32", "utf-32-le", "utf-32-be", mark="\ufeff"), True),
    "UTF-7": Mutation(_recoded("utf-7")),
    "EBCDIC": Mutation(_recoded("cp037"), True),
    "cp1252": Mutation(_accented("cp1252", "é€“–°\u00a0")),
    "latin-1": Mutation(_accented("latin-1", "éß\x85\xad±")),
    "Shift JIS": Mutation(_accented("shift_jis", "度ｍ−＋")),
    "NUL inside": inserting("\0"),
    "control character": inserting("\x01", "\x07", "\x08", "\x1a", "\x1b[31m", "\x7f", "\x80"),
    "lone surrogate": inserting("\ud800", "\udfff"),
    "zero-width character": inserting("\u200b", "\u200d", "\u2060", "\u00ad", "\ufe0f"),
    "right-to-left mark": inserting("\u200f", "\u202e", "\u2067", "\u061c"),
    "combining mark": inserting("\u0301", "\u0332", "\u20e3"),
    "CR LF": of_text(lambda text, rng: text.replace("\n", "\r\n"), True),
    "CR only": of_text(lambda text, rng: text.replace("\n", "\r"), True),
    "mixed line ends": of_text(_mixed_ends, True),
    "Unicode line end": of_text(
        lambda text, rng: _one_line_end(text, rng.choice("\u2028\u2029\x85\x0b\x0c\x1c"), rng)
    ),
    "Unicode line end inside": inserting("\u2028", "\u2029", "\x85", "\x0b", "\x0c", "\x1e"),
    "no last line end": of_text(lambda text, rng: text.rstrip("\n"), True),
    "many last line ends": of_text(lambda text, rng: text + "\n" * rng.randrange(1, 9), True),
    "blanks at line ends": of_text(lambda text, rng: text.replace("\n", "  \n"), True),
    "end-of-file mark": of_text(lambda text, rng: text + "\x1a", True),
}
"""Mistakes in bytes, encodings and characters."""


# Lines and tables.


def _repeated_line(lines: list[str], rng: random.Random) -> list[str]:
    k, j = rng.randrange(len(lines)), rng.randrange(len(lines) + 1)
    return [*lines[:j], lines[k], *lines[j:]]


def _lost_line(lines: list[str], rng: random.Random) -> list[str]:
    k = rng.randrange(len(lines))
    return lines[:k] + lines[k + 1 :]


def _exchanged_lines(lines: list[str], rng: random.Random) -> list[str]:
    k, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[k], lines[j] = lines[j], lines[k]
    return lines


def _with_line(*words: str) -> Callable[[list[str], random.Random], list[str]]:
    def change(lines: list[str], rng: random.Random) -> list[str]:
        k = rng.randrange(len(lines) + 1)
        return [*lines[:k], rng.choice(words), *lines[k:]]

    return change


def _inside_line(*words: str) -> Callable[[str, random.Random], str]:
    def change(line: str, rng: random.Random) -> str:
        return _inserted(line, rng.choice(words), rng)

    return change


def _of_columns(
    change: Callable[[list[str], int, int], list[str]], header_too: bool = True
) -> Callable[[list[list[str]], random.Random], list[list[str]]]:
    """The change of each row, with two columns drawn once; the header keeps its names if asked."""

    def changed(rows: list[list[str]], rng: random.Random) -> list[list[str]]:
        k, j = rng.sample(range(len(rows[0])), 2)
        kept = 0 if header_too else 1
        return rows[:kept] + [change(list(row), k, j) for row in rows[kept:]]

    return changed


def _exchanged(row: list[str], k: int, j: int) -> list[str]:
    row[k], row[j] = row[j], row[k]
    return row


def _repeated_name(rows: list[list[str]], rng: random.Random) -> list[list[str]]:
    k, j = rng.randrange(1, len(rows)), rng.randrange(1, len(rows))
    rows[k][0] = rows[j][0]
    return rows


def _unit_in_header(rows: list[list[str]], rng: random.Random) -> list[list[str]]:
    k = rng.randrange(len(rows[0]))
    unit = rng.choice(("[mm]", "(mm)", "[m]", "(deg)", "[°]", "[rad]", "[inch]", "_mm", "[", "[]"))
    rows[0][k] += f" {unit}"
    return rows


def _in_quotes(rows: list[list[str]], rng: random.Random) -> list[list[str]]:
    return [[f'"{field}"' for field in row] for row in rows]


def _separated(mark: str) -> Callable[[list[list[str]], random.Random], list[list[str]]]:
    return lambda rows, rng: [[mark.join(row)] for row in rows]


TABLES: dict[str, Mutation] = {
    "line twice": of_lines(_repeated_line),
    "line lost": of_lines(_lost_line),
    "lines exchanged": of_lines(_exchanged_lines),
    "lines in another order": of_lines(lambda lines, rng: rng.sample(lines, len(lines))),
    "first line twice": of_lines(lambda lines, rng: [lines[0], *lines]),
    "first line later again": of_lines(lambda lines, rng: [*lines[:2], lines[0], *lines[2:]]),
    "first line lost": of_lines(lambda lines, rng: lines[1:]),
    "empty line": of_lines(_with_line("", "  ", "\t")),
    "line of separators": of_lines(_with_line(",,,,", ";;;", ",", ", , , ,")),
    "line of NaN": of_one_line(lambda line, rng: FLOAT.sub("nan", line)),
    "line scaled": of_one_line(
        lambda line, rng: FLOAT.sub(lambda found: repr(1e3 * float(found[0])), line)
    ),
    "strange line": of_lines(
        _with_line(
            "sep=;", "# comment", "<html>", "%YAML 1.1", "---", "...", "{", "null", "<<<<<<<"
        )
    ),
    "comment inside": of_one_line(_inside_line("#", " # ", "//", "/* ", "<!--", "%", "'")),
    "separators at the end": of_lines(
        lambda lines, rng: [line and line + "," * rng.choice((1, 3)) for line in lines]
    ),
    "a separator more": of_one_line(_inside_line(",", ";", "\t", "|", ", ,")),
    "unbalanced quote": of_one_line(_inside_line('"', "'", '""', '"\n', "`")),
    "unbalanced bracket": of_one_line(_inside_line("[", "]", "{", "}", "(", "<", ">")),
    "very long line": of_one_line(_inside_line("0" * MANY_LETTERS, "a," * MANY_LETTERS)),
    "tab at the beginning": of_one_line(lambda line, rng: "\t" + line),
    "indented": of_one_line(lambda line, rng: " " * rng.randrange(1, 9) + line),
    "not indented": of_one_line(lambda line, rng: line.lstrip()),
    "field lost": of_one_line(lambda line, rng: FLOAT.sub("", line, count=1)),
    "column lost": of_table(_of_columns(lambda row, k, j: row[:k] + row[k + 1 :])),
    "column twice": of_table(_of_columns(lambda row, k, j: [*row, row[k]])),
    "columns exchanged": of_table(_of_columns(_exchanged), True),
    "values of columns exchanged": of_table(_of_columns(_exchanged, header_too=False)),
    "unknown column": of_table(lambda rows, rng: [[*row, "7"] for row in rows]),
    "name twice": of_table(_repeated_name),
    "unit in the header": of_table(_unit_in_header),
    "all in quotes": of_table(_in_quotes, True),
    "semicolons": of_table(_separated(";"), True),
    "tabs": of_table(_separated("\t"), True),
    "bars": of_table(_separated("|"), True),
}
"""Mistakes in lines and tables."""


def together(contents: Sequence[bytes]) -> dict[str, Mutation]:
    """Return the mistakes in which a file has to do with others.

    Args:
        contents: of good files of all formats.
    """
    return {
        "two files in one": Mutation(
            lambda content, rng: content + rng.choice([content, *contents])
        ),
        "file of another format": Mutation(lambda content, rng: rng.choice(list(contents))),
        "empty file": Mutation(lambda content, rng: rng.choice((b"", b"\n", b" ", b"\0" * 512))),
    }
