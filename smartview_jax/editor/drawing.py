"""Edit a document: clicks, edges, faces and grasps, undo and redo."""

import abc
import dataclasses
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from .document import Document, apply_change
from .edit_history import EditHistory
from .model_building import checked_loop, problems_of
from .view_geometry import PointEstimate, ViewGeometry

NAMED_KINDS = ("faces", "grasps")
"""The parts that have names of their own; points and edges have numbers."""

PictureSizes: TypeAlias = Mapping[str, tuple[int, int]]
"""The width and height of each view's picture, px, by the view's name."""


class AbstractDrawing(abc.ABC):
    """A document that is edited step by step; every change is checked before it is kept."""

    names: list[str]
    geometry: ViewGeometry
    _journal: EditHistory

    @property
    @abc.abstractmethod
    def picture_sizes(self) -> PictureSizes:
        """Width and height of the pictures, px, by the view's name."""

    @abc.abstractmethod
    def estimates(self, document: Document | None = None) -> dict[int, PointEstimate]:
        """Return the estimates of all points, by id."""

    @property
    def document(self) -> Document:
        """Return the document as it is now."""
        return self._journal.document

    def change(self, change: Mapping[str, Any]) -> None:
        """Make a change, as in `document.apply_change`, and write it to the journal.

        Raises:
            ValueError: the change is not possible; nothing was changed.
            OSError: it cannot be written; nothing was changed.
        """
        self._journal.change(change, self.checked(change))

    def checked(self, change: Mapping[str, Any]) -> Document:
        """Return the document after a change that is not made, or raise as `change` does."""
        # The document itself knows neither the views nor the size of their pictures.
        check_clicks(change, self.picture_sizes)
        changed = apply_change(self.document, change)
        _check_names(self.document, changed)
        # Everything that a page shows is computed for the new document before the change is
        # journalled: a change that fails later would fail again whenever the file is opened.
        try:
            problems_of(changed, self.estimates(changed))
        except ValueError:
            raise
        except Exception as error:
            raise ValueError(
                f"{change.get('do')}: the geometry cannot be computed: {error}"
            ) from error
        return changed

    def checked_pixel(self, view: Any, pixel: Any) -> tuple[float, float]:
        """Return a pixel of a view, or raise an error that names both."""
        return checked_pixel(view, pixel, self.picture_sizes)

    def click(
        self, view: str, pixel: Sequence[float] | np.ndarray, point: int | None = None
    ) -> int:
        """Click a feature at u, v (px) as an existing or new point (None); return its id."""
        u, v = self.checked_pixel(view, pixel)
        if point is None:
            return self._add({"do": "add_point", "clicks": {view: [u, v]}})
        self.change({"do": "click", "point": point, "view": view, "pixel": [u, v]})
        return point

    def add_edge(self, a: int, b: int) -> int:
        """Add an edge between two points, and return its id."""
        return self._add({"do": "add_edge", "ends": [a, b]})

    def add_face(self, loop: Sequence[int], name: str = "", graspable: bool | None = None) -> int:
        """Add a face around points, and return its id; its normal points to the cameras."""
        # The oriented loop is journalled, so that replaying needs no geometry.
        outward = checked_loop(loop, self.document, self.estimates(), self.geometry)
        return self._add(
            {"do": "add_face", "loop": list(outward), "name": name, "graspable": graspable}
        )

    def add_grasp(self, face: int, **values: Any) -> int:
        """Place a grasp on a face, and return its id; `PlacedGrasp` lists the values."""
        change = {"do": "add_grasp", "face": face, **values}
        self._check_grasp(change, self.document.next_id)
        return self._add(change)

    def change_grasp(self, grasp: int, **values: Any) -> None:
        """Move, turn, open or rename a grasp."""
        change = {"do": "change_grasp", "id": grasp, **values}
        self._check_grasp(change, grasp)
        self.change(change)

    def _check_grasp(self, change: Mapping[str, Any], grasp: int) -> None:
        """Raise an error if a grasp is not possible on its face after a change."""
        document = apply_change(self.document, change)
        # Problems of other grasps are no reason to refuse this one.
        only = dataclasses.replace(document, grasps={grasp: document.existing("grasps", grasp)})
        reason = problems_of(only, self.estimates(only)).get(("grasps", grasp))
        if reason is not None:
            raise ValueError(f"grasp: {reason}")

    def add_constraint(
        self,
        kind: str,
        items: Sequence[Sequence[int]],
        value: float | None = None,
        sigma: float | None = None,
    ) -> int:
        """State a fact about points or edges, and return its id.

        Args:
            kind: "same_plane", "on_table" or "symmetric" for points; "parallel", "right_angle",
                "equal_length" or "known_length" for edges.
            items: the ids of the points, in one group; or the two ends of each edge.
            value: the known length, m.
            sigma: standard deviation of the fact, m or rad; None if it is exact.
        """
        groups = [list(group) for group in items]
        return self._add(
            {"do": "add_constraint", "kind": kind, "items": groups, "value": value, "sigma": sigma}
        )

    def _add(self, change: Mapping[str, Any]) -> int:
        """Make a change that adds a part, and return its id."""
        number = self.document.next_id
        self.change(change)
        return number

    def delete(self, kind: str, number: int) -> None:
        """Delete a point, edge, face, grasp or constraint, and the parts that depend on it."""
        self.change({"do": "delete", "kind": kind, "id": number})

    def undo(self) -> bool:
        """Undo the last change; return whether there was one."""
        return self._journal.undo()

    def redo(self) -> bool:
        """Redo the change that was undone last; return whether there was one."""
        return self._journal.redo()

    @property
    def can_undo(self) -> bool:
        """Whether there is a change to undo."""
        return self._journal.can_undo

    @property
    def can_redo(self) -> bool:
        """Whether there is a change to redo."""
        return self._journal.can_redo

    @property
    def is_saved(self) -> bool:
        """Whether the model's file has all changes; the journal has them in any case."""
        return self._journal.is_saved


def _check_names(before: Document, after: Document) -> None:
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


def check_clicks(change: Mapping[str, Any], sizes: PictureSizes) -> None:
    """Raise an error for a change with a click in an unknown view, or outside its picture (px)."""
    # All parts of a change are checked before any of them is made.
    clicks = dict(change.get("clicks") or {})
    if change.get("do") == "click":
        clicks[change.get("view")] = change.get("pixel")
    for view, pixel in clicks.items():
        checked_pixel(view, pixel, sizes)
    for part in change.get("changes") or ():
        check_clicks(part, sizes)


def check_view(view: Any, names: Iterable[str]) -> None:
    """Raise an error for a view that does not exist."""
    # A page's message may hold anything, also what no mapping can look up.
    if view not in list(names):
        raise ValueError(f"no view {view!r}; the views are {', '.join(names)}")


def checked_pixel(view: Any, pixel: Any, sizes: PictureSizes) -> tuple[float, float]:
    """Return a pixel of a view, or raise an error that names both."""
    check_view(view, sizes)
    # The page's messages are not validated: text, null and three numbers are possible.
    try:
        # Texts of digits and true would pass as numbers.
        if any(isinstance(number, str | bool) for number in pixel):
            raise TypeError
        u, v = (float(number) for number in pixel)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"view {view}: a pixel is two numbers; found {pixel!r}") from None
    width, height = sizes[view]
    # NaN fails this comparison too.
    if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
        raise ValueError(
            f"view {view}: the click ({u:g}, {v:g}) is outside the picture of {width} x {height} px"
        )
    return u, v
