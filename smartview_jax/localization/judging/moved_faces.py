"""Test whether the object has other dimensions than the model, by moving one face at a time.

Many manufactured parts have right angles, and some lengths in common. A pose at the corner of
another block fits exactly, as far as that block agrees with the model, and the rest could be
occluded. But the rest of that block is visible: if a face of the model is moved along its normal to
where the block ends, its edges match, at the same distance in all views. Occluded edges of the true
object match nowhere.

Each face with too few matched edges is moved by itself: its vertices slide along the edges that
lead to it, so that all other faces stay in their planes; where this is not possible, the whole
object is stretched along the normal.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from ...cameras import AnyCamera
from ...modeling import ObjectModel, SeenViews, pixel_jacobians
from ...runtime.array_namespace import to_device
from ...runtime.compilation import compiled_optimised
from ...runtime.padding import in_batches
from ..edges import EdgeLines, EdgeLookup, Wireframe, padded_poses
from ..refining import THREADS, lengths_at, places_on_edges

FOUND_FACE_SHARE = 0.6
"""Explained share of a face's edges above which the face counts as found, and is not moved."""

MOVED_SAMPLES = 256
"""Number of samples along all edges for this test."""

PLACES_PER_BATCH = 16
"""Number of distances of a face that one call of the compiled program tries."""

STEP_PX = 3.0
"""Largest movement of a vertex in a picture from one trial distance to the next, px.

Edges are found within `EXPLAINED_DISTANCE` on both sides.
"""

MIN_MOVED_PX = 8.0
"""Smallest movement of a moved face, px, in the picture where it moves most.

With less, its edges would be explained by the same points as at its place in the model.
"""

FARTHEST = 0.6
"""Largest distance by which a face is moved, over the object's extent."""

SHORTEST = 0.15
"""Share of its length that every edge keeps when a face is moved."""

MIN_SLOPE = 0.2
"""Smallest cosine between a face's normal and an edge along which a vertex slides."""

THINNEST = 0.02
"""Smallest height of a moved face above the object's lowest point, over the object's extent."""

MAX_PLACES = 240
"""Largest number of distances at which a face is tried, the nearest ones, to limit the time."""


class MovedFace(NamedTuple):
    """The distance of a face at which the changed solid explains most of the pictures.

    Attributes:
        face: index of the face in the model; None if every face is found, or none explains more
            when moved.
        distance: displacement along its outward normal from its place in the model, m.
        gained_px: edge length found with the moved face minus the length found with the model, all
            views together, px.
    """

    face: int | None
    distance: float
    gained_px: float


class _Rates(NamedTuple):
    """Derivatives of a wireframe's arrays by the distance of a face; all are linear in it.

    Attributes:
        vertices, samples, face_points: changes. Normals keep their directions where vertices slide,
            and nearly do where the object is stretched.
        sample_tangents: changes of the edges, over their lengths in the model. A tangent grows with
            its edge, so that the unchanged `sample_lengths` still add up to the edge's length.
    """

    vertices: Float[Array, "V 3"]
    samples: Float[Array, "S 3"]
    sample_tangents: Float[Array, "S 3"]
    face_points: Float[Array, "F 3"]


def likeliest_moved_face(
    pose: Float[np.ndarray, "4 4"],
    model: ObjectModel,
    lines: EdgeLines,
    views: SeenViews,
    lookup: EdgeLookup,
) -> MovedFace:
    """Return the face whose displacement along its normal makes the model explain most.

    Args:
        pose: world_from_object.
        model: of the object.
        lines: edges measured at the pose, in all views.
        views: camera and poses.
        lookup: edge points of the views.
    """
    best = MovedFace(None, 0.0, 0.0)
    wireframe = Wireframe.of(model, MOVED_SAMPLES)
    edge_faces = np.asarray(wireframe.edge_faces).astype(float)
    visible, explained = (
        px.sum(axis=0) @ edge_faces for px in (lines.visible_px, lines.explained_px)
    )
    for face in np.flatnonzero(explained < FOUND_FACE_SHARE * visible):
        movements = movements_of_face(model, int(face))
        # Distance 0, the unchanged model, comes first.
        distances = np.append(0.0, face_places(model, movements, pose, views))
        if len(distances) == 1:
            continue
        rates = _rates(wireframe, model, movements)
        found_px = _found_lengths(wireframe, rates, distances, pose, views, lookup)
        k = int(np.argmax(found_px))
        gained_px = float(found_px[k] - found_px[0])
        if gained_px > best.gained_px:
            best = MovedFace(int(face), float(distances[k]), gained_px)
    return best


def _rates(wireframe: Wireframe, model: ObjectModel, movements: Float[np.ndarray, "V 3"]) -> _Rates:
    """Return the derivatives of a model's wireframe by the distance of a face."""
    padded = np.zeros(wireframe.vertices.shape)
    padded[: len(movements)] = movements
    origins = np.zeros(wireframe.face_points.shape)
    for k, face in enumerate(model.faces):
        origins[k] = movements[list(face.loop)].mean(axis=0)
    owners = np.asarray(wireframe.sample_edges)
    a, b = model.edges[owners].T
    lengths = np.linalg.norm(model.vertices[b] - model.vertices[a], axis=1)
    parts = places_on_edges(model, np.asarray(wireframe.samples), owners)
    change = movements[b] - movements[a]
    return _Rates(
        to_device(padded),
        # Samples keep their fractions along the edges.
        to_device(movements[a] + parts[:, None] * change),
        to_device(change / lengths[:, None]),
        to_device(origins),
    )


