"""Propose poses from one picture near approximate poses, from three distant vertices.

A path of two edges is a small part of a large object: an error of its ends by one pixel moves the
far side of the object by many pixels, more than the refinement on edges can correct. But few
junctions of the picture lie near the predicted vertices and have a segment along one of the
vertex's edges. Three vertices far apart, each matched with such a junction, leave at most four
poses, and no edge needs to be visible from end to end. It is one step of Kosaka and Kak's search
for many poses at once: predict, gate, and compute a pose from three points instead of an update.
"""

from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from ..features import Features, IdealPlane
from .three_point_poses import three_point_poses
from .wireframe import Wireframe

SEARCH_SHARE, MIN_SEARCH = 0.1, 10.0
"""Search radius about a predicted vertex: its fraction of the object's extent in the picture, and
the smallest radius, px. A path of a third of the extent with ends wrong by some px errs so much."""

MAX_DIRECTION_ERROR = float(np.deg2rad(15.0))
"""Largest angle between a segment of a junction and an edge of the vertex in the picture, rad."""

MAX_NEIGHBOURS, MAX_JUNCTIONS = 8, 3
"""Largest number of nearest junctions that are checked for a vertex, and of junctions that are
tried for it."""

MAX_TRIPLES, COMPARED_TRIPLES = 3, 2000
"""Largest number of vertex triples that are tried at each pose, and of triples from which they are
chosen."""


class Junctions(NamedTuple):
    """Corners of a picture where segments meet or end, each with a fixed number of segments.

    Attributes:
        ideal: ideal coordinates, px.
        rays: unit rays in the camera's frame.
        directions: unit directions of the segments in ideal coordinates; NaN for missing segments.
        focal_length: of the ideal coordinates, px.
        camera_from_world: extrinsics of the picture.
    """

    ideal: Float[np.ndarray, "junctions 2"]
    rays: Float[np.ndarray, "junctions 3"]
    directions: Float[np.ndarray, "junctions joined 2"]
    focal_length: float
    camera_from_world: Float[np.ndarray, "4 4"]

    @classmethod
    def of(
        cls, features: Features, plane: IdealPlane, camera_from_world: Float[np.ndarray, "4 4"]
    ) -> "Junctions":
        """Return the junctions among the corners of a picture.

        Args:
            features: of the picture.
            plane: of the camera that took it.
            camera_from_world: extrinsics of the picture.
        """
        joins = features.corner_segments[:, 0] >= 0
        count = int(joins.sum())
        pixels = np.concatenate([features.corners[joins], features.segments.reshape(-1, 2)])
        ideal = plane.from_pixels(pixels)
        along = np.diff(ideal[count:].reshape(-1, 2, 2), axis=1)[:, 0]
        # One more row, for "no segment": the index -1 selects it.
        units = np.full((len(along) + 1, 2), np.nan)
        units[:-1] = along / np.linalg.norm(along, axis=1, keepdims=True)
        return cls(
            ideal[:count],
            plane.rays(ideal[:count]),
            units[features.corner_segments[joins]],
            plane.focal_length,
            camera_from_world,
        )


def poses_from_triples(
    junctions: Junctions, wireframe: Wireframe, world_from_object: Float[np.ndarray, "poses 4 4"]
) -> Float[np.ndarray, "found 4 4"]:
    """Return poses near given ones at which three distant vertices fall on junctions.

    Args:
        junctions: of the picture.
        wireframe: of the model to be found.
        world_from_object: approximate poses; poses with a vertex behind the camera are left out.

    Returns:
        world_from_object, any number for each pose.
    """
    vertices = np.asarray(wireframe.vertices)[np.asarray(wireframe.vertex_mask)]
    poses = junctions.camera_from_world @ world_from_object
    poses = poses[(_in_camera(vertices, poses)[..., 2] > 0.0).all(axis=1)]
    places = _projected(vertices, poses, junctions.focal_length)
    visible = _visible_vertices(wireframe, poses)
    radii = np.maximum(SEARCH_SHARE * _extents(places, visible), MIN_SEARCH)
    edges = np.asarray(wireframe.edges)[np.asarray(wireframe.edge_mask)]
    near = _junctions_of_vertices(junctions, edges, places, np.where(visible, radii[:, None], 0.0))
    owners, chosen, corners = _problems(places, near)
    solved, good = three_point_poses(junctions.rays[corners], vertices[chosen])
    problem, which = np.nonzero(good)
    solved, owners = solved[problem, which], owners[problem]
    # The other solutions of a triple turn the object around, away from the given pose.
    moved = _projected(vertices, solved, junctions.focal_length) - places[owners]
    near_by = np.median(np.linalg.norm(moved, axis=2), axis=1) < radii[owners]
    return np.linalg.inv(junctions.camera_from_world) @ solved[near_by]


def _in_camera(
    vertices: Float[np.ndarray, "V 3"], poses: Float[np.ndarray, "poses 4 4"]
) -> Float[np.ndarray, "poses V 3"]:
    """Return the vertices in the camera's frame."""
    return vertices @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]


def _projected(
    vertices: Float[np.ndarray, "V 3"], poses: Float[np.ndarray, "poses 4 4"], focal_length: float
) -> Float[np.ndarray, "poses V 2"]:
    """Return the vertices in ideal coordinates."""
    points = _in_camera(vertices, poses)
    return focal_length * points[..., :2] / points[..., 2:]


