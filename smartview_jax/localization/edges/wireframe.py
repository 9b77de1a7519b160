"""Turn an object model into arrays of fixed sizes, with samples along its edges.

Sizes are rounded up, so that all models of usual size use the same compiled programs; padded
entries have zero length or are masked.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...features import grouped_indices
from ...modeling import ObjectModel, shape_sigma
from ...runtime.array_namespace import to_device
from ...runtime.compilation import one_program
from ...runtime.padding import power_of_two_from
from .curves import Curves, on_arcs
from .outlines import OutlineSamples, SmoothEdges, smooth_edges, wall_normals

EDGE_SAMPLES = 128
"""Default for the smallest number of samples along all edges together."""

MIN_EDGE_SAMPLES = 6
"""Default for the smallest number of samples of an edge: the four that a line needs
(`edge_lines.MIN_LINE_POINTS`) remain when the samples next to both vertices are left out."""

MIN_DENSITY = 0.5
"""Smallest density of samples on long edges, over the density without `MIN_EDGE_SAMPLES`.

Where short edges would take more of the samples, the number of all samples is doubled.
"""

MIN_VERTICES, MIN_EDGES, MIN_TRIANGLES, MIN_FACES, MIN_SMOOTH = 16, 32, 32, 16, 128
"""Smallest sizes of the arrays; larger ones are rounded up to a power of two."""

HIDING_MARGIN = 2e-3
"""Distance in front of a point, over the object's extent, within which no face hides it.

