"""Find the outline of a smooth surface: where it turns away from the camera.

The side of a cylinder has no sharp edge, and yet its outline is an edge of the picture as good as
any. Where it lies on the surface depends on the viewpoint. On a mesh it runs along the edges
between a triangle that faces the camera and one that faces away; there the smooth surface's normal,
between the two triangles' normals, is across the ray.

When the object moves, its outline slides on the surface, but along the rays: to first order a point
of the surface moves in the picture across the outline as the outline does (Cipolla and Giblin,
"Visual motion of curves and surfaces", 2000, chapter 4). So a step of a fit may hold the points.
"""

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...features import grouped_indices
from ...geometry import spiral_directions
from ...modeling import ObjectModel, faces_by_edge
from .curves import Curves

if TYPE_CHECKING:
    from .wireframe import Wireframe

MIN_BEND = 1e-3
"""Smallest angle between two faces, rad, for the edge between them to be an outline: less is a flat
face in two parts."""

PATCH = 1.0 / 6.0
"""Size of the patches in which an outline is measured as one edge, over the object's extent."""

DIRECTIONS = 256
"""Number of viewpoints from which the longest outline is looked for."""

ROOM = 1.25
"""Room for outline samples, over the largest number seen from these viewpoints."""


class SmoothEdges(eqx.Module):
    """Samples along the edges of a mesh that do not show, but may be outlines.

    Attributes:
        points: m.
        parts: the part of its edge that each sample stands for, as a vector, m.
        normals: outward unit normals of the two faces; zero for padded samples.
        radii: of the surface across each edge, m.
        curves: patch of the surface that each belongs to; its outline is measured as one edge.
        lone_triangles: triangles of the wireframe that cover a point alone.
        fan_faces: triangles of the faces that are covered only by all their triangles together.
        slots: largest number of samples on an outline.
    """

    points: Float[Array, "M 3"]
    parts: Float[Array, "M 3"]
    normals: Float[Array, "M 2 3"]
    radii: Float[Array, "M"]
    curves: Int[Array, "M"]
    lone_triangles: Bool[Array, "T"]
    fan_faces: Bool[Array, "T H"]
    slots: int = eqx.field(static=True)


def smooth_edges(
    model: ObjectModel,
) -> tuple[Int[np.ndarray, "N 2"], Float[np.ndarray, "N 2 3"], Float[np.ndarray, "N"]]:
    """Return the edges of a model's mesh that may be outlines.

    They do not show, and the surface is convex across them: a hollow never is an outline.

    Returns:
        pairs of vertices; the outward normals of both faces; and the radius of the surface across
        each edge, m, from the widths of the faces and the angle between them.
    """
    sharp = {frozenset(pair) for pair in model.edges.tolist()}
    pairs, normals, radii = [], [], []
    planes = [model.plane(k) for k in range(len(model.faces))]
    for pair, owners in faces_by_edge(model.faces).items():
        if len(owners) != 2 or pair in sharp:
            continue
        a, b = sorted(pair)
        n = np.array([planes[k].normal for k in owners])
        along = model.vertices[b] - model.vertices[a]
        # From the edge to the farthest vertex of each face, across the edge.
        ways = [
            np.cross(model.vertices[model.faces[k].indices] - model.vertices[a], along)
            for k in owners
        ]
        widths = [np.linalg.norm(w, axis=1).max() / np.linalg.norm(along) for w in ways]
        inner = model.vertices[model.faces[owners[1]].indices].mean(axis=0) - model.vertices[a]
        bend = np.linalg.norm(np.cross(n[0], n[1]))
        if bend > MIN_BEND and n[0] @ inner < 0.0:
            pairs.append((a, b))
            normals.append(n)
            # A chord of the width w turns by the angle w / r.
            radii.append(min(widths) / bend)
    shape = len(pairs)
    return (
        np.array(pairs, int).reshape(shape, 2),
        np.array(normals).reshape(shape, 2, 3),
        np.array(radii),
    )


