"""Refuse arguments of the wrong kind, with a message that says what was expected."""

from collections import Counter
from collections.abc import Sequence


def require_instance(name: str, value: object, kind: type, hint: str = "") -> None:
    """Raise a TypeError unless an argument is of the kind that is expected.

    Args:
        name: of the argument.
        value: what was given.
        kind: the class that is expected.
        hint: what may have been meant.
    """
    if not isinstance(value, kind):
        message = f"{name}: expected {kind.__name__}, found {_described(value)}"
        raise TypeError(message + (f"; {hint}" if hint else ""))


def require_names(name: str, value: Sequence[str]) -> None:
    """Raise a ValueError for a single text where a sequence of names is expected."""
    # A text is a sequence too: of its letters.
    if isinstance(value, str):
        raise ValueError(f"{name}: expected a list of names such as [{value!r}], found {value!r}")


def require_distinct(name: str, values: Sequence[str]) -> None:
    """Raise a ValueError that names every value which is given more than once.

    Args:
        name: of the argument.
        values: names or ids, by which something is found again.
    """
    repeated = sorted(value for value, count in Counter(values).items() if count > 1)
    if repeated:
        raise ValueError(f"{name}: {', '.join(repeated)} given more than once")


MAX_NAME_LENGTH = 200
"""Largest number of characters of a name, as in the schemas of files."""


def require_readable(name: str, values: Sequence[str]) -> None:
    """Raise a ValueError for a name that no file could hold so that it is read back equal.

    Args:
        name: of the argument.
        values: names that tables, YAML files and file names are made with.
    """
    for value in values:
        reason = None
        if not 0 < len(value) <= MAX_NAME_LENGTH:
            reason = f"a name has 1 to {MAX_NAME_LENGTH} characters, not {len(value)}"
        elif not value.isprintable():
            reason = "it has a tab, a line end or another character that is not printable"
        elif value != value.strip():
            reason = "it begins or ends with a space"
        elif value.startswith("#"):
            reason = "a row that begins with # is a comment"
        elif ".." in value.replace("\\", "/").split("/"):
            reason = "as a file name it would lead out of its folder"
        if reason is not None:
            raise ValueError(f"{name}: {value[:60]!r} is no name: {reason}")


def _described(value: object) -> str:
    """Return the kind of a value, and the value itself where that is short."""
    text = repr(value)
    kind = type(value).__name__
    return f"{text} ({kind})" if len(text) <= 40 and "\n" not in text else f"one of type {kind}"