Measured vertices do not lie exactly in the planes of their faces, nor do touching solids fit
exactly.
"""


def shows(model: ObjectModel) -> bool:
    """Return whether anything of a model shows in pictures: edges, or the outline of a surface."""
    return bool(len(model.edges)) or bool(len(smooth_edges(model)[0]))


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
        sample_curves: straight edge, arc of a rim or patch of a smooth surface that each sample is
            measured with; the edge itself in models without round parts.
        sample_chains: rim or edge of each sample; -1 on an outline.
        edge_chains: rim that each edge belongs to; the edge itself where it belongs to none.
        sample_tangents: unit directions of the edges, from the first vertex to the second.
        sample_lengths: lengths of the parts, m; 0 for padded samples.
        triangle_vertices: corners of the faces' triangles; zeros for padded triangles.
        triangle_faces: the face that each triangle belongs to.
        face_points: a point of each face, m.
        face_normals: outward unit normals; 0 for padded faces.
        margin: distance in front of a point within which no face hides it, m.
        tolerance: standard deviation of the object's edges from the model, m (`shape_sigma`).
        sample_bends: curvatures of the rims, 1/m, towards their centres; zero on straight edges and
            outlines. None in models without rims.
        sample_radii: radii of the smooth surface across an outline, m; zero on edges. None in
            models without smooth surfaces.
        sample_walls: outward normals of the round surfaces next to a rim, up to two; zero
            elsewhere. None in models without smooth surfaces.
        smooth: smooth surfaces, whose outline depends on the viewpoint (`with_outline`); the last
            samples are kept for it. None in models without.
        curve_count: padded number of curves.
    """

    vertices: Float[Array, "V 3"]
    vertex_mask: Bool[Array, "V"]
    vertex_faces: Bool[Array, "V F"]
    edges: Int[Array, "E 2"]
    edge_mask: Bool[Array, "E"]
    edge_faces: Bool[Array, "E F"]
    samples: Float[Array, "S 3"]
    sample_edges: Int[Array, "S"]
    sample_curves: Int[Array, "S"]
    sample_chains: Int[Array, "S"]
    edge_chains: Int[Array, "E"]
    sample_tangents: Float[Array, "S 3"]
    sample_lengths: Float[Array, "S"]
    triangle_vertices: Int[Array, "T 3"]
    triangle_faces: Bool[Array, "T F"]
    face_points: Float[Array, "F 3"]
    face_normals: Float[Array, "F 3"]
    margin: Float[Array, ""]
    tolerance: Float[Array, ""]
    sample_bends: Float[Array, "S 3"] | None
    sample_radii: Float[Array, "S"] | None
    sample_walls: Float[Array, "S 2 3"] | None
    smooth: SmoothEdges | None
    curve_count: int = eqx.field(static=True)

    @classmethod
    def of(
        cls, model: ObjectModel, samples: int = EDGE_SAMPLES, per_edge: int = MIN_EDGE_SAMPLES
    ) -> "Wireframe":
        """Return the arrays of a model.

        Args:
            model: with edges, or with a smooth surface, whose outline shows.
            samples: number of samples along all edges together, in proportion to their lengths;
                doubled as often as short edges need it.
            per_edge: smallest number of samples of an edge, whatever its share of the length.

        Raises:
            ValueError: the model has neither, or edges without length, or `samples` or `per_edge`
                is not positive.
        """
        if not shows(model):
            raise ValueError(f"model {model.name!r} has no edges, so it cannot be searched for")
        for name, number in (("samples", samples), ("per_edge", per_edge)):
            if number < 1:
                raise ValueError(f"{name}: expected a positive number, found {number}")
        # All on the host, so that preparing a model compiles nothing.
        faces = model.faces
        curves = Curves.of(model)
        S, curve, lengths, places = _sampled_curves(model, curves, samples, per_edge)
        owners, parts = curves.places(curve, places)
        points, tangents, bends = on_arcs(model, owners, parts)
        corners, triangle_faces = _fans(model)
        V = power_of_two_from(len(model.vertices), MIN_VERTICES)
        E = power_of_two_from(len(model.edges), MIN_EDGES)
        T, F = (
            power_of_two_from(len(corners), MIN_TRIANGLES),
            power_of_two_from(len(faces), MIN_FACES),
        )
        planes = [model.plane(k) for k in range(len(faces))]
        face_normals = np.array([plane.normal for plane in planes]).reshape(-1, 3)
        triangles = corners, triangle_faces, face_normals
        count = len(owners) or samples
        smooth, patches = _smooth_edges(model, triangles, T, curves, count)
        S += 0 if smooth is None else smooth.slots
        arrays = (
            _padded(model.vertices, V, 3),
            np.arange(V) < len(model.vertices),
            _padded(_vertices_on_faces(model), V, F),
            _padded(model.edges, E, 2),
            np.arange(E) < len(model.edges),
            _padded(_edges_on_faces(model), E, F),
            _padded(points, S, 3),
            _padded(owners, S),
            _padded(curve, S),
            np.pad(curves.chain[owners], (0, S - len(owners)), constant_values=-1),
            _padded(curves.chain, E),
            _padded(tangents, S, 3),
            _padded(lengths, S),
            _padded(corners, T, 3),
            _padded(triangle_faces, T, F),
            _padded(np.array([plane.origin for plane in planes]).reshape(-1, 3), F, 3),
            _padded(face_normals, F, 3),
            np.array(HIDING_MARGIN * model.extent),
            np.array(shape_sigma(model)),
        )
        count = power_of_two_from(len(curves.lengths) + patches, MIN_EDGES)
        bends = None if bends is None else to_device(_padded(bends, S, 3))
        radii = walls = None
        if smooth is not None:
            radii = to_device(np.zeros(S))
            walls = to_device(_padded(wall_normals(model, curves)[owners], S, 2, 3))
        return cls(
            *map(to_device, arrays),
            sample_bends=bends,
            sample_radii=radii,
            sample_walls=walls,
            smooth=smooth,
            curve_count=count,
        )

    @property
    @one_program
    def triangles(self) -> Float[Array, "T 3 3"]:
        """The corners of the faces' triangles, m; padded ones have no area."""
        return self.vertices[self.triangle_vertices]


def _padded(array: np.ndarray, *shape: int) -> np.ndarray:
    """Return an array with zeros appended up to a shape."""
    return np.pad(array, [(0, n - k) for n, k in zip(shape, array.shape, strict=True)])


