"""State prior knowledge of an object: planes, parallels, right angles, lengths, symmetry.

A constraint says that some numbers computed from vertices and lines are zero, exactly or within a
standard deviation.
"""

import abc
import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..geometry import host_cross_matrices
from .constraint_geometry import (
    DerivativeSum,
    Edge,
    Evaluation,
    LineIndex,
    Shape,
    Variable,
    edge_direction,
    edge_length,
    height_above_plane,
)
from .line_jacobians import perpendicular_axes


@dataclasses.dataclass(frozen=True)
class AbstractConstraint(abc.ABC):
    """A known property of an object.

    Attributes:
        sigma: standard deviation, m or rad as the constraint says; None is exact.
    """

    sigma: float | None = dataclasses.field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if self.sigma is not None and not 0.0 < self.sigma < np.inf:
            raise ValueError(f"{self}: sigma is positive, or None for exact; found {self.sigma}")
        for edge in self.edges:
            if not isinstance(edge, LineIndex) and (len(edge) != 2 or edge[0] == edge[1]):
                raise ValueError(f"{self}: an edge is two different vertices, found {edge}")

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
    def evaluate(self, shape: Shape, plane: int) -> Evaluation:
        """Return the numbers that the constraint requires to be zero, with their derivatives.

        Args:
            shape: vertices, lines and planes.
            plane: index of its own plane, if it has one.
        """


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

    def evaluate(self, shape: Shape, plane: int) -> Evaluation:
        """Return the heights of the vertices above the plane."""
        # The plane is an additional unknown, rather than a determinant of every four vertices: the
        # numbers are then distances, and all vertices count alike.
        values, total = np.zeros(len(self.points)), DerivativeSum()
        for k, point in enumerate(self.points):
            values[k], parts = height_above_plane(shape, plane, point)
            total.chain(np.eye(len(values))[:, k : k + 1], parts)
        return Evaluation(values, total.parts)


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

    def evaluate(self, shape: Shape, plane: int) -> Evaluation:
        """Return the heights of the vertices above the plane."""
        del plane
        # The plane is known, so that only the points have derivatives.
        normal, count = np.array(self.normal), len(self.points)
        values = shape.points[list(self.points)] @ normal - self.offset
        total = DerivativeSum()
        for k, point in enumerate(self.points):
            total.add(("point", point), np.outer(np.eye(count)[k], normal))
        return Evaluation(values, total.parts)


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

    def evaluate(self, shape: Shape, plane: int) -> Evaluation:
        """Return two components of the vector product of the directions, across the first."""
        del plane
        u, du = edge_direction(shape, self.first)
        v, dv = edge_direction(shape, self.second)
        # The components along two axes perpendicular to u; the third is zero.
        across = perpendicular_axes(u[None])[0].T
        # d(u x v) = -[v] du + [u] dv; across u itself the product has no component.
        total = DerivativeSum()
        total.chain(-across @ host_cross_matrices(v), du)
        total.chain(across @ host_cross_matrices(u), dv)
        return Evaluation(across @ np.cross(u, v), total.parts)


@dataclasses.dataclass(frozen=True)
class RightAngle(AbstractEdgePair):
    """Two edges are at right angles; sigma is the deviation, rad."""

    def evaluate(self, shape: Shape, plane: int) -> Evaluation:
        """Return the cosine of the angle."""
        del plane
        u, du = edge_direction(shape, self.first)
        v, dv = edge_direction(shape, self.second)
        total = DerivativeSum()
        # d(u . v) = v . du + u . dv
        total.chain(v[None], du)
        total.chain(u[None], dv)
        return Evaluation(np.array([u @ v]), total.parts)


@dataclasses.dataclass(frozen=True)
class EqualLength(AbstractEdgePair):
    """Two edges between vertices are equally long; sigma is the difference, m."""

    first: tuple[int, int]
    second: tuple[int, int]

    def evaluate(self, shape: Shape, plane: int) -> Evaluation:
        """Return the difference of the lengths."""
        del plane
        # The difference and not the ratio, so that sigma is a length.
        a, da = edge_length(shape, self.first)
        b, db = edge_length(shape, self.second)
        total = DerivativeSum()
        total.chain(np.ones((1, 1)), da)
        total.chain(-np.ones((1, 1)), db)
        return Evaluation(np.array([a - b]), total.parts)


@dataclasses.dataclass(frozen=True)
class KnownLength(AbstractConstraint):
    """An edge between two vertices has a known length; sigma in m.

    Attributes:
        edge: two vertices.
        length: the length, m.
    """

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

    def evaluate(self, shape: Shape, plane: int) -> Evaluation:
        """Return the difference from the known length."""
        del plane
        length, parts = edge_length(shape, self.edge)
        return Evaluation(np.array([length - self.length]), parts)


@dataclasses.dataclass(frozen=True)
class Symmetric(AbstractConstraint):
    """Pairs of vertices are mirror images in an unknown plane; sigma in m.

    A vertex in the plane is paired with itself.

    Attributes:
        pairs: indices of the vertices; at least one pair of different ones.
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

    def evaluate(self, shape: Shape, plane: int) -> Evaluation:
        """Return the difference of each vertex from the other's mirror image."""
        normal = shape.normals[plane]
        axes = perpendicular_axes(normal[None])[0]
        values: list[np.ndarray] = []
        # Three numbers for a pair, one for a vertex in the plane; together they also determine the
        # plane.
        rows: list[dict[Variable, np.ndarray]] = []
        for i, j in self.pairs:
            height, parts = height_above_plane(shape, plane, i)
            if i == j:
                values.append(np.array([height]))
                rows.append(parts)
                continue
            # x_i - 2 h n - x_j, with h the height of x_i
            pair_sum = DerivativeSum()
            pair_sum.add(("point", i), np.eye(3))
            pair_sum.add(("point", j), -np.eye(3))
            pair_sum.chain(-2.0 * normal[:, None], parts)
            pair_sum.add(("plane", plane), -2.0 * height * np.hstack([axes, np.zeros((3, 1))]))
            values.append(shape.points[i] - 2.0 * height * normal - shape.points[j])
            rows.append(pair_sum.parts)
        total, start = DerivativeSum(), 0
        count = sum(map(len, values))
        for value, parts in zip(values, rows, strict=True):
            total.chain(np.eye(count)[:, start : start + len(value)], parts)
            start += len(value)
        return Evaluation(np.concatenate(values), total.parts)


def check_edges(
    constraints: Sequence[AbstractConstraint], points: Float[np.ndarray, "points 3"]
) -> None:
    """Raise if an edge of a constraint has no length and so no direction.

    Raises:
        ValueError: naming the constraint and the vertices.
    """
    for constraint in constraints:
        for edge in constraint.edges:
            # Later steps are small compared with any edge that has a length, so this check is
            # enough.
            if not isinstance(edge, LineIndex) and np.array_equal(*points[list(edge)]):
                raise ValueError(f"{constraint}: vertices {edge} start in the same place")


def check_constraints(
    constraints: Sequence[AbstractConstraint], point_count: int, line_count: int
) -> None:
    """Raise if a constraint names a vertex or a line that does not exist.

    Raises:
        ValueError: naming the constraint and the index.
    """
    for constraint in constraints:
        for kind, indices, count in (
            ("vertex", constraint.vertices, point_count),
            ("line", constraint.lines, line_count),
        ):
            wrong = [k for k in indices if not 0 <= k < count]
            if wrong:
                raise ValueError(f"{constraint}: there is no {kind} {wrong[0]}, only {count}")
