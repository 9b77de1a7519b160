"""Define the faces, grasps and constraints of a document, which refer to points by id."""

import dataclasses
import math


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
