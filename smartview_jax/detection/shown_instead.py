"""Say what pictures show in which a stated target was not found: the same board stated wrongly.

Markers are found in a mirrored picture if it is mirrored back, a board of another dictionary by its
own, and one whose squares or corners were counted otherwise by the right numbers. Each such board
is looked for as the stated one was; the first that is found is named. The gap of a grid of tags
follows from the corners that were found, without looking again.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from ..targets import (
    MARKER_COUNTS,
    AbstractTarget,
    AprilGrid,
    Charuco,
    Chessboard,
    CircleGrid,
    TagGrid,
)
from .detect import detect
from .markers import dictionary_by_name, find_tags, marker_detector

Grey = UInt8[np.ndarray, "rows columns"]
"""A grey picture."""

_MIN_MARKERS = 3
"""Fewest markers of another dictionary in all pictures together by which it is recognised.

In a picture of something else a small dictionary has one or two by chance. A target of fewer
markers needs all of them."""

_MIN_GAP_ERROR = 0.02
"""Smallest error of a gap between tags that is named, in parts of a tag's side."""


class _Board(NamedTuple):
    """A board that the pictures may show instead of the stated one.

    Attributes:
        words: what is wrong, and what to do, as a clause.
        target: the board.
        mirrored: whether the pictures have to be mirrored.
    """

    words: str
    target: AbstractTarget
    mirrored: bool = False


def shown_instead(pictures: Sequence[Grey], target: AbstractTarget) -> str:
    """Return what is wrong with the statement of a target that was not found, as a clause.

    Args:
        pictures: some in which the target was not found; each is searched many times.

    Returns:
        The clause, such as "the board has the legacy pattern: state legacy: true"; empty if
        no board that was tried is in the pictures.
    """
    for board in _boards(pictures, target):
        for picture in pictures:
            grey = np.ascontiguousarray(picture[:, ::-1]) if board.mirrored else picture
            if detect(grey, board.target).visible.any():
                return board.words
    return _other_gap(pictures, target) if isinstance(target, TagGrid) else ""


def _boards(pictures: Sequence[Grey], target: AbstractTarget) -> Iterator[_Board]:
    """Yield the boards to look for, boards with a single mistake first."""
    if isinstance(target, Charuco | TagGrid | AprilGrid):
        yield from _boards_of_markers(pictures, target)
    else:
        yield from _counted_otherwise(target)


_MIRRORED = (
    "the pictures are mirrored (left and right), or the board was printed mirrored: turn the "
    "mirroring off in the camera's driver, or print the board again"
)


def _boards_of_markers(
    pictures: Sequence[Grey], target: Charuco | TagGrid | AprilGrid
) -> Iterator[_Board]:
    """Yield the boards with markers: of the dictionary that is seen, in the pictures or mirrored.

    Without any marker, none is.
    """
    seen = _dictionary_seen(pictures, target)
    if seen is None:
        return
    name, mirrored = seen
    causes = [_MIRRORED] if mirrored else []
    if name != target.dictionary:
        causes.append(
            f"the markers are of another dictionary: state dictionary: {name}, not "
            f"{target.dictionary}"
        )
    try:
        of_dictionary = dataclasses.replace(target, dictionary=name)
    except ValueError:  # It has fewer markers than the target needs.
        return
    if causes:
        yield _Board("; ".join(causes), of_dictionary, mirrored)
    for board in _counted_otherwise(of_dictionary):
        yield _Board("; ".join((*causes, board.words)), board.target, mirrored)


def _counted_otherwise(target: AbstractTarget) -> Iterator[_Board]:
    """Yield boards of the same kind whose squares, corners or circles were counted otherwise."""
    changes: list[tuple[str, dict[str, object]]] = []
    if isinstance(target, Charuco):
        x, y = target.squares_x, target.squares_y
        legacy = not target.legacy
        pattern = "the legacy pattern" if legacy else "the pattern of OpenCV since 4.6"
        changes = [
            (f"the board has {pattern}: state legacy: {str(legacy).lower()}", {"legacy": legacy}),
            *_counts("the squares were exchanged", squares_x=y, squares_y=x),
            *_counts(
                "the inner corners were counted, not the squares", squares_x=x + 1, squares_y=y + 1
            ),
            *_counts(
                "the inner corners were counted, not the squares, and exchanged",
                squares_x=y + 1,
                squares_y=x + 1,
            ),
        ]
        changes += [
            (
                f"{words}; it has {pattern}: state legacy: {str(legacy).lower()}",
                {**new, "legacy": legacy},
            )
            for words, new in changes[1:]
        ]
    elif isinstance(target, Chessboard):
        changes = _counts(
            "the squares were counted, not the inner corners",
            rows=target.rows - 1,
            columns=target.columns - 1,
        )
    elif isinstance(target, TagGrid | AprilGrid):
        changes = _counts(
            "rows and columns were exchanged", rows=target.columns, columns=target.rows
        )
    elif isinstance(target, CircleGrid):
        light = not target.light_on_dark
        colours = "light on a dark board" if light else "dark on a light board"
        changes = [
            *_counts(
                "rows and columns were exchanged"
                + (", or the pictures are mirrored" if target.origin_mark else ""),
                rows=target.columns,
                columns=target.rows,
            ),
            (
                f"the circles are {colours}: state light_on_dark: {str(light).lower()}",
                {"light_on_dark": light},
            ),
        ]
    for words, new in changes:
        try:
            yield _Board(words, dataclasses.replace(target, **new))
        except ValueError:  # There is no such board.
            continue


