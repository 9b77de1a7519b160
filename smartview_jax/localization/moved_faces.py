"""Ask whether a face of an object is elsewhere: the pictures may show a solid of another size.

Much of what is made has right angles and some lengths in common. A pose at the corner of another
block fits exactly, as far as that block agrees with the model, and the rest could be hidden. What
gives it away is that the rest of the block is there: where a face of the model is moved along its
normal to where the block's own face is, its edges are found, in all views at the same distance. The
hidden edges of the object itself are found nowhere.

Each face of which too little is found is moved by itself. Its vertices slide along the edges that
lead to it, so that all other faces stay in their planes; where that is not possible, the whole
object is stretched along the normal.
"""

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..array_namespace import to_device
from ..cameras import Camera
from ..compilation import compiled_optimised
from ..modeling import ObjectModel, SeenViews
from ..padding import repeat_last
from .edge_lines import EXPLAINED_DISTANCE, EdgeLines, lines_in_views
from .edge_lookup import EdgeLookup, padded_poses
from .pose_convergence import THREADS
from .wireframe import Wireframe

MOVABLE_SHARE = 0.6
"""Explained share of a face's edges from which the face is where the model has it."""

MOVED_SAMPLES = 256
"""Number of points along all edges at which it is asked what is found."""

STEP_PX = 3.0
"""Largest movement of a vertex in a picture from one tried place of a face to the next, px.

Edges are found within `EXPLAINED_DISTANCE` on both sides.
"""

MIN_MOVED_PX = 8.0
"""Smallest movement of a face that is elsewhere, px, in the picture where it moves most.

An edge near its place in the model has the points that are there.
"""

FARTHEST = 0.6
"""Largest distance by which a face is moved, over the extent of the object."""

SHORTEST = 0.15
"""Part of its length that every edge keeps where a face is moved."""

MIN_SLOPE = 0.2
"""Smallest cosine between a face's normal and an edge along which its vertex slides."""

MAX_PLACES = 160
"""Largest number of places at which a face is tried, a limit of time."""

PLACES_PER_BATCH = 16
"""Number of places that are tried by one call of a compiled program."""


class MovedFace(NamedTuple):
    """The place of a face at which a solid like the model explains most of the pictures.

    Attributes:
        face: index of the face in the model; None where no face has to be moved, or can be.
        distance: from its place in the model, along its outward normal, m.
        gained_px: edge length that is found of such a solid, less that which is found of the model,
            all views together, px.
    """

    face: int | None
    distance: float
    gained_px: float


class _Rates(NamedTuple):
    """Derivatives of the arrays of a wireframe by the distance of a face, in which all is linear.

    Attributes:
        vertices, samples, triangles, face_points, face_normals: changes.
        sample_tangents: changes of the edges, over their lengths in the model: of an edge that
            becomes longer the tangent does, and the samples stand for what they did.
    """

    vertices: Float[Array, "V 3"]
    samples: Float[Array, "S 3"]
    sample_tangents: Float[Array, "S 3"]
    triangles: Float[Array, "T 3 3"]
    face_points: Float[Array, "F 3"]
    face_normals: Float[Array, "F 3"]


