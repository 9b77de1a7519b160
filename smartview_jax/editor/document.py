"""Hold the content of the editor, and apply changes to it.

A document is immutable: a change returns a new document, so that undo returns to the old one. Every
change is a mapping of plain values, as the journal and the page send it, and is made by
`apply_change`. Points are known by ids that are never reused.
"""

import dataclasses
import math
import operator
from collections.abc import Callable, Mapping
from numbers import Real
from typing import Any

from ..argument_checks import require_one_of, require_readable_or_empty

Clicks = Mapping[str, tuple[float, float]]
"""The pixel of a point by the name of the view."""

MAX_LENGTH = 100.0
"""Largest length of an object or a gripper, m, as in the schemas of files."""

KINDS = ("points", "edges", "faces", "grasps", "constraints")
"""The parts of a document that have ids, by which they are deleted."""


@dataclasses.dataclass(frozen=True)
class DrawnFace:
    """A face, drawn by clicking its points.

    Attributes:
        loop: ids of its points, counter-clockwise as seen from outside.
        name: for people.
        graspable: whether a finger may touch it; None if not stated.
    """

    loop: tuple[int, ...]
    name: str = ""
    graspable: bool | None = None


@dataclasses.dataclass(frozen=True)
class PlacedGrasp:
    """A grasp on a face, placed relative to the face so that it moves with it.

    Attributes:
        face: id of the face.
        offset: offset from the mean of the face's corners, along the face's x and y, m.
        angle: angle of the opening direction from the face's x, rad.
        opening: distance between the open fingers, m; None for 1.2 times the object's width.
        depth: depth of the fingertips below the face, m.
        name: for people.
    """

    face: int
    offset: tuple[float, float] = (0.0, 0.0)
    angle: float = math.pi / 2
    opening: float | None = None
    depth: float = 0.01
    name: str = ""


@dataclasses.dataclass(frozen=True)
class DrawnConstraint:
    """A geometric fact about the object that the user knows.

    Attributes:
        kind: name of the constraint.
        items: ids of the points that it constrains, in groups.
        value: known length, m; None for other kinds.
        sigma: standard deviation of the constraint; None if it is exact.
    """

    kind: str
    items: tuple[tuple[int, ...], ...]
    value: float | None = None
    sigma: float | None = None

    @property
    def points(self) -> frozenset[int]:
        """The ids of all points that it constrains."""
        return frozenset(point for group in self.items for point in group)


@dataclasses.dataclass(frozen=True)
class Document:
    """The content of the editor: clicks, edges, faces, grasps and constraints, by id.

    Attributes:
        points: the clicks of every point.
        next_id: the id of the part that is added next.
        symmetry_confirmed: whether the user confirmed the symmetry found; None if undecided.
        symmetry_order: order of the symmetry that was confirmed or refused; None is any.
    """

    points: Mapping[int, Clicks] = dataclasses.field(default_factory=dict)
    edges: Mapping[int, tuple[int, int]] = dataclasses.field(default_factory=dict)
    faces: Mapping[int, DrawnFace] = dataclasses.field(default_factory=dict)
    grasps: Mapping[int, PlacedGrasp] = dataclasses.field(default_factory=dict)
    constraints: Mapping[int, DrawnConstraint] = dataclasses.field(default_factory=dict)
    next_id: int = 0
    name: str = ""
    symmetry_confirmed: bool | None = None
    symmetry_order: int | None = None

    def existing(self, kind: str, number: int) -> Any:
        """Return a part by its id, or raise a ValueError that names it."""
        parts = getattr(self, kind)
        if part_id(number) not in parts:
            raise ValueError(f"no {kind.removesuffix('s')} {number}")
        return parts[number]

    def existing_points(self, given: Any) -> tuple[int, ...]:
        """Return the ids of points, or raise a ValueError that names one that does not exist."""
        points = tuple(part_id(point) for point in given)
        for point in points:
            self.existing("points", point)
        return points

    def related_constraints(self, number: int) -> frozenset[int]:
        """Return a constraint and all that share points with it, directly or through others."""
        chosen, points = {number}, self.constraints[number].points
        while more := {
            k for k, fact in self.constraints.items() if k not in chosen and fact.points & points
        }:
            chosen |= more
            points = points.union(*(self.constraints[k].points for k in more))
        return frozenset(chosen)

    def _added(self, kind: str, part: Any) -> "Document":
        # Copied, never changed in place, because undo returns to earlier documents.
        parts = {**getattr(self, kind), self.next_id: part}
        return dataclasses.replace(self, **{kind: parts}, next_id=self.next_id + 1)

    def _changed(self, kind: str, number: int, part: Any) -> "Document":
        self.existing(kind, number)
        return dataclasses.replace(self, **{kind: {**getattr(self, kind), number: part}})


