"""Refuse wrong arguments, with a message that states what was expected."""

import contextlib
import difflib
import os
import re
import reprlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence

NUMBER_PATTERN = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
"""A finite decimal number in a text, as a regular expression without groups of its own."""

MAX_LISTED = 5
"""Largest number of names that a message lists, such as parameters or files."""

MAX_LISTED_VIEWS = 12
"""Largest number of names that a message lists where a person looks at each, such as views."""

_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = 60
_REPR.maxlevel = 2

MAX_COORDINATE = 100.0
"""Largest coordinate of a pose or of anything that a robot's camera sees, m.

A larger one is in another unit, such as millimetres.
"""


def shortened_repr(value: object) -> str:
    """Return a shortened representation of a value, which may be of any type and length."""
    return _REPR.repr(value)


def listed(names: Sequence[str], most: int = MAX_LISTED) -> str:
    """Return names separated by commas, such as "a, b and 3 more" of more than so many."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"


@contextlib.contextmanager
def errors_at(place: str | os.PathLike[str]) -> Iterator[None]:
    """Name the place, such as a file or an option, in the message of a ValueError raised within.

    Args:
        place: what the message is to begin with, before a colon.

    Raises:
        ValueError: `place: message`, from the error that was raised.
    """
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from error


def spelling_suggestion(word: object, known: Iterable[str]) -> str:
    """Return a suggestion of the most similar known name; empty if none is similar."""
    close = difflib.get_close_matches(str(word)[:100], list(known), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def require_one_of(name: str, value: object, known: Collection[str], others: str = "") -> None:
    """Raise a ValueError unless a value is one of those known; the nearest one is suggested.

    Args:
        name: name of the argument.
        value: the argument.
        known: the values that are accepted.
        others: words on what else is accepted, such as `, or an AbstractLens`.
    """
    if value not in known:
        raise ValueError(
            f"{name} is one of {', '.join(known)}{others}; found {shortened_repr(value)}"
            f"{spelling_suggestion(value, known)}"
        )


def require_instance(name: str, value: object, kind: type, hint: str = "") -> None:
    """Raise a TypeError unless an argument is of the expected class.

    Args:
        name: name of the argument.
        value: the argument.
        kind: the expected class.
        hint: what the caller may have meant.
    """
    if not isinstance(value, kind):
        message = f"{name}: expected {kind.__name__}, found {_described(value)}"
        raise TypeError(message + (f"; {hint}" if hint else ""))


def is_selected(name: str, paths: Collection[str]) -> bool:
    """Return whether a parameter has one of the paths as its name, or as the start of its name."""
    return any(name == path or name.startswith(f"{path}.") for path in paths)


def require_names(name: str, value: Sequence[str]) -> None:
    """Raise a ValueError for a single text where a sequence of names is expected."""
    # A text is itself a sequence, of its letters.
    if isinstance(value, str):
        raise ValueError(f"{name}: expected a list of names such as [{value!r}], found {value!r}")


def require_distinct(name: str, values: Sequence[str]) -> None:
    """Raise a ValueError that names every value given more than once.

    Args:
        name: name of the argument.
        values: names or ids, which must be unique.
    """
    repeated = sorted(value for value, count in Counter(values).items() if count > 1)
    if repeated:
        raise ValueError(f"{name}: {', '.join(repeated)} given more than once")


MAX_NAME_LENGTH = 200
"""Largest number of characters of a name."""

MAX_NAME_BYTES = 236
"""Largest number of bytes of a name in UTF-8.

File systems have names of up to 255 bytes; a suffix and a temporary file's prefix take the rest.
"""

_PATH_SEPARATORS = re.compile(r"[/\\]")
_DRIVE = re.compile(r"[A-Za-z]:")


def name_problem(text: object) -> str | None:
    """Return why a text is not a name; None for a name.

    This is the rule for every name that a user gives: of views, objects, faces, grasps, touches. It
    is read back unchanged from the first field of a table's row, from YAML and JSON, and from the
    name of a file within a folder.
    """
    if not isinstance(text, str):
        return f"a name is a text, not {_described(text)}"
    if not 0 < len(text) <= MAX_NAME_LENGTH:
        return f"a name has 1 to {MAX_NAME_LENGTH} characters, not {len(text)}"
    if not text.isprintable():
        return "it has a tab, a line end or another character that is not printable"
    if text != text.strip():
        return "it begins or ends with a space"
    if text.startswith("#"):
        return "a row that begins with # is a comment"
    parts = _PATH_SEPARATORS.split(text)
    if ".." in parts or not parts[0] or _DRIVE.match(text):
        return "as a file name it would lead out of its folder"
    if len(text.encode()) > MAX_NAME_BYTES:
        return f"as a file name it would be too long: at most {MAX_NAME_BYTES} bytes in UTF-8"
    # Otherwise several names could mean one file: a/b, a//b and a/./b.
    if "" in parts or "." in parts:
        return "as a file name it has a part that is empty or a single point"
    return None


def require_readable(name: str, values: Iterable[object]) -> None:
    """Raise a ValueError for a text that is not a name, with the reason from `name_problem`.

    Args:
        name: name of the argument.
        values: names for use in tables, YAML files and file names.
    """
    for value in values:
        if (reason := name_problem(value)) is not None:
            raise ValueError(f"{name}: {no_name(value, reason)}")


def require_readable_or_empty(name: str, value: object) -> None:
    """Raise a ValueError as `require_readable` does, but accept an empty text: no name."""
    if value != "":
        require_readable(name, [value])


def no_name(value: object, reason: str) -> str:
    """Return the sentence for messages that a text is not a name."""
    shown = value[:60] if isinstance(value, str) else value
    return f"{shown!r} is no name: {reason}"


def nearest_name(text: str) -> str:
    """Return the name that differs least from a text; empty if nothing is left.

    It is for texts that were not meant as names, such as file names, and for names in files of
    earlier versions, which had other rules.
    """
    if name_problem(text) is None:
        return text
    printable = "".join(letter if letter.isprintable() else " " for letter in text)
    parts = (part.strip() for part in _PATH_SEPARATORS.split(printable))
    joined = "/".join(part for part in parts if part not in ("", ".", "..")).lstrip("# /")
    joined = f"{joined[0]}-{joined[2:]}" if _DRIVE.match(joined) else joined
    short = joined[:MAX_NAME_LENGTH].encode()[:MAX_NAME_BYTES]
    # A character that is cut within its bytes is left out.
    return short.decode(errors="ignore").rstrip(" /")


def _described(value: object) -> str:
    """Return the type of a value, and the value itself if it is short."""
    text = repr(value)
    kind = type(value).__name__
    return f"{text} ({kind})" if len(text) <= 40 and "\n" not in text else f"one of type {kind}"
