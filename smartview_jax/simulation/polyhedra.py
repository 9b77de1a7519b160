"""Define polyhedral objects of known vertices, edges and faces, fixed and random.

Each stands on the plane z = 0, in metres, with z upwards. A face is a loop of vertex indices,
counter-clockwise as seen from outside, so that its normal points outwards.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, HalfspaceIntersection

from ..geometry import host_transformed, spiral_directions
from ..io import face_triangles
from ..modeling import (
    Face,
    ObjectModel,
    edges_of_faces,
    face_array,
    face_plane,
    find_symmetry,
)

MIN_EDGE_RATIO = 0.12
"""Shortest edge of a random polyhedron over its radius; shorter ones are too small to see."""

MIN_DIHEDRAL = np.deg2rad(15.0)
"""Smallest angle between the normals of neighbouring faces of a random polyhedron, rad."""

MAX_ATTEMPTS = 2000
"""Largest number of random polyhedra that are drawn until one fulfils all conditions."""


class Polyhedron(NamedTuple):
    """A solid with flat faces.

    Attributes:
        vertices: m.
        faces: loops of vertex indices, counter-clockwise as seen from outside.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: tuple[tuple[int, ...], ...]

    @property
    def edges(self) -> Int[np.ndarray, "edges 2"]:
        """The pairs of vertices that an edge joins, the smaller index first."""
        return edges_of_faces(face_array(self.faces))

    @property
    def triangles(self) -> Int[np.ndarray, "triangles 3"]:
        """The faces cut into triangles, for ray casting and mesh files; by mapbox-earcut."""
        faces = face_array(self.faces)
        return np.concatenate([face_triangles(self.vertices, face) for face in faces])

    def exact_model(self, name: str = "") -> ObjectModel:
        """Return the model of this solid as from its drawing, with its symmetry."""
        model = ObjectModel(self.vertices, self.edges, face_array(self.faces), name=name)
        return dataclasses.replace(model, symmetry=find_symmetry(model))

    def moved(self, matrix: Float[np.ndarray, "4 4"]) -> "Polyhedron":
        """Return the same solid at another pose, given as a 4 x 4 matrix."""
        return self._replace(vertices=host_transformed(matrix, self.vertices))


def loop_pairs(face: Sequence[int]) -> list[tuple[int, int]]:
    """Return each vertex of a loop with its successor."""
    return list(zip(face, (*face[1:], face[0]), strict=True))


def face_normal(
    vertices: Float[np.ndarray, "vertices 3"], face: Sequence[int]
) -> Float[np.ndarray, "3"]:
    """Return the outward unit normal of a flat loop, convex or not."""
    return face_plane(vertices, Face(tuple(face))).normal


def prism(base: Float[np.ndarray, "corners 2"], height: float) -> Polyhedron:
    """Return an upright prism over a polygon in z = 0 with counter-clockwise corners, m."""
    n = len(base)
    vertices = np.concatenate(
        [np.column_stack([base, np.full(n, z)]) for z in (0.0, height)], dtype=float
    )
    sides = [(a, b, b + n, a + n) for a, b in loop_pairs(range(n))]
    return Polyhedron(vertices, (tuple(range(n))[::-1], tuple(range(n, 2 * n)), *sides))


def box(width: float, depth: float, height: float) -> Polyhedron:
    """Return a box centred on the z axis, m."""
    corners = 0.5 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return prism(corners * [width, depth], height)


def stepped_block(size: float = 0.03) -> Polyhedron:
    """Return the example: a block (m long) with a step, an inner corner and twelve vertices."""
    # The profile in the plane of x and z is an L on its long side; it is extruded along y. One end
    # of the upper part is bevelled, so that no rotation maps it to itself.
    profile = np.array(
        [[-0.5, 0.0], [0.5, 0.0], [0.5, 0.25], [0.0, 0.25], [-0.1, 0.6], [-0.5, 0.6]]
    )
    flat = prism(size * profile * [1.0, 1.0], 0.7 * size)
    x, z, y = flat.vertices.T
    upright = np.column_stack([x, 0.35 * size - y, z])
    return Polyhedron(upright, flat.faces)