def part_id(given: Any) -> int:
    """Return the id of a part, a whole number."""
    # The journal holds plain numbers, scripts may give NumPy's.
    if isinstance(given, bool):
        raise ValueError(f"a part is named by a whole number; found {given!r}")
    try:
        return operator.index(given)
    except TypeError:
        raise ValueError(f"a part is named by a whole number; found {given!r}") from None


def _check_quantities(name: str, *values: Any) -> None:
    """Raise a ValueError unless each value is None or a number of at most `MAX_LENGTH`."""
    for value in values:
        is_number = isinstance(value, Real) and not isinstance(value, bool)
        # NaN fails the comparison, too.
        if value is not None and not (is_number and abs(float(value)) <= MAX_LENGTH):
            raise ValueError(f"{name} is a number up to {MAX_LENGTH:g}; found {value!r}")


def apply_change(document: Document, change: Mapping[str, Any]) -> Document:
    """Return the document after a change, `{"do": name, ...}` with the arguments of this change."""
    content = dict(change)
    name = content.pop("do", None)
    function = CHANGES.get(str(name))
    if function is None:
        raise ValueError(f"expected one of the changes {', '.join(CHANGES)}; found {name!r}")
    try:
        return function(document, **content)
    # A missing or misspelt argument, which Python's message names after the function's name.
    except TypeError as error:
        raise ValueError(f"{name}: {str(error).split('() ')[-1]}") from None
    # A list instead of a mapping, infinity as an id, endlessly nested changes.
    except (AttributeError, LookupError, OverflowError, RecursionError) as error:
        raise ValueError(f"{name}: not a valid change: {error}") from None


def _pixel(pixel: Any) -> tuple[float, float]:
    """Return a pixel as two floats."""
    # Texts of digits would pass as numbers.
    if any(isinstance(number, str | bool) for number in pixel):
        raise ValueError(f"a pixel is two finite numbers; found {pixel!r}")
    u, v = map(float, pixel)
    # JSON has no NaN, but scripts do.
    if not (math.isfinite(u) and math.isfinite(v)):
        raise ValueError(f"pixel: expected two finite numbers, found {u}, {v}")
    return u, v


def _add_point(document: Document, clicks: Mapping[str, Any]) -> Document:
    return document._added("points", {view: _pixel(pixel) for view, pixel in clicks.items()})


def _click(document: Document, point: int, view: str, pixel: Any) -> Document:
    """Add or move the click of a point in a view."""
    clicks = document.existing("points", point)
    return document._changed("points", point, {**clicks, view: _pixel(pixel)})


def _remove_click(document: Document, point: int, view: str) -> Document:
    """Remove the click of a point in a view; a point without clicks is deleted."""
    clicks = document.existing("points", point)
    if view not in clicks:
        raise ValueError(f"point {point} was not clicked in view {view!r}")
    # A point without clicks would not be visible on the page.
    rest = {name: pixel for name, pixel in clicks.items() if name != view}
    return document._changed("points", point, rest) if rest else _delete(document, "points", point)


def _delete(document: Document, kind: str, id: int) -> Document:
    """Delete a part, and every other part that depends on it."""
    require_one_of("kind", kind, KINDS)
    document.existing(kind, id)
    kept = {name: dict(getattr(document, name)) for name in KINDS}
    del kept[kind][id]
    # Edges, faces and constraints need their points, grasps their face.
    points, constraints = kept["points"], kept["constraints"]
    kept["edges"] = {k: ends for k, ends in kept["edges"].items() if all(p in points for p in ends)}
    kept["faces"] = {
        k: face for k, face in kept["faces"].items() if all(p in points for p in face.loop)
    }
    kept["grasps"] = {
        k: grasp for k, grasp in kept["grasps"].items() if grasp.face in kept["faces"]
    }
    kept["constraints"] = {
        k: fact for k, fact in constraints.items() if all(p in points for p in fact.points)
    }
    return dataclasses.replace(document, **kept)


def _add_edge(document: Document, ends: Any) -> Document:
    a, b = document.existing_points(ends)
    if a == b:
        raise ValueError(f"an edge joins two different points, found point {a} twice")
    # In either direction.
    if {a, b} in [set(edge) for edge in document.edges.values()]:
        raise ValueError(f"there is an edge between points {a} and {b} already")
    return document._added("edges", (a, b))


