"""Words for messages about wrong entries; without the validation library."""

import difflib
import reprlib
from collections.abc import Iterable

_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = 60
_REPR.maxlevel = 2


def shown(value: object) -> str:
    """Return a value as it was found, shortened: a file can hold anything of any length."""
    return _REPR.repr(value)


def nearest(word: object, known: Iterable[str]) -> str:
    """Return words that name the nearest of the known names, or nothing where none is near."""
    close = difflib.get_close_matches(str(word)[:100], list(known), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""
