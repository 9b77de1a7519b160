"""Turn an object model into arrays of fixed sizes, with samples along its edges.

Sizes are rounded up, so that all models of usual size use the same compiled programs; padded
entries have zero length or are masked.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..modeling import Face, ObjectModel
from ..runtime.array_namespace import to_device
from ..runtime.compilation import one_program

EDGE_SAMPLES = 128
"""Default for the smallest number of samples along all edges together."""

MIN_EDGE_SAMPLES = 6
"""Default for the smallest number of samples of an edge: the four that a line needs
(`edge_lines.MIN_LINE_POINTS`) remain when the samples next to both vertices are left out."""

MIN_DENSITY = 0.5
"""Smallest density of samples on long edges, over the density without `MIN_EDGE_SAMPLES`.

Where short edges would take more of the samples, the number of all samples is doubled.
"""

MIN_VERTICES, MIN_EDGES, MIN_TRIANGLES, MIN_FACES = 16, 32, 32, 16
"""Smallest sizes of the arrays; larger ones are rounded up to this times a power of two."""

HIDING_MARGIN = 2e-3
"""Distance in front of a point, over the object's extent, within which no face hides it.

Measured vertices do not lie exactly in the planes of their faces, nor do touching solids fit
exactly.
"""


class Wireframe(eqx.Module):
    """The vertices, edges and faces of a model, and samples along its edges, in its own frame.

    Each face is a fan of triangles about one of its vertices, with corners in the order of its
    border. A fan covers a convex face once; where the face is not convex, or has holes, triangles
    of opposite orientation cancel. The orientation is not stored, so that it stays correct when
    vertices are moved.

    Attributes:
        vertices: m.
        vertex_mask: False for padded vertices; the same in the other masks.
        vertex_faces: whether a vertex is on a face's border.
        edges: pairs of vertices; a padded edge leads from vertex 0 to vertex 0.
        edge_mask: see `vertex_mask`.
        edge_faces: whether an edge is on a face's border.
        samples: points along the edges, each in the middle of an equal part of its edge, m.
        sample_edges: edge of each sample; 0 for padded ones.
        sample_tangents: unit directions of the edges, from the first vertex to the second.
        sample_lengths: lengths of the parts, m; 0 for padded samples.
        triangle_vertices: corners of the faces' triangles; zeros for padded triangles.
        triangle_faces: the face that each triangle belongs to.
        face_points: a point of each face, m.
        face_normals: outward unit normals; 0 for padded faces.
        margin: distance in front of a point within which no face hides it, m.
        tolerance: standard deviation of the object's edges from the model, m.
    """

    vertices: Float[Array, "V 3"]
    vertex_mask: Bool[Array, "V"]
    vertex_faces: Bool[Array, "V F"]
    edges: Int[Array, "E 2"]
    edge_mask: Bool[Array, "E"]
    edge_faces: Bool[Array, "E F"]
    samples: Float[Array, "S 3"]
    sample_edges: Int[Array, "S"]
    sample_tangents: Float[Array, "S 3"]
    sample_lengths: Float[Array, "S"]
    triangle_vertices: Int[Array, "T 3"]
    triangle_faces: Bool[Array, "T F"]
    face_points: Float[Array, "F 3"]
    face_normals: Float[Array, "F 3"]
    margin: Float[Array, ""]
    tolerance: Float[Array, ""]

    @classmethod
    def of(
        cls, model: ObjectModel, samples: int = EDGE_SAMPLES, per_edge: int = MIN_EDGE_SAMPLES
    ) -> "Wireframe":
        """Return the arrays of a model.

        Args:
            model: with at least one edge.
            samples: number of samples along all edges together, in proportion to their lengths;
                doubled as often as short edges need it.
            per_edge: smallest number of samples of an edge, whatever its share of the length.

        Raises:
            ValueError: the model has no edges, or edges without length, or `samples` or `per_edge`
                is not positive.
        """
        if not len(model.edges):
            raise ValueError(f"model {model.name!r} has no edges, so it cannot be searched for")
        for name, number in (("samples", samples), ("per_edge", per_edge)):
            if number < 1:
                raise ValueError(f"{name}: expected a positive number, found {number}")
        # All on the host, so that preparing a model compiles nothing.
        faces = model.faces
        S, owners, lengths, parts = _sampled_edges(model, samples, per_edge)
        starts, ends = model.vertices[model.edges[owners]].transpose(1, 0, 2)
        tangents = (ends - starts) / np.linalg.norm(ends - starts, axis=1, keepdims=True)
        corners, triangle_faces = _fans(model)
        V = _rounded(len(model.vertices), MIN_VERTICES)
        E = _rounded(len(model.edges), MIN_EDGES)
        T, F = _rounded(len(corners), MIN_TRIANGLES), _rounded(len(faces), MIN_FACES)
        planes = [model.plane(k) for k in range(len(faces))]
        arrays = (
            _padded(model.vertices, V, 3),
            np.arange(V) < len(model.vertices),
            _padded(_vertices_on_faces(model), V, F),
            _padded(model.edges, E, 2),
            np.arange(E) < len(model.edges),
            _padded(_edges_on_faces(model), E, F),
            _padded(starts + parts[:, None] * (ends - starts), S, 3),
            _padded(owners, S),
            _padded(tangents, S, 3),
            _padded(lengths, S),
            _padded(corners, T, 3),
            _padded(triangle_faces, T, F),
            _padded(np.array([plane.origin for plane in planes]).reshape(-1, 3), F, 3),
            _padded(np.array([plane.normal for plane in planes]).reshape(-1, 3), F, 3),
            np.array(HIDING_MARGIN * model.extent),
            np.array(model.tolerance),
        )
        return cls(*map(to_device, arrays))

    @property
    @one_program
    def triangles(self) -> Float[Array, "T 3 3"]:
        """The corners of the faces' triangles, m; padded ones have no area."""
        return self.vertices[self.triangle_vertices]


