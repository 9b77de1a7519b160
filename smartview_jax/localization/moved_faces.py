"""Ask whether a face of an object is elsewhere: the pictures may show a solid of another size.

Many manufactured parts have right angles, and some lengths in common. A pose at the corner of
another block fits exactly, as far as that block agrees with the model, and the rest could be
hidden. What gives it away is that the rest of the block is there: a face of the model, moved along
its normal to where the block has its own, finds that block's edges, at the same distance in all
views. The hidden edges of the object itself are found nowhere.

Each face of which too little is found is moved by itself. Its vertices slide along the edges that
lead to it, so that all other faces stay in their planes; where that is not possible, the whole
object is stretched along the normal.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from ..array_namespace import to_device
from ..cameras import Camera
from ..compilation import compiled_optimised
from ..modeling import ObjectModel, SeenViews, pixel_jacobians
from ..padding import repeat_last
from .edge_lines import EdgeLines
from .edge_lookup import EdgeLookup, padded_poses
from .pose_convergence import in_batches, lengths_at
from .refinement import places_on_edges
from .wireframe import Wireframe

FOUND_FACE_SHARE = 0.6
"""Explained share of a face's edges from which the face counts as found, and is not moved."""

MOVED_SAMPLES = 256
"""Number of points along all edges at which it is asked what is found."""

STEP_PX = 3.0
"""Largest movement of a vertex in a picture from one tried place of a face to the next, px.

Edges are found within `EXPLAINED_DISTANCE` on both sides.
"""

MIN_MOVED_PX = 8.0
"""Smallest movement of a face that is elsewhere, px, in the picture where it moves most.

Nearer, its edges would be explained by the same points as at its place in the model.
"""

FARTHEST = 0.6
"""Largest distance by which a face is moved, over the extent of the object."""

SHORTEST = 0.15
"""Part of its length that every edge keeps where a face is moved."""

MIN_SLOPE = 0.2
"""Smallest cosine between a face's normal and an edge along which its vertex slides."""

THINNEST = 0.02
"""Smallest height of a face that is moved, from the object's lowest point, over its extent."""

MAX_PLACES = 240
"""Largest number of places at which a face is tried, the nearest ones, a limit of time."""

PLACES_PER_BATCH = 16
"""Number of places that are tried by one call of a compiled program."""


class MovedFace(NamedTuple):
    """The place of a face at which a solid like the model explains most of the pictures.

    Attributes:
        face: index of the face in the model; None if every face is found, or none explains more
            elsewhere.
        distance: from its place in the model, along its outward normal, m.
        gained_px: edge length found of the solid with the moved face, minus that found of the
            model, all views together, px.
    """

    face: int | None
    distance: float
    gained_px: float


class _Rates(NamedTuple):
    """Derivatives of the arrays of a wireframe by the distance of a face, in which all is linear.

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
    """Return the face that explains most more of the pictures where it is moved along its normal.

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
        # Distance 0, the model as it is, comes first.
        distances = np.append(0.0, _places(model, movements, pose, views))
        if len(distances) == 1:
            continue
        rates = _rates(wireframe, model, movements)
        found_px = _found_lengths(wireframe, rates, distances, pose, views, lookup)
        k = int(np.argmax(found_px))
        gained_px = float(found_px[k] - found_px[0])
        if gained_px > best.gained_px:
            best = MovedFace(int(face), float(distances[k]), gained_px)
    return best


def movements_of_face(model: ObjectModel, face: int) -> Float[np.ndarray, "V 3"]:
    """Return how far each vertex moves where a face moves by 1 m along its outward normal.

    The vertices of the face slide along the edges that lead to it, one to each. Where several edges
    or none lead to a vertex, or one runs nearly along the face, the whole object is stretched: each
    vertex moves in proportion to its height above the lowest one. Nothing moves where the face is
    not above it, as of a sheet.
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
    """Return how far each vertex moves where the object is stretched along a face's normal."""
    normal = model.plane(face).normal
    heights = model.vertices @ normal
    own = heights[model.faces[face].indices].mean() - heights.min()
    if own < THINNEST * model.extent:
        return np.zeros_like(model.vertices)
    return (heights - heights.min())[:, None] / own * normal


def _places(
    model: ObjectModel,
    movements: Float[np.ndarray, "V 3"],
    pose: Float[np.ndarray, "4 4"],
    views: SeenViews,
) -> Float[np.ndarray, "places"]:
    """Return the distances at which a face is tried, m, the nearest first; none if it stays."""
    px = _px_per_metre(model, movements, pose, views)
    if px == 0.0:
        return np.zeros(0)
    # No edge becomes shorter than a part of itself: length + t rate >= `SHORTEST` length.
    a, b = model.edges.T
    along = model.vertices[b] - model.vertices[a]
    rates = ((movements[b] - movements[a]) * along).sum(axis=1) / (along**2).sum(axis=1)
    farthest = FARTHEST * model.extent
    outwards, inwards = (
        float(((1.0 - SHORTEST) / own[own > 0.0]).min(initial=farthest)) for own in (-rates, rates)
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
    """Return the largest movement of a vertex in any picture where a face moves by 1 m, px."""
    R, t = pose[:3, :3], pose[:3, 3]
    by_point = pixel_jacobians(views, model.vertices @ R.T + t).by_point
    moved = np.einsum("vpij,pj->vpi", by_point, movements @ R.T)
    return float(np.linalg.norm(moved, axis=2).max(initial=0.0))


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
        # Samples stay at their parts of the edges.
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
    """Return the edge length that is found with a face at each of its places, px."""
    arrays = to_device(padded_poses(views.camera_from_world)), to_device(pose)

    def of_batch(own: Float[np.ndarray, "places"]) -> Float[np.ndarray, "places"]:
        batch = to_device(repeat_last(own, PLACES_PER_BATCH))
        found = _found_at_places(wireframe, rates, views.camera, lookup, *arrays, batch)
        return np.asarray(found)[: len(own)]

    return np.concatenate(in_batches(of_batch, distances, PLACES_PER_BATCH))


@compiled_optimised
def _found_at_places(
    wireframe: Wireframe,
    rates: _Rates,
    camera: Camera,
    lookup: EdgeLookup,
    camera_from_world: Float[Array, "views 4 4"],
    pose: Float[Array, "4 4"],
    distances: Float[Array, "places"],
) -> Float[Array, "places"]:
    """Return the edge length that is found, all views together, at each distance of a face."""

    def at(distance: Float[Array, ""]) -> Float[Array, ""]:
        moved = _moved(wireframe, rates, distance)
        return lengths_at(moved, camera, lookup, camera_from_world, pose)[1]

    return jax.lax.map(at, distances)


def _moved(wireframe: Wireframe, rates: _Rates, distance: Float[Array, ""]) -> Wireframe:
    """Return the wireframe with a face at a distance from its place in the model, m."""
    return eqx.tree_at(
        lambda one: [getattr(one, name) for name in _Rates._fields],
        wireframe,
        [getattr(wireframe, name) + distance * rate for name, rate in rates._asdict().items()],
    )