def roofed_block(size: float = 0.03) -> Polyhedron:
    """Return a block, `size` (m) long, with a gable roof: ten vertices, seven faces."""
    profile = np.array([[-0.4, 0.0], [0.4, 0.0], [0.4, 0.35], [0.0, 0.65], [-0.4, 0.35]])
    flat = prism(size * profile, size)
    y, z, x = flat.vertices.T
    return Polyhedron(np.column_stack([x - 0.5 * size, y, z]), flat.faces)


def random_polyhedron(
    rng: np.random.Generator, vertex_count: int, radius: float = 0.02
) -> Polyhedron:
    """Return a random convex polyhedron that stands on a face.

    Args:
        rng: numpy's generator; the same state gives the same solid.
        vertex_count: an even number from 8; three faces meet in every vertex.
        radius: of the sphere that the faces touch, m.

    Raises:
        ValueError: no solid of so many vertices exists, or none without tiny edges was found.
    """
    if vertex_count < 8 or vertex_count % 2:
        raise ValueError(f"vertex_count: expected an even number from 8, found {vertex_count}")
    # Euler: with three faces in every vertex, F = V / 2 + 2.
    face_count = vertex_count // 2 + 2
    for _ in range(MAX_ATTEMPTS):
        normals = _spread_directions(rng, face_count)
        solid = _intersection(normals, radius * rng.uniform(0.85, 1.1, face_count))
        if solid is not None and len(solid.vertices) == vertex_count and _is_plain(solid, radius):
            lowest = solid.vertices[:, 2].min()
            return solid._replace(vertices=solid.vertices - [0.0, 0.0, lowest])
    raise ValueError(f"no polyhedron of {vertex_count} vertices in {MAX_ATTEMPTS} attempts")


def _spread_directions(rng: np.random.Generator, count: int) -> Float[np.ndarray, "directions 3"]:
    """Return random unit vectors that are spread over the sphere, the first one downwards."""
    # From pole to pole, then a random deviation.
    z = np.concatenate([[-1.0], np.linspace(-1.0, 1.0, count)[1:]])
    spiral = spiral_directions(z, rng.uniform(0.0, 2.0 * np.pi))
    spiral[1:] += 0.25 * rng.standard_normal((count - 1, 3))
    return spiral / np.linalg.norm(spiral, axis=1, keepdims=True)


def _intersection(
    normals: Float[np.ndarray, "faces 3"], offsets: Float[np.ndarray, "faces"]
) -> Polyhedron | None:
    """Return the solid of the points with `normals @ x <= offsets`; None if it is unbounded."""
    # A bounded solid has the origin inside the hull of its normals.
    if not (ConvexHull(normals).equations[:, 3] < 0.0).all():
        return None
    halfspaces = np.column_stack([normals, -offsets])
    vertices = HalfspaceIntersection(halfspaces, np.zeros(3)).intersections
    on_face = np.abs(vertices @ normals.T - offsets) < 1e-9
    faces = []
    for k, normal in enumerate(normals):
        loop = np.nonzero(on_face[:, k])[0]
        if len(loop) < 3:
            return None
        # Sorted by the angle about the face's centre, counter-clockwise about the normal.
        across = np.linalg.svd(normal[None])[2][1:]
        across = across if np.linalg.det([*across, normal]) > 0.0 else across[::-1]
        x, y = across @ (vertices[loop] - vertices[loop].mean(axis=0)).T
        faces.append(tuple(int(v) for v in loop[np.argsort(np.arctan2(y, x))]))
    return Polyhedron(vertices, tuple(faces))


def _is_plain(solid: Polyhedron, radius: float) -> bool:
    """Return whether no edge is too short or too blunt to see, and the solid is not a needle."""
    a, b = solid.vertices[solid.edges].transpose(1, 0, 2)
    if np.linalg.norm(a - b, axis=1).min() < MIN_EDGE_RATIO * radius:
        return False
    if np.abs(solid.vertices).max() > 2.0 * radius:
        return False
    normals = np.array([face_normal(solid.vertices, face) for face in solid.faces])
    cosines = [
        normals[i] @ normals[j]
        for i, first in enumerate(solid.faces)
        for j, second in enumerate(solid.faces[:i])
        if len(set(first) & set(second)) == 2
    ]
    return bool(max(cosines) < np.cos(MIN_DIHEDRAL))
