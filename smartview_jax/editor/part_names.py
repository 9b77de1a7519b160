"""Check that faces and grasps can be told apart by their names."""

from collections import Counter

from .document import Document

NAMED_KINDS = ("faces", "grasps")
"""The parts that have names of their own; points and edges have numbers."""


def check_names(before: Document, after: Document) -> None:
    """Raise a ValueError for a name that a change gives to a second part of its kind.

    A file may have two parts of one name from earlier, but a program that asks for one by its name
    would not know which is meant.
    """
    for kind in NAMED_KINDS:
        earlier = Counter(part.name for part in getattr(before, kind).values())
        parts = getattr(after, kind)
        named = Counter(part.name for part in parts.values() if part.name)
        for name, count in named.items():
            if count > max(earlier[name], 1):
                holders = [str(k) for k, part in parts.items() if part.name == name]
                word = kind.removesuffix("s")
                raise ValueError(
                    f"{word}: the name {name!r} belongs to {kind} {', '.join(holders)}"
                )
