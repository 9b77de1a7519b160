"""Describe the flat faces of an object model, and say what is wrong with an invalid one.

A face is a loop of vertices that runs counter-clockwise as seen from outside the object, so that
its normal points outward by the right-hand rule; each hole is a further loop, in the opposite
direction. All functions are NumPy, because a model has few faces.
"""

import dataclasses
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ...argument_checks import require_readable_or_empty

PLANAR_TOLERANCE = 0.01
"""Largest distance of a vertex from the plane of its face, relative to the face's extent."""

SHARP_ANGLE = float(np.deg2rad(20.0))
"""Smallest bend of a surface that counts as an edge, and of its outline as a corner, rad.

The smallest bend commonly meant is 45 degrees (an octagonal prism); round parts are meshed with
steps of 5 to 15 degrees.
"""

MIN_RELATIVE_AREA = 1e-6
"""Smallest area of a face over its squared extent; a smaller face is only a line."""


@dataclasses.dataclass(frozen=True)
class Face:
    """A flat part of an object's surface.

    Attributes:
        loop: indices of the vertices around it, counter-clockwise as seen from outside.
        holes: a loop for each hole, clockwise as seen from outside.
        name: for people; may be empty.
        graspable: whether a finger may touch it; None if unknown.
    """

    loop: tuple[int, ...]
    holes: tuple[tuple[int, ...], ...] = ()
    name: str = ""
    graspable: bool | None = None

    def __post_init__(self) -> None:
        """Raise a ValueError for a name that no file could hold; there may be none."""
        require_readable_or_empty("face", self.name)

    @property
    def loops(self) -> tuple[tuple[int, ...], ...]:
        """The outer loop and then the holes."""
        return (self.loop, *self.holes)

    @property
    def indices(self) -> list[int]:
        """The vertices of all loops."""
        return [index for loop in self.loops for index in loop]

    @property
    def directed_edges(self) -> list[tuple[int, int]]:
        """The pairs of neighbouring vertices, in the order of the loops."""
        return [pair for loop in self.loops for pair in zip(loop, loop[1:] + loop[:1], strict=True)]

    @property
    def fan(self) -> Int[np.ndarray, "T 3"]:
        """The triangles between the first vertex and the sides.

        Where the face is not convex, or has holes, triangles of opposite orientation cancel.
        """
        apex = self.loop[0]
        # Sides at the apex make no triangle. A side in line with it makes one without area, which
        # may gain area when a vertex is moved.
        sides = np.array([pair for pair in self.directed_edges if apex not in pair])
        return np.column_stack([np.full(len(sides), apex), sides])

    @property
    def reversed(self) -> "Face":
        """The same face with its normal to the other side."""
        return dataclasses.replace(
            self, loop=self.loop[::-1], holes=tuple(hole[::-1] for hole in self.holes)
        )