def _visible_vertices(
    wireframe: Wireframe, poses: Float[np.ndarray, "poses 4 4"]
) -> Bool[np.ndarray, "poses V"]:
    """Return which vertices are on a face that faces the camera, or on no face."""
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    centres = -(np.swapaxes(R, 1, 2) @ t[..., None])[..., 0]
    normals, points = np.asarray(wireframe.face_normals), np.asarray(wireframe.face_points)
    # Padded faces have a zero normal and face nothing.
    facing = centres @ normals.T > (normals * points).sum(axis=1)
    owners = np.asarray(wireframe.vertex_faces)[np.asarray(wireframe.vertex_mask)]
    return (facing[:, None] & owners).any(axis=2) | ~owners.any(axis=1)


def _extents(
    places: Float[np.ndarray, "poses V 2"], visible: Bool[np.ndarray, "poses V"]
) -> Float[np.ndarray, "poses"]:
    """Return the diagonals of the visible vertices' bounding boxes, px; zero for no vertices."""
    low = np.where(visible[..., None], places, np.inf).min(axis=1)
    high = np.where(visible[..., None], places, -np.inf).max(axis=1)
    return np.linalg.norm(np.maximum(high - low, 0.0), axis=1)


def _junctions_of_vertices(
    junctions: Junctions,
    edges: Int[np.ndarray, "E 2"],
    places: Float[np.ndarray, "poses V 2"],
    radii: Float[np.ndarray, "poses V"],
) -> Int[np.ndarray, "poses V near"]:
    """Return the nearest junctions of each vertex that fit one of its edges, padded with -1."""
    matched = np.full((*places.shape[:2], MAX_JUNCTIONS), -1)
    farthest = float(radii.max(initial=0.0))
    pairs = KDTree(junctions.ideal).query(places, MAX_NEIGHBOURS, distance_upper_bound=farthest)
    distances, nearest = (np.asarray(part) for part in pairs)
    pose, vertex, place = np.nonzero(distances < radii[..., None])
    corner = nearest[pose, vertex, place]
    arms = _edge_directions(edges, places)[pose, vertex][:, :, None]
    segments = junctions.directions[corner][:, None]
    sines = arms[..., 0] * segments[..., 1] - arms[..., 1] * segments[..., 0]
    # Comparisons with NaN, where there are fewer edges or segments, are false.
    with np.errstate(invalid="ignore"):
        fits = (np.abs(sines) < np.sin(MAX_DIRECTION_ERROR)).any(axis=(1, 2))
    pose, vertex, corner = pose[fits], vertex[fits], corner[fits]
    # Sorted by vertex, then by distance: the rank of each junction among its vertex's junctions.
    group = pose * places.shape[1] + vertex
    rank = np.arange(len(group)) - np.searchsorted(group, group)
    first = rank < MAX_JUNCTIONS
    matched[pose[first], vertex[first], rank[first]] = corner[first]
    return matched


def _edge_directions(
    edges: Int[np.ndarray, "E 2"], places: Float[np.ndarray, "poses V 2"]
) -> Float[np.ndarray, "poses V degree 2"]:
    """Return the unit directions, in the picture, of the edges at each vertex, padded with NaN."""
    ends = np.concatenate([edges, edges[:, ::-1]])
    ends = ends[np.argsort(ends[:, 0], kind="stable")]
    place = np.arange(len(ends)) - np.searchsorted(ends[:, 0], ends[:, 0])
    along = places[:, ends[:, 1]] - places[:, ends[:, 0]]
    directions = np.full((*places.shape[:2], int(place.max()) + 1, 2), np.nan)
    # An edge seen from its end has no direction: 0 / 0.
    with np.errstate(invalid="ignore"):
        directions[:, ends[:, 0], place] = along / np.linalg.norm(along, axis=2, keepdims=True)
    return directions


def _problems(
    places: Float[np.ndarray, "poses V 2"],
    near: Int[np.ndarray, "poses V near"],
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n 3"], Int[np.ndarray, "n 3"]]:
    """Return the pose, the vertices and the junctions of each three-point problem."""
    pose, triples = _wide_triples(places, near[..., 0] >= 0)
    # Each junction of the first vertex with each junction of the other two.
    choice = np.array(list(product(range(near.shape[2]), repeat=3)))
    corners = near[pose[:, None, None], triples[:, None], choice]
    triple, which = np.nonzero((corners >= 0).all(axis=2))
    return pose[triple], triples[triple], corners[triple, which]


def _wide_triples(
    places: Float[np.ndarray, "poses V 2"],
    usable: Bool[np.ndarray, "poses V"],
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n 3"]]:
    """Return the largest triangles of usable vertices at each pose, no two with a common side."""
    triples = _vertex_triples(places.shape[1])
    if not len(triples):
        return np.zeros(0, dtype=int), np.zeros((0, 3), dtype=int)
    first, second = (places[:, triples[:, k]] - places[:, triples[:, 0]] for k in (1, 2))
    areas = np.abs(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])
    areas = np.where(usable[:, triples].all(axis=2), areas, 0.0)
    chosen = []
    for _ in range(MAX_TRIPLES):
        best = areas.argmax(axis=1)
        pose = np.flatnonzero(areas[np.arange(len(areas)), best] > 0.0)
        chosen.append((pose, triples[best[pose]]))
        # A junction that is not the vertex spoils every triple with this vertex.
        common = (triples[:, :, None] == triples[best][:, None, None]).any(axis=3).sum(axis=2)
        areas[common > 1] = 0.0
    return np.concatenate([p for p, _ in chosen]), np.concatenate([t for _, t in chosen])


def _vertex_triples(count: int) -> Int[np.ndarray, "triples 3"]:
    """Return triples of vertices: all of them, or `COMPARED_TRIPLES` evenly spaced ones."""
    triples = np.array(list(combinations(range(count), 3)), dtype=int).reshape(-1, 3)
    if len(triples) <= COMPARED_TRIPLES:
        return triples
    return triples[np.linspace(0, len(triples) - 1, COMPARED_TRIPLES).astype(int)]
