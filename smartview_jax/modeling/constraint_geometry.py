"""Compute the quantities in constraints (directions, lengths, heights) with their derivatives.

An *edge* is a pair of vertex indices, or a `LineIndex` for a triangulated line; edges have a
direction, and pairs of vertices a length.

Derivatives are written out in NumPy: there are few constraints, each with few numbers.
"""

from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from .line_jacobians import Lines, perpendicular_axes


class LineIndex(NamedTuple):
    """The index of a triangulated line, used in place of an edge.

    Attributes:
        line: the index.
    """

    line: int


Edge: TypeAlias = tuple[int, int] | LineIndex
"""A pair of vertices, or a line."""


class Shape(NamedTuple):
    """The vertices and lines of an object, with the planes of its constraints.

    A plane is the set of points x with `normal . (x - centre) = offset`; three numbers move it: two
    turn the normal, one changes the offset.

    Attributes:
        points: vertices, m.
        lines: straight lines.
        normals: unit normals of the planes.
        offsets: offsets of the planes from their centres, m.
        centres: fixed points near each plane, m.
    """

    points: Float[np.ndarray, "points 3"]
    lines: Lines
    normals: Float[np.ndarray, "planes 3"]
    offsets: Float[np.ndarray, "planes"]
    centres: Float[np.ndarray, "planes 3"]

    def moved(
        self,
        points: Float[np.ndarray, "points 3"],
        lines: Float[np.ndarray, "lines 4"],
        planes: Float[np.ndarray, "planes 3"],
    ) -> "Shape":
        """Return the shape after steps of all points, lines and planes."""
        # To first order, then normalised: only the derivatives at a zero step matter.
        normals = self.normals + np.einsum(
            "pij,pj->pi", perpendicular_axes(self.normals), planes[:, :2]
        )
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        return Shape(
            self.points + points,
            self.lines.moved(lines),
            normals,
            self.offsets + planes[:, 2],
            self.centres,
        )


Variable: TypeAlias = tuple[str, int]
"""A kind of variable ("point", "line" or "plane") and its index."""


class Evaluation(NamedTuple):
    """The numbers that a constraint requires to be zero, with their derivatives.

    Attributes:
        values: the numbers, m or rad.
        jacobians: their derivatives by the step of each variable that they depend on.
    """

    values: Float[np.ndarray, "numbers"]
    jacobians: dict[Variable, Float[np.ndarray, "numbers _"]]


class DerivativeSum:
    """Derivatives of some numbers, summed by variable."""

    def __init__(self) -> None:
        self.parts: dict[Variable, np.ndarray] = {}

    def add(self, variable: Variable, jacobian: np.ndarray) -> None:
        """Add a contribution to the derivatives by a variable."""
        # An edge shared by two constraints, or a vertex of both edges, occurs twice.
        known = self.parts.get(variable)
        self.parts[variable] = jacobian if known is None else known + jacobian

    def chain(self, outer: np.ndarray, inner: dict[Variable, np.ndarray]) -> None:
        """Add derivatives by the chain rule: `outer` times the derivatives of an inner function."""
        for variable, jacobian in inner.items():
            self.add(variable, outer @ jacobian)


def edge_direction(shape: Shape, edge: Edge) -> tuple[np.ndarray, dict[Variable, np.ndarray]]:
    """Return the unit direction of an edge and its derivatives."""
    if isinstance(edge, LineIndex):
        direction = shape.lines.directions[edge.line]
        axes = perpendicular_axes(direction[None])[0]
        return direction, {("line", edge.line): np.hstack([np.zeros((3, 2)), axes])}
    i, j = edge
    difference = shape.points[j] - shape.points[i]
    length = np.linalg.norm(difference)
    direction = difference / length
    # d(x / |x|) = (I - u u^T) / |x| dx
    jacobian = (np.eye(3) - np.outer(direction, direction)) / length
    return direction, {("point", j): jacobian, ("point", i): -jacobian}


def edge_length(shape: Shape, edge: tuple[int, int]) -> tuple[float, dict[Variable, np.ndarray]]:
    """Return the length of an edge and its derivatives."""
    i, j = edge
    difference = shape.points[j] - shape.points[i]
    # d|x| = (x / |x|) . dx
    length = float(np.linalg.norm(difference))
    row = difference[None] / length
    return length, {("point", j): row, ("point", i): -row}


def height_above_plane(
    shape: Shape, plane: int, point: int
) -> tuple[float, dict[Variable, np.ndarray]]:
    """Return the height of a point above a plane and its derivatives."""
    normal = shape.normals[plane]
    offset = shape.points[point] - shape.centres[plane]
    # h = n . (x - c) - o, and n turns about two perpendicular axes: dh = n . dx + (x - c) . dn - do
    turn = offset @ perpendicular_axes(normal[None])[0]
    jacobians = {
        ("point", point): normal[None],
        ("plane", plane): np.array([[*turn, -1.0]]),
    }
    return float(normal @ offset - shape.offsets[plane]), jacobians