def wall_normals(model: ObjectModel, curves: Curves) -> Float[np.ndarray, "E 2 3"]:
    """Return the outward normals of the round surfaces next to each edge of a rim; zero for none.

    A face along the whole rim is flat; the facets of a round surface change from edge to edge.
    """
    normals = np.zeros((len(model.edges), 2, 3))
    owners = faces_by_edge(model.faces)
    faces = [owners.get(frozenset(pair), []) for pair in model.edges.tolist()]
    for chain in np.flatnonzero(np.bincount(curves.chain) > 1):
        edges = np.flatnonzero(curves.chain == chain)
        along = np.concatenate([faces[edge] for edge in edges]).astype(int)
        is_facet = np.bincount(along, minlength=len(model.faces)) == 1
        for edge in edges:
            facets = [face for face in faces[edge] if is_facet[face]][:2]
            for k, face in enumerate(facets):
                normals[edge, k] = model.plane(face).normal
    return normals


class SeenEdges(NamedTuple):
    """Samples of the edges or of the outline that a camera sees.

    Attributes:
        points, lengths: in the object's frame, m.
        tangents: unit directions of the edges.
    """

    points: Float[np.ndarray, "n 3"]
    tangents: Float[np.ndarray, "n 3"]
    lengths: Float[np.ndarray, "n"]


class OutlineSamples(NamedTuple):
    """The arrays of `SmoothEdges` without padding, and its number of slots."""

    points: Float[np.ndarray, "M 3"]
    parts: Float[np.ndarray, "M 3"]
    normals: Float[np.ndarray, "M 2 3"]
    radii: Float[np.ndarray, "M"]
    patches: Int[np.ndarray, "M"]
    slots: int

    @classmethod
    def of(cls, model: ObjectModel, density: float) -> "OutlineSamples | None":
        """Return samples along the smooth edges of a model; None if there are none.

        Args:
            model: with faces.
            density: samples to a metre; each edge has at least one.
        """
        pairs, normals, radii = smooth_edges(model)
        if not len(pairs):
            return None
        starts, ends = model.vertices[pairs].transpose(1, 0, 2)
        lengths = np.linalg.norm(ends - starts, axis=1)
        counts = np.maximum(1, np.rint(density * lengths).astype(int))
        owners, order = grouped_indices(counts)
        along = (ends - starts)[owners] / counts[owners, None]
        places = (order + 0.5) / counts[owners]
        points = starts[owners] + (order + 0.5)[:, None] * along
        points += _bulges(model, pairs, normals, owners, places)
        # Patches by the place of the edge, and by where it looks: the sides of a tube are apart.
        middles = 0.5 * (starts + ends)
        mean = normals.sum(axis=1)
        largest = np.abs(mean).argmax(axis=1)
        side = 2 * largest + (mean[np.arange(len(mean)), largest] > 0.0)
        cells = np.floor(middles / (PATCH * model.extent)).astype(int)
        keys = np.column_stack([cells, side])
        patches = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
        most = _most_on_outline(middles, normals, counts, model)
        slots = int(np.ceil(ROOM * most))
        return cls(points, along, normals[owners], radii[owners], patches[owners], slots)

    def seen_from(self, centre: Float[np.ndarray, "3"]) -> SeenEdges:
        """Return the outline as a camera sees it, hidden or not, to within the mesh's facets.

        Args:
            centre: the camera's centre in the object's frame, m.
        """
        ray = centre - self.points
        towards = (self.normals * ray[:, None]).sum(axis=2) > 0.0
        chosen = towards[:, 0] != towards[:, 1]
        tangents = np.cross(self.normals[chosen].sum(axis=1), ray[chosen])
        tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
        lengths = np.abs((self.parts[chosen] * tangents).sum(axis=1))
        return SeenEdges(self.points[chosen], tangents, lengths)