def _found_lengths(
    wireframe: Wireframe,
    rates: _Rates,
    distances: Float[np.ndarray, "places"],
    pose: Float[np.ndarray, "4 4"],
    views: SeenViews,
    lookup: EdgeLookup,
) -> Float[np.ndarray, "places"]:
    """Return the edge length that is found with a face at each distance, px."""
    poses = padded_poses(views.camera_from_world)
    camera, arrays = views.camera_for(len(poses)), (to_device(poses), to_device(pose))

    def of_batch(batch: Float[Array, "places"]) -> Float[Array, "places"]:
        return _found_at_places(wireframe, rates, camera, lookup, *arrays, batch)

    return in_batches(of_batch, distances, PLACES_PER_BATCH, THREADS)


@compiled_optimised
def _found_at_places(
    wireframe: Wireframe,
    rates: _Rates,
    camera: AnyCamera,
    lookup: EdgeLookup,
    camera_from_world: Float[Array, "views 4 4"],
    pose: Float[Array, "4 4"],
    distances: Float[Array, "places"],
) -> Float[Array, "places"]:
    """Return the edge length found at each distance of a face, all views together."""

    def at(distance: Float[Array, ""]) -> Float[Array, ""]:
        moved = _moved(wireframe, rates, distance)
        return lengths_at(moved, camera, lookup, camera_from_world, pose)[1]

    return jax.lax.map(at, distances)


def _moved(wireframe: Wireframe, rates: _Rates, distance: Float[Array, ""]) -> Wireframe:
    """Return the wireframe with a face at a distance from its place in the model, m."""
    return eqx.tree_at(
        lambda tree: [getattr(tree, name) for name in _Rates._fields],
        wireframe,
        [getattr(wireframe, name) + distance * rate for name, rate in rates._asdict().items()],
    )


def movements_of_face(model: ObjectModel, face: int) -> Float[np.ndarray, "V 3"]:
    """Return how far each vertex moves when a face moves by 1 m along its outward normal.

    The vertices of the face slide along the edges that lead to it, if exactly one leads to each.
    Otherwise, or where such an edge runs nearly along the face, the whole object is stretched: each
    vertex moves in proportion to its height above the lowest one. Nothing moves if the face itself
    is lowest, as in a sheet.
    """
    border, normal = model.faces[face].indices, model.plane(face).normal
    movements = np.zeros_like(model.vertices)
    for vertex in border:
        ends = model.edges[(model.edges == vertex).any(axis=1)]
        leading = sorted(set(ends.ravel().tolist()) - set(border))
        if len(leading) != 1:
            return _stretched(model, face)
        along = model.vertices[vertex] - model.vertices[leading[0]]
        slope = float(along @ normal)
        if abs(slope) < MIN_SLOPE * float(np.linalg.norm(along)):
            return _stretched(model, face)
        movements[vertex] = along / slope
    return movements


def _stretched(model: ObjectModel, face: int) -> Float[np.ndarray, "V 3"]:
    """Return how far each vertex moves when the object is stretched along a face's normal."""
    normal = model.plane(face).normal
    heights = model.vertices @ normal
    height = heights[model.faces[face].indices].mean() - heights.min()
    if height < THINNEST * model.extent:
        return np.zeros_like(model.vertices)
    return (heights - heights.min())[:, None] / height * normal


def face_places(
    model: ObjectModel,
    movements: Float[np.ndarray, "V 3"],
    pose: Float[np.ndarray, "4 4"],
    views: SeenViews,
) -> Float[np.ndarray, "places"]:
    """Return the distances at which a face is tried, m, the nearest first; may be empty."""
    px = _px_per_metre(model, movements, pose, views)
    if px == 0.0:
        return np.zeros(0)
    # Every edge keeps a share of its length: length + t rate >= `SHORTEST` length.
    a, b = model.edges.T
    along = model.vertices[b] - model.vertices[a]
    rates = ((movements[b] - movements[a]) * along).sum(axis=1) / (along**2).sum(axis=1)
    farthest = FARTHEST * model.extent
    outwards, inwards = (
        float(((1.0 - SHORTEST) / rate[rate > 0.0]).min(initial=farthest))
        for rate in (-rates, rates)
    )
    step = STEP_PX / px
    steps = np.arange(-int(inwards / step), int(outwards / step) + 1)
    steps = steps[np.abs(steps) * STEP_PX >= MIN_MOVED_PX]
    return step * steps[np.argsort(np.abs(steps), kind="stable")][:MAX_PLACES]


def _px_per_metre(
    model: ObjectModel,
    movements: Float[np.ndarray, "V 3"],
    pose: Float[np.ndarray, "4 4"],
    views: SeenViews,
) -> float:
    """Return the largest movement of a vertex in any picture when a face moves by 1 m, px."""
    R, t = pose[:3, :3], pose[:3, 3]
    by_point = pixel_jacobians(views, model.vertices @ R.T + t).by_point
    moved = np.einsum("vpij,pj->vpi", by_point, movements @ R.T)
    return float(np.linalg.norm(moved, axis=2).max(initial=0.0))