class FacePlane(NamedTuple):
    """The plane that fits the vertices of a face best.

    Attributes:
        origin: mean of the vertices of the outer loop, m.
        axes: rows x, y and z of the plane's right-handed frame; z is the outward normal, and x is
            along the longest edge.
        area: of the face without its holes, m^2.
        distances: of the vertices of all loops from the plane, along the normal, m.
    """

    origin: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    area: float
    distances: Float[np.ndarray, "n"]

    @property
    def normal(self) -> Float[np.ndarray, "3"]:
        """The outward unit normal."""
        return self.axes[2]

    def coordinates(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Return the coordinates of points along the plane's x and y, m."""
        return (points - self.origin) @ self.axes[:2].T


def area_vector(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """Return the normal of a closed polygon with the polygon's area as its length (Newell)."""
    # a = 1/2 sum_i (p_i - m) x (p_{i+1} - m); subtracting the mean m only reduces rounding errors.
    centred = points - points.mean(axis=0)
    return 0.5 * np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0)


def face_plane(vertices: Float[np.ndarray, "V 3"], face: Face) -> FacePlane:
    """Return the plane of a face, with its outward normal.

    A loop that crosses itself or encloses no area is a ValueError.
    """
    outer = vertices[list(face.loop)]
    vector = area_vector(outer)
    extent, area = float(np.ptp(outer, axis=0).max()), float(np.linalg.norm(vector))
    if not area > MIN_RELATIVE_AREA * extent**2:
        spread = np.linalg.svd(outer - outer.mean(axis=0), compute_uv=False)
        if spread[1] > MIN_RELATIVE_AREA * spread[0]:
            raise ValueError("it crosses itself, so that its two halves cancel")
        raise ValueError("its vertices are on one line or in one point, so it has no area")
    normal = vector / area
    # The frame's x is along the longest edge, where a person recognises it.
    sides = np.roll(outer, -1, axis=0) - outer
    longest = sides[np.argmax(np.linalg.norm(sides, axis=1))]
    x = longest - normal * (normal @ longest)
    x /= np.linalg.norm(x)
    origin = outer.mean(axis=0)
    holes = sum(float(np.linalg.norm(area_vector(vertices[list(hole)]))) for hole in face.holes)
    distances = (vertices[face.indices] - origin) @ normal
    return FacePlane(origin, np.stack([x, np.cross(normal, x), normal]), area - holes, distances)


def with_oriented_holes(vertices: Float[np.ndarray, "V 3"], face: Face) -> Face:
    """Return the face with every hole running opposite to the outer loop."""
    outer = area_vector(vertices[list(face.loop)])
    holes = tuple(
        hole[::-1] if area_vector(vertices[list(hole)]) @ outer > 0.0 else hole
        for hole in face.holes
    )
    return face if holes == face.holes else dataclasses.replace(face, holes=holes)


def check_face(
    vertices: Float[np.ndarray, "V 3"],
    face: Face,
    vertex_sigma: Float[np.ndarray, "V"] | None = None,
    planar_tolerance: float = PLANAR_TOLERANCE,
) -> None:
    """Raise an error if a face is not a flat polygon that does not cross itself.

    Args:
        vertices: of the model, m.
        face: to be checked.
        vertex_sigma: standard deviation of every vertex, m; a vertex may lie three of them off the
            plane. None if the vertices are exact.
        planar_tolerance: largest distance from the plane over the extent of the face.

    Raises:
        ValueError: the message names the vertices and says what is wrong.
    """
    for loop in face.loops:
        _check_loop(loop, len(vertices))
    plane = face_plane(vertices, face)
    # A triangle is flat and cannot cross itself; meshes have thousands.
    if len(face.indices) == 3:
        return
    extent = float(np.ptp(vertices[list(face.loop)], axis=0).max())
    allowed = np.full(len(face.indices), planar_tolerance * extent)
    if vertex_sigma is not None:
        allowed = np.maximum(allowed, 3.0 * vertex_sigma[face.indices])
    excess = np.abs(plane.distances) - allowed
    worst = int(np.argmax(excess))
    if excess[worst] > 0.0:
        raise ValueError(
            f"it is not planar: vertex {face.indices[worst]} is "
            f"{1e3 * abs(plane.distances[worst]):.3g} mm from its plane, and "
            f"{1e3 * allowed[worst]:.3g} mm is allowed"
        )
    _check_crossings(plane, vertices, face)


def _check_loop(loop: tuple[int, ...], vertex_count: int) -> None:
    """Raise an error for a loop that is too short, has missing vertices or repeats one."""
    if len(loop) < 3:
        raise ValueError(f"a loop of {len(loop)} vertices {list(loop)}; expected at least 3")
    missing = [index for index in loop if not 0 <= index < vertex_count]
    if missing:
        raise ValueError(
            f"vertex {missing[0]} does not exist: the model has {vertex_count} vertices, from 0"
        )
    # A repeated vertex would make two faces that touch in a point.
    index, count = Counter(loop).most_common(1)[0]
    if count > 1:
        raise ValueError(f"it meets vertex {index} {count} times")


def _check_crossings(plane: FacePlane, vertices: Float[np.ndarray, "V 3"], face: Face) -> None:
    """Raise an error if two sides of a face cross, or a hole is not inside the outer loop."""
    # Sides of the holes, too: a hole may not cross the outer loop.
    pairs = np.array(face.directed_edges)
    starts, ends = (plane.coordinates(vertices[pairs[:, k]]) for k in (0, 1))
    crossing = _segments_cross(starts, ends)
    # Sides that share a vertex touch there and cannot cross anywhere else.
    shared = (pairs[:, None, :, None] == pairs[None, :, None, :]).any(axis=(2, 3))
    crossings = np.argwhere(crossing & ~shared)
    if len(crossings):
        side, other_side = (tuple(int(index) for index in pairs[k]) for k in crossings[0])
        raise ValueError(f"it crosses itself: side {side} crosses side {other_side}")
    outer = plane.coordinates(vertices[list(face.loop)])
    for hole in face.holes:
        inside = points_in_loops(plane.coordinates(vertices[list(hole)]), [outer])
        if not inside.all():
            raise ValueError(f"its hole {list(hole)} is not inside its outer loop")


def _segments_cross(
    starts: Float[np.ndarray, "n 2"], ends: Float[np.ndarray, "n 2"]
) -> Bool[np.ndarray, "n n"]:
    """Return which pairs of segments in a plane cross or touch."""

    def side(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        # Twice the signed area of the triangle a, b, c.
        u, v = b - a, c - a
        return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]

    a, b, c, d = starts[:, None], ends[:, None], starts[None], ends[None]
    straddles = side(a, b, c) * side(a, b, d) <= 0.0
    straddled = side(c, d, a) * side(c, d, b) <= 0.0
    # Segments on one line straddle each other everywhere; they cross where their boxes overlap.
    apart = np.maximum(np.minimum(a, b), np.minimum(c, d)) > np.minimum(
        np.maximum(a, b), np.maximum(c, d)
    )
    return straddles & straddled & ~apart.any(axis=-1)


def points_in_loops(
    points: Float[np.ndarray, "n 2"], loops: Sequence[Float[np.ndarray, "_ 2"]]
) -> Bool[np.ndarray, "n"]:
    """Return which points of a plane are inside an outer loop and outside its holes."""
    # A ray along +x leaves a region after an odd number of crossings, whatever its holes.
    crossings = np.zeros(len(points), int)
    for loop in loops:
        a, b = loop, np.roll(loop, -1, axis=0)
        # Half-open at the ends, so that a ray through a corner counts it once.
        above = (a[:, 1] > points[:, None, 1]) != (b[:, 1] > points[:, None, 1])
        rise = np.where(b[:, 1] == a[:, 1], 1.0, b[:, 1] - a[:, 1])
        x = a[:, 0] + (points[:, None, 1] - a[:, 1]) / rise * (b[:, 0] - a[:, 0])
        crossings += (above & (points[:, None, 0] < x)).sum(axis=1)
    return crossings % 2 == 1


def open_edges(faces: Sequence[Face]) -> list[tuple[int, int]]:
    """Return the edges at which the surface is open, with no face on one of their sides.

    In a closed and consistently oriented surface every edge is used twice, once in each direction.
    """
    # Directed, so that an edge between faces of opposite orientation is open as well.
    uses = Counter(pair for face in faces for pair in face.directed_edges)
    return sorted(
        {
            (min(a, b), max(a, b))
            for (a, b), count in uses.items()
            if count != 1 or uses.get((b, a)) != 1
        }
    )


def signed_volume(vertices: Float[np.ndarray, "V 3"], faces: Sequence[Face]) -> float:
    """Return the volume inside a closed surface, m^3; negative if its normals point inward."""
    # By the divergence theorem 3 V = sum over faces of (point on the face) . (area vector).
    # About the mean, since the difference of large products would lose digits.
    centred = vertices - vertices.mean(axis=0)
    return sum(
        float(centred[loop[0]] @ area_vector(centred[list(loop)])) / 3.0
        for face in faces
        for loop in face.loops
    )


def winding_number(triangles: Float[np.ndarray, "T 3 3"], point: Float[np.ndarray, "3"]) -> float:
    """Return how often a closed surface winds about a point: once inside, not at all outside.

    It is negative inside a surface whose normals point inward.
    """
    # tan(w / 2) = a . (b x c) / (abc + (a . b) c + (b . c) a + (c . a) b), the solid angle w of a
    # triangle (van Oosterom and Strackee, 1983).
    a, b, c = (triangles - point).swapaxes(0, 1)
    la, lb, lc = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
    ab, bc, ca = ((p * q).sum(axis=1) for p, q in ((a, b), (b, c), (c, a)))
    above, below = (a * np.cross(b, c)).sum(axis=1), la * lb * lc + ab * lc + bc * la + ca * lb
    return float(np.arctan2(above, below).sum()) / (2.0 * np.pi)


def oriented_outward(vertices: Float[np.ndarray, "V 3"], faces: Sequence[Face]) -> tuple[Face, ...]:
    """Return the faces with all normals outward, turned over where necessary.

    Faces that share an edge are made consistent with one another; each closed part is then turned
    so that it encloses a positive volume. An open part keeps the side of its first face.
    """
    result = [with_oriented_holes(vertices, face) for face in faces]
    for part in _connected_parts(result):
        turned = [result[k] for k in part]
        if not open_edges(turned) and signed_volume(vertices, turned) < 0.0:
            turned = [face.reversed for face in turned]
        for k, face in zip(part, turned, strict=True):
            result[k] = face
    return tuple(result)


def faces_by_edge(faces: Sequence[Face]) -> dict[frozenset[int], list[int]]:
    """Return the indices of the faces on both sides of each edge, by its two vertices."""
    owners: dict[frozenset[int], list[int]] = {}
    for k, face in enumerate(faces):
        for pair in face.directed_edges:
            owners.setdefault(frozenset(pair), []).append(k)
    return owners


def _connected_parts(faces: list[Face]) -> list[list[int]]:
    """Return groups of faces connected by edges, after orienting each like its neighbours."""
    users = faces_by_edge(faces)
    parts, reached = [], set()
    for first in range(len(faces)):
        if first in reached:
            continue
        part = [first]
        reached.add(first)
        for k in part:  # grows while it is walked through
            for pair in faces[k].directed_edges:
                for other in users[frozenset(pair)]:
                    if other in reached:
                        continue
                    # Neighbours run through their common edge in opposite directions.
                    if pair in faces[other].directed_edges:
                        faces[other] = faces[other].reversed
                    reached.add(other)
                    part.append(other)
        parts.append(part)
    return parts


def face_array(faces: Sequence[Sequence[int]] | Int[np.ndarray, "F n"]) -> tuple[Face, ...]:
    """Return faces without holes from lists of vertex indices."""
    return tuple(Face(tuple(int(index) for index in loop)) for loop in faces)
