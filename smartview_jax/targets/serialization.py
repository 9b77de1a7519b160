"""Convert targets to and from the mappings of plain values in `dataset.yaml`."""

import dataclasses
from typing import Any

from ..argument_checks import errors_at, require_one_of
from .boards import AprilGrid, Charuco, Chessboard, CircleGrid, TagGrid
from .listed_points import ListedPoints
from .stacked import StackedTarget
from .target import AbstractTarget, require_lengths

TARGET_CLASSES: dict[str, type[AbstractTarget]] = {
    "circle_grid": CircleGrid,
    "chessboard": Chessboard,
    "charuco": Charuco,
    "tag_grid": TagGrid,
    "aprilgrid": AprilGrid,
    "points": ListedPoints,
}
"""Class of every target, by the name that files use."""


def target_from_dict(content: dict[str, Any]) -> AbstractTarget:
    """Return the target that a mapping describes.

    Args:
        content: `kind`, the attributes of that kind (lengths in m), and `heights` (m) for a board
            that was used at several heights.

    Raises:
        ValueError: an entry is unknown, missing or wrong; the message names it.
    """
    attributes = dict(content)
    kind = attributes.pop("kind", None)
    require_one_of("target.kind", kind, TARGET_CLASSES)
    heights = attributes.pop("heights", None)
    fields = {field.name: field for field in dataclasses.fields(TARGET_CLASSES[kind])}
    unknown = sorted(set(attributes) - set(fields))
    if unknown:
        raise ValueError(
            f"target: a {kind} has no {', '.join(unknown)}; it has {', '.join(fields)}"
        )
    missing = [
        name
        for name, field in fields.items()
        if field.default is dataclasses.MISSING and name not in attributes
    ]
    if missing:
        raise ValueError(f"target: a {kind} needs {', '.join(missing)}")
    with errors_at("target"):
        board = TARGET_CLASSES[kind](**attributes)
        if heights is None:
            return board
        require_lengths(heights=heights)
        return StackedTarget(board, tuple(heights))


def target_to_dict(target: AbstractTarget) -> dict[str, Any]:
    """Return a target as a mapping of plain values, the inverse of `target_from_dict`.

    Raises:
        ValueError: a kind of target without a name in files.
    """
    if isinstance(target, StackedTarget):
        return {**target_to_dict(target.board), "heights": list(target.heights)}
    if isinstance(target, ListedPoints):
        return {"kind": "points", "coordinates": [list(point) for point in target.coordinates]}
    for kind, cls in TARGET_CLASSES.items():
        if type(target) is cls:
            # Attributes that may be None have None as their default, so they are omitted.
            known = {k: v for k, v in dataclasses.asdict(target).items() if v is not None}
            return {"kind": kind, **known}
    raise ValueError(f"{type(target).__name__} has no name in a file")
