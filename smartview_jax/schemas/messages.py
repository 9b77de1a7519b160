"""Format values and suggestions for error messages, without importing pydantic."""

import difflib
import reprlib
from collections.abc import Iterable

_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = 60
_REPR.maxlevel = 2


def shortened_repr(value: object) -> str:
    """Return a shortened representation of a value, which may be of any type and length."""
    return _REPR.repr(value)


def spelling_suggestion(word: object, known: Iterable[str]) -> str:
    """Return a suggestion of the most similar known name; empty if none is similar."""
    close = difflib.get_close_matches(str(word)[:100], list(known), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""