def _rounded(count: int, smallest: int) -> int:
    """Return `smallest` times the least power of two that makes it at least a count."""
    size = smallest
    while size < count:
        size *= 2
    return size


def _padded(array: np.ndarray, *shape: int) -> np.ndarray:
    """Return an array with zeros appended up to a shape."""
    return np.pad(array, [(0, n - k) for n, k in zip(shape, array.shape, strict=True)])


def _sampled_edges(
    model: ObjectModel, samples: int, per_edge: int
) -> tuple[int, Int[np.ndarray, "S"], Float[np.ndarray, "S"], Float[np.ndarray, "S"]]:
    """Return the padded number of samples; and the edge, part and position of each sample.

    A part is a length in m, a position runs from 0 to 1 along the edge.
    """
    starts, ends = model.vertices[model.edges].transpose(1, 0, 2)
    lengths = np.linalg.norm(ends - starts, axis=1)
    if not (lengths > 0.0).all():
        raise ValueError(f"edge {int(np.argmin(lengths))} of model {model.name!r} has no length")
    size, counts = samples, _counts(lengths, samples, per_edge)
    while counts is None:
        size *= 2
        counts = _counts(lengths, size, per_edge)
    owners = np.repeat(np.arange(len(lengths)), counts)
    # The rank of each sample on its edge.
    order = np.arange(len(owners)) - np.repeat(np.cumsum(counts) - counts, counts)
    return size, owners, (lengths / counts)[owners], (order + 0.5) / counts[owners]


def _counts(
    lengths: Float[np.ndarray, "E"], samples: int, per_edge: int
) -> Int[np.ndarray, "E"] | None:
    """Return the number of samples of each edge, or None where long edges would get too few."""
    share = lengths / lengths.sum()
    least = np.maximum(per_edge, np.floor(MIN_DENSITY * samples * share).astype(int))
    if least.sum() > samples:
        return None
    # The largest density at which all samples together do not exceed their number.
    densities = np.linspace(1.0, MIN_DENSITY, 65) * samples
    counts = np.maximum(per_edge, np.floor(densities[:, None] * share).astype(int))
    return counts[np.argmax(counts.sum(axis=1) <= samples)]


def _vertices_on_faces(model: ObjectModel) -> Bool[np.ndarray, "V F"]:
    """Return whether each vertex is on the border of each face."""
    on = np.zeros((len(model.vertices), len(model.faces)), dtype=bool)
    for k, face in enumerate(model.faces):
        on[face.indices, k] = True
    return on


def _edges_on_faces(model: ObjectModel) -> Bool[np.ndarray, "E F"]:
    """Return whether each edge is on the border of each face."""
    # The border of a neighbouring face has the common edge in the opposite direction.
    sides = [{frozenset(pair) for pair in face.directed_edges} for face in model.faces]
    edges = [frozenset(edge) for edge in model.edges.tolist()]
    on = [[edge in border for border in sides] for edge in edges]
    return np.array(on, dtype=bool).reshape(len(edges), len(sides))


def _fans(model: ObjectModel) -> tuple[Int[np.ndarray, "T 3"], Bool[np.ndarray, "T F"]]:
    """Return the vertices of all faces' triangles, and the face that each belongs to."""
    fans = [_fan(face) for face in model.faces]
    owners = np.repeat(np.arange(len(fans)), [len(fan) for fan in fans])
    corners = np.concatenate(fans) if fans else np.zeros((0, 3), int)
    return corners, owners[:, None] == np.arange(len(fans))


def _fan(face: Face) -> Int[np.ndarray, "T 3"]:
    """Return the triangles between the first vertex of a face and its sides."""
    apex = face.loop[0]
    # Sides at the apex make no triangle. A side in line with it makes one without area, which may
    # gain area when a vertex is moved.
    sides = np.array([pair for pair in face.directed_edges if apex not in pair])
    return np.column_stack([np.full(len(sides), apex), sides])