def _bulges(
    model: ObjectModel,
    pairs: Int[np.ndarray, "N 2"],
    normals: Float[np.ndarray, "N 2 3"],
    owners: Int[np.ndarray, "S"],
    places: Float[np.ndarray, "S"],
) -> Float[np.ndarray, "S 3"]:
    """Return how far the smooth surface is beyond the straight edges of its mesh, m.

    It is on cubics whose ends are across the normals of the vertices, as the edges of PN triangles
    are (Vlachos et al., "Curved PN triangles", 2001). Vertices on sharp edges have no normal; there
    the edge is straight.

    Args:
        model: with faces.
        pairs, normals: vertices and faces' normals of the smooth edges (`smooth_edges`).
        owners, places: smooth edge of each sample, and its place on it, from 0 to 1.
    """
    sums = np.zeros((len(model.vertices), 3))
    np.add.at(sums, pairs, normals.sum(axis=1)[:, None])
    sums[np.unique(model.edges)] = 0.0
    sizes = np.linalg.norm(sums, axis=1, keepdims=True)
    n = sums / np.where(sizes > 0.0, sizes, 1.0)
    along = np.diff(model.vertices[pairs], axis=1)
    u, v = (-(along * n[pairs]).sum(axis=2, keepdims=True) * n[pairs]).swapaxes(0, 1)
    t = places[:, None]
    return t * (1.0 - t) ** 2 * u[owners] - t**2 * (1.0 - t) * v[owners]


def _most_on_outline(
    middles: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 2 3"],
    counts: Int[np.ndarray, "N"],
    model: ObjectModel,
) -> int:
    """Return the largest number of samples that are on the outline from any viewpoint."""
    directions = spiral_directions(1.0 - 2.0 * (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS)
    most, middle = 0, model.vertices.mean(axis=0)
    offsets = (normals * middles[:, None]).sum(axis=2)
    # From near and from afar.
    for distance in (2.0 * model.extent, 20.0 * model.extent):
        towards = normals @ (middle + distance * directions).T > offsets[:, :, None]
        most = max(most, int((counts @ (towards[:, 0] != towards[:, 1])).max()))
    return most


def with_outline(wireframe: "Wireframe", centre: Float[Array, "3"]) -> "Wireframe":
    """Return a wireframe with the outline of its smooth surfaces among its samples.

    Args:
        wireframe: of a model; unchanged if it has no smooth surfaces.
        centre: the camera's centre in the object's frame, m.
    """
    smooth = wireframe.smooth
    if smooth is None:
        return wireframe
    ray = centre[None] - smooth.points
    towards = (smooth.normals * ray[:, None]).sum(axis=2)
    is_outline = (towards[:, 0] > 0.0) != (towards[:, 1] > 0.0)
    # The last sample is a padded one, of no length.
    last = len(smooth.points) - 1
    (chosen,) = jnp.nonzero(is_outline, size=smooth.slots, fill_value=last)
    weights = jnp.abs(towards[chosen])
    # The normal between the two that is across the ray: t1 n0 + t0 n1 for t = n . ray.
    n0, n1 = smooth.normals[chosen, 0], smooth.normals[chosen, 1]
    normal = weights[:, 1:] * n0 + weights[:, :1] * n1
    normal = normal / _size(normal)
    # An edge is on the round surface, whose normal there is between both; the outline is where
    # its normal is this one, as far on as the radius times the difference.
    middle = n0 + n1
    turned = normal - middle / _size(middle)
    points = smooth.points[chosen] + smooth.radii[chosen][:, None] * turned
    tangents = jnp.cross(normal, ray[chosen])
    tangents = tangents / _size(tangents)
    # The edges of a mesh run to and fro across its outline: only their part along it counts.
    lengths = jnp.abs((smooth.parts[chosen] * tangents).sum(axis=1))
    slots, radii = smooth.slots, smooth.radii[chosen]
    return dataclasses.replace(
        wireframe,
        samples=jnp.concatenate([wireframe.samples[:-slots], points]),
        sample_tangents=jnp.concatenate([wireframe.sample_tangents[:-slots], tangents]),
        sample_lengths=jnp.concatenate([wireframe.sample_lengths[:-slots], lengths]),
        sample_curves=jnp.concatenate([wireframe.sample_curves[:-slots], smooth.curves[chosen]]),
        sample_radii=jnp.concatenate([jnp.zeros_like(wireframe.sample_lengths[:-slots]), radii]),
    )


def _size(vectors: Float[Array, "n 3"]) -> Float[Array, "n 1"]:
    """Return the lengths of vectors to divide by; one for zero."""
    size = jnp.sqrt((vectors**2).sum(axis=1, keepdims=True))
    return jnp.where(size > 0.0, size, 1.0)
