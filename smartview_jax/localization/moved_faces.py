"""Ask whether a face of an object is elsewhere: the pictures may show a solid of another size.

Many manufactured parts have right angles, and some lengths in common. A pose at the corner of
another block fits exactly, as far as that block agrees with the model, and the rest could be
hidden. What gives it away is that the rest of the block is there: a face of the model, moved along
its normal to where the block has its own, finds that block's edges, at the same distance in all
views. The hidden edges of the object itself are found nowhere.

Each face of which too little is found is moved by itself (`sliding_faces`).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from ..cameras import Camera
from ..modeling import ObjectModel, SeenViews
from ..runtime.array_namespace import to_device
from ..runtime.compilation import compiled_optimised
from ..runtime.padding import repeat_last
from .edge_lines import EdgeLines
from .edge_lookup import EdgeLookup, padded_poses
from .pose_convergence import in_batches, lengths_at
from .refinement import places_on_edges
from .sliding_faces import face_places, movements_of_face
from .wireframe import Wireframe

FOUND_FACE_SHARE = 0.6
"""Explained share of a face's edges from which the face counts as found, and is not moved."""

MOVED_SAMPLES = 256
"""Number of points along all edges at which it is asked what is found."""

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
