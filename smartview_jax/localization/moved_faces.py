"""Test whether the object has other dimensions than the model, by moving one face at a time.

Many manufactured parts have right angles, and some lengths in common. A pose at the corner of
another block fits exactly, as far as that block agrees with the model, and the rest could be
occluded. But the rest of that block is visible: if a face of the model is moved along its normal to
where the block ends, its edges match, at the same distance in all views. Occluded edges of the true
object match nowhere.

Each face with too few matched edges is moved by itself (`sliding_faces`).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from ..cameras import AnyCamera
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
"""Explained share of a face's edges above which the face counts as found, and is not moved."""

MOVED_SAMPLES = 256
"""Number of samples along all edges for this test."""

PLACES_PER_BATCH = 16
"""Number of distances of a face that one call of the compiled program tries."""


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

    def of_batch(batch_distances: Float[np.ndarray, "places"]) -> Float[np.ndarray, "places"]:
        batch = to_device(repeat_last(batch_distances, PLACES_PER_BATCH))
        lengths = _found_at_places(wireframe, rates, camera, lookup, *arrays, batch)
        return np.asarray(lengths)[: len(batch_distances)]

    return np.concatenate(in_batches(of_batch, distances, PLACES_PER_BATCH))


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