def _sampled_curves(
    model: ObjectModel, curves: Curves, samples: int, per_edge: int
) -> tuple[int, Int[np.ndarray, "S"], Float[np.ndarray, "S"], Float[np.ndarray, "S"]]:
    """Return the padded number of samples; and the curve, part and position of each sample.

    A part is a length in m, a position runs from 0 to 1 along the curve.
    """
    starts, ends = model.vertices[model.edges].transpose(1, 0, 2)
    of_edges = np.linalg.norm(ends - starts, axis=1)
    if not (of_edges > 0.0).all():
        raise ValueError(f"edge {int(np.argmin(of_edges))} of model {model.name!r} has no length")
    lengths = curves.lengths
    size, counts = (samples, _counts(lengths, samples, per_edge)) if len(lengths) else (0, lengths)
    while counts is None:
        size *= 2
        counts = _counts(lengths, size, per_edge)
    counts = np.asarray(counts, int)
    owners, order = grouped_indices(counts)
    return size, owners, (lengths / counts)[owners], (order + 0.5) / counts[owners]


def _counts(
    lengths: Float[np.ndarray, "C"], samples: int, per_edge: int
) -> Int[np.ndarray, "C"] | None:
    """Return the number of samples of each curve, or None where long ones would get too few."""
    share = lengths / lengths.sum()
    least = np.maximum(per_edge, np.floor(MIN_DENSITY * samples * share).astype(int))
    if least.sum() > samples:
        return None
    # The largest density at which all samples together do not exceed their number.
    densities = np.linspace(1.0, MIN_DENSITY, 65) * samples
    counts = np.maximum(per_edge, np.floor(densities[:, None] * share).astype(int))
    return counts[np.argmax(counts.sum(axis=1) <= samples)]


def _smooth_edges(
    model: ObjectModel,
    triangles: tuple[Int[np.ndarray, "_ 3"], Bool[np.ndarray, "_ F"], Float[np.ndarray, "F 3"]],
    padded: int,
    curves: Curves,
    samples: int,
) -> tuple[SmoothEdges | None, int]:
    """Return the smooth edges of a model and their number of patches; None and 0 without any.

    Args:
        model: of the object.
        triangles: corners and faces of the faces' triangles, and the faces' normals.
        padded: number of triangles with padding.
        curves: of the model.
        samples: number of samples on them; smooth edges have as many to a metre. A model without
            edges has a quarter of them around its extent: each is tested against all its faces.
    """
    length = curves.lengths.sum() or 4.0 * np.pi * model.extent
    outline = OutlineSamples.of(model, samples / length)
    if outline is None:
        return None, 0
    M = power_of_two_from(len(outline.points) + 1, MIN_SMOOTH)
    corners, triangle_faces, face_normals = triangles
    # Where all triangles of a face have one orientation, none of them cancels another.
    a, b, c = model.vertices[corners].transpose(1, 0, 2)
    of_face = triangle_faces.argmax(axis=1)
    outward = (np.cross(b - a, c - a) * face_normals[of_face]).sum(axis=1) >= 0.0
    is_fan = (triangle_faces & ~outward[:, None]).any(axis=0)
    is_lone = ~is_fan[of_face]
    fans = triangle_faces[:, is_fan]
    H = power_of_two_from(fans.shape[1], 2)
    arrays = (
        _padded(outline.points, M, 3),
        _padded(outline.parts, M, 3),
        _padded(outline.normals, M, 2, 3),
        _padded(outline.radii, M),
        _padded(len(curves.lengths) + outline.patches, M),
        _padded(is_lone, padded),
        _padded(fans, padded, H),
    )
    slots = power_of_two_from(outline.slots, MIN_EDGES)
    return SmoothEdges(*map(to_device, arrays), slots=slots), int(outline.patches.max()) + 1


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
    fans = [face.fan for face in model.faces]
    owners = np.repeat(np.arange(len(fans)), [len(fan) for fan in fans])
    corners = np.concatenate(fans) if fans else np.zeros((0, 3), int)
    return corners, owners[:, None] == np.arange(len(fans))
