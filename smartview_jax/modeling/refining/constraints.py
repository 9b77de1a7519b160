"""State prior knowledge of an object: planes, parallels, right angles, lengths, symmetry.

A constraint says that some numbers computed from vertices and lines are zero, exactly or within a
standard deviation.
"""

import abc
import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Inexact

from ..line_jacobians import perpendicular_axes
from .constraint_geometry import (
    STEP,
    VARIABLE_SIZES,
    Edge,
    Evaluation,
    LineIndex,
    Shape,
    Variable,
    edge_direction,
    edge_length,
    heights_above_plane,
    with_imaginary_steps,
)


@dataclasses.dataclass(frozen=True)
class AbstractConstraint(abc.ABC):
    """A known property of an object; `sigma` is its standard deviation, m or rad, None if exact."""

    sigma: float | None = dataclasses.field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if self.sigma is not None and not 0.0 < self.sigma < np.inf:
            raise ValueError(f"{self}: sigma is positive, or None for exact; found {self.sigma}")
        for edge in self.edges:
            if not isinstance(edge, LineIndex) and (len(edge) != 2 or edge[0] == edge[1]):
                raise ValueError(f"{self}: an edge is two different vertices, found {edge}")
        names = [edge if isinstance(edge, LineIndex) else frozenset(edge) for edge in self.edges]
        if len(set(names)) < len(names):
            raise ValueError(f"{self}: expected different edges, found {self.edges[0]} twice")

    @property
    def edges(self) -> tuple[Edge, ...]:
        """The edges in the constraint."""
        return ()

    @property
    def vertices(self) -> tuple[int, ...]:
        """The vertices in the constraint, including the ends of its edges."""
        pairs = [edge for edge in self.edges if not isinstance(edge, LineIndex)]
        return tuple(k for pair in pairs for k in pair)

    @property
    def lines(self) -> tuple[int, ...]:
        """The lines in the constraint."""
        return tuple(edge.line for edge in self.edges if isinstance(edge, LineIndex))

    def initial_plane(
        self, points: Float[np.ndarray, "points 3"]
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None:
        """Return centre and unit normal of its unknown plane; None if it has none."""
        return None

    @abc.abstractmethod
    def values(self, shape: Shape, plane: int) -> Inexact[np.ndarray, "*layers numbers"]:
        """Return the numbers that the constraint requires to be zero.

        Args:
            shape: vertices, lines and planes, or layers of them with complex numbers, as
                `with_imaginary_steps` makes.
            plane: index of its own plane; -1 if it has none.
        """

    def evaluate(self, shape: Shape, plane: int) -> Evaluation:
        """Return the numbers of `values` with their derivatives."""
        variables: list[Variable] = [
            *(("point", k) for k in sorted(set(self.vertices))),
            *(("line", k) for k in sorted(set(self.lines))),
            *([("plane", plane)] if plane >= 0 else []),
        ]
        layers = self.values(with_imaginary_steps(shape, variables), plane)
        ends = np.cumsum([VARIABLE_SIZES[kind] for kind, _ in variables])[:-1]
        parts = np.split(np.imag(layers).T / STEP, ends, axis=1)
        return Evaluation(self.values(shape, plane), dict(zip(variables, parts, strict=True)))


@dataclasses.dataclass(frozen=True)
class SamePlane(AbstractConstraint):
    """At least four vertices lie in one unknown plane; sigma is a distance, m."""

    points: tuple[int, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(set(self.points)) < max(4, len(self.points)):
            raise ValueError(f"{self}: expected at least four different vertices")

    @property
    def vertices(self) -> tuple[int, ...]:
        """The vertices that lie in the plane."""
        return self.points

    def initial_plane(
        self, points: Float[np.ndarray, "points 3"]
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Return the plane that is nearest to the vertices."""
        chosen = points[list(self.points)]
        centre = chosen.mean(axis=0)
        # The direction in which the vertices scatter least.
        return centre, np.linalg.svd(chosen - centre)[2][2]

    def values(self, shape: Shape, plane: int) -> Inexact[np.ndarray, "*layers numbers"]:
        """Return the heights of the vertices above the plane."""
        # The plane is an additional unknown, rather than a determinant of every four vertices: the
        # numbers are then distances, and all vertices count alike.
        return heights_above_plane(shape, plane, self.points)


@dataclasses.dataclass(frozen=True)
class OnPlane(AbstractConstraint):
    """Vertices lie in a known plane, by default the table z = 0 of the world; sigma in m.

    Attributes:
        points: indices of the vertices.
        normal: unit normal of the plane in the world.
        offset: height of the plane along the normal, m: z of the table.
    """

    points: tuple[int, ...]
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    offset: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if abs(np.linalg.norm(self.normal) - 1.0) > 1e-6:
            raise ValueError(f"{self}: the normal has the length 1")

    @property
    def vertices(self) -> tuple[int, ...]:
        """The vertices that lie in the plane."""
        return self.points

    def values(self, shape: Shape, plane: int) -> Inexact[np.ndarray, "*layers numbers"]:
        """Return the heights of the vertices above the plane."""
        return shape.points[..., list(self.points), :] @ np.array(self.normal) - self.offset


@dataclasses.dataclass(frozen=True)
class AbstractEdgePair(AbstractConstraint):
    """A known property of two edges."""

    first: Edge
    second: Edge

    @property
    def edges(self) -> tuple[Edge, ...]:
        """The two edges."""
        return self.first, self.second


@dataclasses.dataclass(frozen=True)
class Parallel(AbstractEdgePair):
    """Two edges are parallel; sigma is the angle between them, rad."""

    def values(self, shape: Shape, plane: int) -> Inexact[np.ndarray, "*layers numbers"]:
        """Return two components of the vector product of the directions, across the first."""
        u, v = edge_direction(shape, self.first), edge_direction(shape, self.second)
        # The components along two axes perpendicular to u; the third is zero. The axes are held
        # fixed, since their turns change nothing where the edges are parallel.
        across = perpendicular_axes(np.real(u).reshape(-1, 3)[:1])[0]
        return np.cross(u, v) @ across


@dataclasses.dataclass(frozen=True)
class RightAngle(AbstractEdgePair):
    """Two edges are at right angles; sigma is the deviation, rad."""

    def values(self, shape: Shape, plane: int) -> Inexact[np.ndarray, "*layers numbers"]:
        """Return the cosine of the angle."""
        u, v = edge_direction(shape, self.first), edge_direction(shape, self.second)
        return np.sum(u * v, axis=-1, keepdims=True)


@dataclasses.dataclass(frozen=True)
class EqualLength(AbstractEdgePair):
    """Two edges between vertices are equally long; sigma is the difference, m."""

    first: tuple[int, int]
    second: tuple[int, int]

    def values(self, shape: Shape, plane: int) -> Inexact[np.ndarray, "*layers numbers"]:
        """Return the difference of the lengths."""
        # The difference and not the ratio, so that sigma is a length.
        return edge_length(shape, self.first) - edge_length(shape, self.second)


@dataclasses.dataclass(frozen=True)
class KnownLength(AbstractConstraint):
    """An edge between two vertices has a known length, m; sigma in m."""

    edge: tuple[int, int]
    length: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.length < np.inf:
            raise ValueError(f"{self}: the length is positive, m")

    @property
    def edges(self) -> tuple[Edge, ...]:
        """The edge."""
        return (self.edge,)

    def values(self, shape: Shape, plane: int) -> Inexact[np.ndarray, "*layers numbers"]:
        """Return the difference from the known length."""
        return edge_length(shape, self.edge) - self.length


@dataclasses.dataclass(frozen=True)
class Symmetric(AbstractConstraint):
    """Pairs of vertices are mirror images in an unknown plane; sigma in m.

    A vertex in the plane is paired with itself; at least one pair has different ones.
    """

    pairs: tuple[tuple[int, int], ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        if all(i == j for i, j in self.pairs):
            raise ValueError(f"{self}: expected a pair of different vertices")

    @property
    def vertices(self) -> tuple[int, ...]:
        """The vertices of all pairs."""
        return tuple(k for pair in self.pairs for k in pair)

    def initial_plane(
        self, points: Float[np.ndarray, "points 3"]
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Return the plane halfway between the vertices of all pairs."""
        pairs = np.array(self.pairs)
        difference = points[pairs[:, 1]] - points[pairs[:, 0]]
        # The common direction of the differences, whatever their signs.
        normal = np.linalg.svd(difference)[2][0]
        return points[pairs].mean(axis=(0, 1)), normal

    def values(self, shape: Shape, plane: int) -> Inexact[np.ndarray, "*layers numbers"]:
        """Return the difference of each vertex from the other's mirror image."""
        normal, points = shape.normals[..., plane, :], shape.points
        # Three numbers for a pair, one for a vertex in the plane; together they also determine the
        # plane.
        numbers = []
        for i, j in self.pairs:
            height = heights_above_plane(shape, plane, [i])
            # x_i - 2 h n - x_j, with h the height of x_i
            mirrored = points[..., i, :] - 2.0 * height * normal
            numbers.append(height if i == j else mirrored - points[..., j, :])
        return np.concatenate(numbers, axis=-1)


def check_edges(
    constraints: Sequence[AbstractConstraint], points: Float[np.ndarray, "points 3"]
) -> None:
    """Raise if an edge of a constraint has no length and so no direction."""
    for constraint in constraints:
        for edge in constraint.edges:
            # Later steps are small compared with any edge that has a length, so this check is
            # enough.
            if not isinstance(edge, LineIndex) and np.array_equal(*points[list(edge)]):
                raise ValueError(f"{constraint}: vertices {edge} start in the same place")


def check_constraints(
    constraints: Sequence[AbstractConstraint], point_count: int, line_count: int
) -> None:
    """Raise if a constraint names a vertex or a line that does not exist."""
    for constraint in constraints:
        for kind, indices, count in (
            ("vertex", constraint.vertices, point_count),
            ("line", constraint.lines, line_count),
        ):
            wrong = [k for k in indices if not 0 <= k < count]
            if wrong:
                raise ValueError(f"{constraint}: there is no {kind} {wrong[0]}, only {count}")