def _counts(words: str, **counts: int) -> list[tuple[str, dict[str, object]]]:
    """Return one change of a board's counts, with the entries to state."""
    stated = ", ".join(f"{name}: {count}" for name, count in counts.items())
    return [(f"{words}: state {stated}", dict(counts))]


def _dictionary_seen(
    pictures: Sequence[Grey], target: Charuco | TagGrid | AprilGrid
) -> tuple[str, bool] | None:
    """Return the dictionary with the most markers, and whether in mirrored pictures; None without.

    The stated dictionary counts as seen in the pictures as they are if any other has no more.
    """
    needed = (
        target.squares_x * target.squares_y // 2 if isinstance(target, Charuco) else len(target.ids)
    )
    # Smaller dictionaries of a family have the first codes of the larger ones.
    names = [target.dictionary, *(name for name in MARKER_COUNTS if name != target.dictionary)]
    best, most = None, min(needed, _MIN_MARKERS) - 1
    for name in names:
        if MARKER_COUNTS[name] < needed:
            continue
        for mirrored in (False, True):
            count = sum(
                _marker_count(picture[:, ::-1] if mirrored else picture, name, target)
                for picture in pictures
            )
            if count > most:
                best, most = (name, mirrored), count
    return best


def _marker_count(picture: Grey, name: str, target: Charuco | TagGrid | AprilGrid) -> int:
    """Return how many markers of a dictionary a picture shows."""
    border_bits = 1 if isinstance(target, Charuco) else target.border_bits
    detector = marker_detector(dictionary_by_name(name), border_bits)
    _, ids, _ = detector.detectMarkers(np.ascontiguousarray(picture))
    return 0 if ids is None else len(ids)


def _other_gap(pictures: Sequence[Grey], target: TagGrid) -> str:
    """Return that tags are another distance apart than stated, as a clause; empty if they are not.

    The sides a-b and c-d of two neighbouring tags on one line of the board have equal lengths s and
    the gap g between b and c. Whatever the view, their cross ratio is

        |ac| |bd| / (|ad| |bc|) = (s + g)^2 / ((2 s + g) g) = 1 + s^2 / ((2 s + g) g)
    """
    if target.gap is None:
        return ""
    ratios = [
        ratio
        for picture in pictures
        for ratio in _gaps_by_sides(find_tags(picture, target, target.border_bits), target)
    ]
    if not ratios:
        return ""
    seen, stated = float(np.median(ratios)), target.gap / target.size
    if abs(seen - stated) < _MIN_GAP_ERROR:
        return ""
    return (
        f"the gap between neighbouring tags is {seen:.2f} of a tag's side in the pictures, where "
        f"{stated:.2f} is stated: measure size (of the black square, without a white border) and "
        "gap (from black to black) again"
    )


def _gaps_by_sides(tags: dict[int, Float[np.ndarray, "4 2"]], target: TagGrid) -> Iterator[float]:
    """Yield the gap over the side of each pair of neighbouring tags in a row."""
    for number, corners in tags.items():
        place = number - target.first_id
        if place % target.columns == target.columns - 1 or number + 1 not in tags:
            continue
        # OpenCV's order: top left, top right, bottom right, bottom left.
        for left, right in ((0, 1), (3, 2)):
            a, b, c, d = corners[left], corners[right], *tags[number + 1][[left, right]]
            ac, bd, ad, bc = (
                float(np.linalg.norm(second - first))
                for first, second in ((a, c), (b, d), (a, d), (b, c))
            )
            excess = ac * bd / max(ad * bc, 1e-300) - 1.0
            if excess > 0.0:
                yield float(np.sqrt(1.0 + 1.0 / excess) - 1.0)
