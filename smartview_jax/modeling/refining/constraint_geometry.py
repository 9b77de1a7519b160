"""Compute the quantities in constraints: directions, lengths and heights.

An *edge* is a pair of vertex indices, or a `LineIndex` for a triangulated line; edges have a
direction, and pairs of vertices a length.

Derivatives are by imaginary steps in NumPy: there are few constraints, each with few numbers.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Inexact

from ..line_jacobians import Lines, perpendicular_axes


class LineIndex(NamedTuple):
    """The index of a triangulated line, used in place of an edge."""

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

VARIABLE_SIZES = {"point": 3, "line": 4, "plane": 3}
"""The numbers that move a variable of each kind."""

STEP = 1e-20
"""Size of the imaginary steps, m or rad: its square is far below the rounding of any number."""


class Evaluation(NamedTuple):
    """The numbers that a constraint requires to be zero, with their derivatives.

    Attributes:
        values: the numbers, m or rad.
        jacobians: their derivatives by the step of each variable that they depend on.
    """

    values: Float[np.ndarray, "numbers"]
    jacobians: dict[Variable, Float[np.ndarray, "numbers _"]]


def with_imaginary_steps(shape: Shape, variables: Sequence[Variable]) -> Shape:
    """Return the shape with one more axis in front: in each layer one number makes a step `i h`.

    The imaginary part of a function of the layer, over h, is the function's derivative, without
    the rounding error of a difference.

    Reference: Squire and Trapp, Using complex variables to estimate derivatives of real functions,
    1998.
    """
    sizes = [VARIABLE_SIZES[kind] for kind, _ in variables]
    points, directions, normals, offsets = (
        np.tile(array.astype(complex), (sum(sizes), *(1,) * array.ndim))
        for array in (shape.points, shape.lines.directions, shape.normals, shape.offsets)
    )
    first = 0
    for (kind, k), size in zip(variables, sizes, strict=True):
        layers, step = slice(first, first + size), 1j * STEP * np.eye(size)
        if kind == "point":
            points[layers, k] += step
        elif kind == "line":
            # Shifts do not turn a line.
            axes = perpendicular_axes(shape.lines.directions[k : k + 1])[0]
            directions[layers, k] += step[:, 2:] @ axes.T
        else:
            normals[layers, k] += step[:, :2] @ perpendicular_axes(shape.normals[k : k + 1])[0].T
            offsets[layers, k] += step[:, 2]
        first += size
    lines = shape.lines._replace(directions=directions)
    return shape._replace(points=points, lines=lines, normals=normals, offsets=offsets)


def edge_direction(shape: Shape, edge: Edge) -> Inexact[np.ndarray, "*layers 3"]:
    """Return the unit direction of an edge."""
    if isinstance(edge, LineIndex):
        return shape.lines.directions[..., edge.line, :]
    i, j = edge
    return (shape.points[..., j, :] - shape.points[..., i, :]) / edge_length(shape, edge)


def edge_length(shape: Shape, edge: tuple[int, int]) -> Inexact[np.ndarray, "*layers 1"]:
    """Return the length of an edge."""
    i, j = edge
    difference = shape.points[..., j, :] - shape.points[..., i, :]
    # Not `np.linalg.norm`, which takes the modulus of complex numbers.
    return np.sqrt(np.sum(difference**2, axis=-1, keepdims=True))


def heights_above_plane(
    shape: Shape, plane: int, points: Sequence[int]
) -> Inexact[np.ndarray, "*layers points"]:
    """Return the heights of points above a plane."""
    offsets = shape.points[..., list(points), :] - shape.centres[plane]
    # h = n . (x - c) - o
    across = np.sum(offsets * shape.normals[..., plane, None, :], axis=-1)
    return across - shape.offsets[..., plane, None]