def likeliest_moved_face(
    pose: Float[np.ndarray, "4 4"],
    model: ObjectModel,
    lines: EdgeLines,
    views: SeenViews,
    lookup: EdgeLookup,
) -> MovedFace:
    """Return the face that would explain most of the pictures at another place than it has.

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
    for face in np.flatnonzero(explained < MOVABLE_SHARE * visible):
        movements = movements_of_face(model, int(face))
        # The model itself comes first.
        distances = np.append(0.0, _places(model, movements, pose, views))
        rates = _rates(wireframe, model, movements)
        found_px = _found_lengths(wireframe, rates, distances, pose, views, lookup)
        k = int(np.argmax(found_px))
        gained_px = float(found_px[k] - found_px[0])
        if gained_px > best.gained_px:
            best = MovedFace(int(face), float(distances[k]), gained_px)
    return best


def movements_of_face(model: ObjectModel, face: int) -> Float[np.ndarray, "V 3"]:
    """Return by what each vertex moves where a face moves by one along its outward normal.

    The vertices of the face slide along the edges that lead to it, one to each. Where there are
    more or none, or where they lead along the face, the object is stretched: each vertex moves by
    its height over the lowest one.
    """
    border, normal = model.faces[face].indices, model.plane(face).normal
    movements = np.zeros_like(model.vertices)
    for vertex in border:
        ends = {end for edge in model.edges.tolist() if vertex in edge for end in edge}
        leading = sorted(ends - set(border))
        along = model.vertices[vertex] - model.vertices[leading].mean(axis=0)
        slope = float(along @ normal) / max(float(np.linalg.norm(along)), 1e-12)
        if len(leading) != 1 or abs(slope) < MIN_SLOPE:
            heights = model.vertices @ normal
            heights = (heights - heights.min()) / max(float(np.ptp(heights)), 1e-12)
            return heights[:, None] * normal
        movements[vertex] = along / float(along @ normal)
    return movements


def _places(
    model: ObjectModel,
    movements: Float[np.ndarray, "V 3"],
    pose: Float[np.ndarray, "4 4"],
    views: SeenViews,
) -> Float[np.ndarray, "places"]:
    """Return the distances at which a face is tried, m."""
    # No edge becomes shorter than a part of itself: length + t rate >= `SHORTEST` length.
    a, b = model.edges.T
    along = model.vertices[b] - model.vertices[a]
    rates = ((movements[b] - movements[a]) * along).sum(axis=1) / (along**2).sum(axis=1)
    farthest = FARTHEST * float(np.ptp(model.vertices, axis=0).max())
    outwards, inwards = (
        float(((1.0 - SHORTEST) / own[own > 0.0]).min(initial=farthest)) for own in (-rates, rates)
    )
    px = _px_per_metre(model, movements, pose, views)
    step = max(STEP_PX / px, (inwards + outwards) / MAX_PLACES)
    places = step * np.arange(-int(inwards / step), int(outwards / step) + 1)
    return places[np.abs(places) * px >= MIN_MOVED_PX]


def _px_per_metre(
    model: ObjectModel,
    movements: Float[np.ndarray, "V 3"],
    pose: Float[np.ndarray, "4 4"],
    views: SeenViews,
) -> float:
    """Return by how much the vertices move at most in a picture where a face moves by 1 m, px."""
    camera_from_object = views.camera_from_world @ pose
    R, t = camera_from_object[:, :3, :3], camera_from_object[:, None, :3, 3]
    p, d = model.vertices @ R.swapaxes(1, 2) + t, movements @ R.swapaxes(1, 2)
    # d(x / z) = (dx - (x / z) dz) / z; the lens changes little of it.
    depths = np.maximum(p[..., 2:], 1e-6)
    moved = (d[..., :2] - p[..., :2] / depths * d[..., 2:]) / depths
    focal = max(float(views.camera.alpha_u), float(views.camera.alpha_v))
    return focal * float(np.linalg.norm(moved, axis=2).max())


def _rates(wireframe: Wireframe, model: ObjectModel, movements: Float[np.ndarray, "V 3"]) -> _Rates:
    """Return the derivatives of a model's wireframe by the distance of a face."""
    unit = 1e-3 * float(np.ptp(model.vertices, axis=0).max())
    moved = Wireframe.of(
        dataclasses.replace(model, vertices=model.vertices + unit * movements, symmetry=None), 1
    )
    changes = {
        name: (np.asarray(getattr(moved, name)) - np.asarray(getattr(wireframe, name))) / unit
        for name in ("vertices", "triangles", "face_points", "face_normals")
    }
    # Samples stay at their parts of the edges.
    a, b = model.edges[np.asarray(wireframe.sample_edges)].T
    along = model.vertices[b] - model.vertices[a]
    lengths = np.linalg.norm(along, axis=1, keepdims=True)
    gaps = np.asarray(wireframe.samples) - model.vertices[a]
    parts = (gaps * along).sum(axis=1, keepdims=True) / lengths**2
    change = movements[b] - movements[a]
    changes |= {"samples": movements[a] + parts * change, "sample_tangents": change / lengths}
    return _Rates(**{name: to_device(change) for name, change in changes.items()})


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

    starts = range(0, len(distances), PLACES_PER_BATCH)
    batches = [distances[start : start + PLACES_PER_BATCH] for start in starts]
    # The first one compiles the program, if need be.
    with ThreadPoolExecutor(THREADS) as pool:
        return np.concatenate([*map(of_batch, batches[:1]), *pool.map(of_batch, batches[1:])])


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
        moved = eqx.tree_at(
            lambda one: [getattr(one, name) for name in _Rates._fields],
            wireframe,
            [getattr(wireframe, name) + distance * rate for name, rate in rates._asdict().items()],
        )
        radius = jnp.asarray(EXPLAINED_DISTANCE)
        lines = lines_in_views(moved, camera, lookup, camera_from_world, pose, radius)
        return lines.explained_px.sum()

    return jax.lax.map(at, distances)