def _add_face(
    document: Document, loop: Any, name: str = "", graspable: bool | None = None
) -> Document:
    """Add a face around three or more points, and the edges around it that are missing."""
    points = tuple(part_id(point) for point in loop)
    # The face comes first, so that its id is the one that was next before the change.
    document = document._added("faces", _checked_face(document, DrawnFace(points, name, graspable)))
    drawn = {frozenset(edge) for edge in document.edges.values()}
    for a, b in zip(points, points[1:] + points[:1], strict=True):
        if frozenset((a, b)) not in drawn:
            document = document._added("edges", (a, b))
    return document


def _change_face(document: Document, id: int, **values: Any) -> Document:
    """Change the name, graspability or loop of a face."""
    # JSON has lists only, but loops are compared and hashed as tuples.
    if "loop" in values:
        values["loop"] = tuple(part_id(point) for point in values["loop"])
    face = dataclasses.replace(document.existing("faces", id), **values)
    return document._changed("faces", id, _checked_face(document, face))


def _checked_face(document: Document, face: DrawnFace) -> DrawnFace:
    """Return a face after checking that its points exist and its values can be saved."""
    for point in face.loop:
        document.existing("points", point)
    if len(set(face.loop)) != len(face.loop) or len(face.loop) < 3:
        raise ValueError(f"a face needs 3 or more different points, found {list(face.loop)}")
    require_readable_or_empty("face", face.name)
    # Not by equality, by which 1 is true.
    if not isinstance(face.graspable, bool | None):
        raise ValueError(f"a face is graspable, not, or left open; found {face.graspable!r}")
    return face


def _add_grasp(document: Document, face: int, **values: Any) -> Document:
    document.existing("faces", face)
    return document._added("grasps", _checked_grasp(PlacedGrasp(face), values))


def _change_grasp(document: Document, id: int, **values: Any) -> Document:
    changed = _checked_grasp(document.existing("grasps", id), values)
    document.existing("faces", changed.face)
    return document._changed("grasps", id, changed)


def _checked_grasp(grasp: PlacedGrasp, values: dict[str, Any]) -> PlacedGrasp:
    """Return a grasp with changed values, after checking them."""
    if "offset" in values:
        values["offset"] = _pixel(values["offset"])
    numbers = (values.get(name) for name in ("angle", "opening", "depth"))
    _check_quantities("a grasp's angle, opening or depth", *numbers)
    _check_quantities("a grasp's place on its face", *values.get("offset", ()))
    changed = dataclasses.replace(grasp, **values)
    if changed.angle is None or changed.depth is None:
        raise ValueError("a grasp's angle and depth are finite numbers")
    require_readable_or_empty("grasp", changed.name)
    return changed


def _add_constraint(
    document: Document,
    kind: str,
    items: Any,
    value: float | None = None,
    sigma: float | None = None,
) -> Document:
    """Add a fact that binds groups of points."""
    # Several groups for edges, one for points; what fits is checked where it is used.
    groups = tuple(document.existing_points(group) for group in items)
    for name, given in (("a known length", value), ("the standard deviation of a fact", sigma)):
        _check_quantities(name, given)
        if given is not None and not given > 0.0:
            raise ValueError(f"{name} is above 0; found {given}")
    if not isinstance(kind, str):
        raise ValueError(f"the kind of a constraint is a name, found {kind!r}")
    return document._added("constraints", DrawnConstraint(kind, groups, value, sigma))


def _rename(document: Document, name: str) -> Document:
    require_readable_or_empty("object", name)
    return dataclasses.replace(document, name=name)


def _confirm_symmetry(document: Document, confirmed: Any, order: Any = None) -> Document:
    """Say whether the symmetry that was found, of so many turns, is meant."""
    # From the page and the journal anything may come.
    if not isinstance(confirmed, bool | None):
        raise ValueError(f"confirmed: expected true, false or null, found {confirmed!r}")
    is_count = isinstance(order, int) and not isinstance(order, bool) and order >= 1
    if order is not None and not is_count:
        raise ValueError(f"the order of a symmetry is 1 or more, found {order!r}")
    return dataclasses.replace(document, symmetry_confirmed=confirmed, symmetry_order=order)


def _several(document: Document, changes: Any) -> Document:
    """Make several changes that are undone together."""
    # Each change sees the earlier ones, so that an edge may join points added just before.
    for change in changes:
        document = apply_change(document, change)
    return document


CHANGES: dict[str, Callable[..., Document]] = {
    "add_point": _add_point,
    "click": _click,
    "remove_click": _remove_click,
    "delete": _delete,
    "add_edge": _add_edge,
    "add_face": _add_face,
    "change_face": _change_face,
    "add_grasp": _add_grasp,
    "change_grasp": _change_grasp,
    "add_constraint": _add_constraint,
    "rename": _rename,
    "confirm_symmetry": _confirm_symmetry,
    "several": _several,
}
"""The changes of a document, by name."""
