"""Propose poses from the corners of one picture.

Two segments that meet in a corner are a path with three corners, and three points seen along three
rays leave at most four poses. Every path of the picture is tried with every path of the model.

A path of two edges is a small part of a large object: an error of its ends by one pixel moves the
far side of the object by many pixels, more than the refinement on edges can correct. But near an
approximate pose few junctions of the picture lie near the predicted vertices and have a segment
along one of the vertex's edges. Three vertices far apart, each matched with such a junction, leave
at most four poses, and no edge needs to be visible from end to end. It is one step of Kosaka and
Kak's search for many poses at once: predict, gate, and compute a pose from three points instead of
an update.
"""

from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from ...features import Features, IdealPlane
from ...geometry import host_transformed
from ...modeling import ObjectModel
from ..edges import Wireframe
from .three_point_poses import three_point_poses

MIN_LENGTH = 10.0
"""Length of the shortest segment of a path, px."""

MIN_ANGLE = float(np.deg2rad(10.0))
"""Smallest angle between the two segments of a path, and between them and one line, rad."""

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


class PicturePaths(NamedTuple):
    """Paths of two segments of one picture that meet in a corner.

    Attributes:
        pixels: the three corners; the segments meet in the middle one.
        rays: unit rays of the corners, in the camera's frame.
        segments: indices of the two segments.
        corners: index of the corner in the middle.
    """

    pixels: Float[np.ndarray, "paths 3 2"]
    rays: Float[np.ndarray, "paths 3 3"]
    segments: Int[np.ndarray, "paths 2"]
    corners: Int[np.ndarray, "paths"]


def picture_paths(features: Features, plane: IdealPlane, count: int) -> PicturePaths:
    """Return the most promising paths of a picture: long segments that end at other segments.

    Args:
        features: of the picture.
        plane: of the camera that took it.
        count: largest number of paths.
    """
    pixels, segments, corners, anchored = [], [], [], []
    # An end that meets another segment is more probably a vertex than an end where the edge fades
    # out.
    is_junction = _ends_at_junctions(features)
    for k, joined in enumerate(features.corner_segments):
        arms = [arm for s in joined[joined >= 0] for arm in _arms(features, k, int(s))]
        for i, (first, first_end) in enumerate(arms):
            for second, second_end in arms[:i]:
                triple = np.array(
                    [
                        features.segments[first, first_end],
                        features.corners[k],
                        features.segments[second, second_end],
                    ]
                )
                # The two ends of one segment that runs through the corner are no path.
                if first != second and _is_bent(triple):
                    pixels.append(triple)
                    segments.append((first, second))
                    corners.append(k)
                    anchored.append(
                        is_junction[first, first_end] + 0.0 + is_junction[second, second_end]
                    )
    triples = np.array(pixels).reshape(-1, 3, 2)
    lengths = np.linalg.norm(np.diff(triples, axis=1), axis=2)
    # The shorter segment limits the accuracy of the pose, and an end without a corner may lie
    # anywhere along its edge.
    merit = lengths.min(axis=1, initial=np.inf) * (1.0 + np.array(anchored))
    order = np.argsort(-merit, kind="stable")[:count]
    rays = plane.rays(plane.from_pixels(triples[order].reshape(-1, 2))).reshape(-1, 3, 3)
    return PicturePaths(
        triples[order],
        rays,
        np.array(segments, dtype=int).reshape(-1, 2)[order],
        np.array(corners, dtype=int)[order],
    )


def _arms(features: Features, corner: int, segment: int) -> list[tuple[int, int]]:
    """Return the ends of a segment away from a corner; both where it runs through the corner."""
    reach = np.linalg.norm(features.segments[segment] - features.corners[corner], axis=1)
    return [(segment, end) for end in (0, 1) if reach[end] >= MIN_LENGTH]


def _ends_at_junctions(features: Features) -> np.ndarray:
    """Return whether another segment meets each end of each segment."""
    at = np.zeros((len(features.segments), 2), dtype=bool)
    for k in np.flatnonzero(features.corner_segments[:, 1] >= 0):
        joined = features.corner_segments[k]
        for s in joined[joined >= 0]:
            # A segment that ends at a corner has exactly the corner as its end.
            at[s] |= np.abs(features.segments[s] - features.corners[k]).max(axis=1) < 1e-6
    return at


def _is_bent(triple: Float[np.ndarray, "3 _"]) -> bool:
    """Return whether three points, in the picture or in space, are not near one line."""
    first, second = triple[0] - triple[1], triple[2] - triple[1]
    lengths = np.linalg.norm(first) * np.linalg.norm(second)
    return bool(abs(first @ second) < np.cos(MIN_ANGLE) * lengths)


def model_paths(model: ObjectModel) -> Int[np.ndarray, "paths 3"]:
    """Return all ordered triples of vertices with edges from the middle one to the other two."""
    neighbours: dict[int, list[int]] = {}
    for a, b in model.edges.tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    paths = [
        (a, middle, b)
        for middle, around in sorted(neighbours.items())
        for a in around
        for b in around
        if a != b and _is_bent(model.vertices[[a, middle, b]])
    ]
    return np.array(paths, dtype=int).reshape(-1, 3)


def poses_from_paths(
    paths: PicturePaths, model: ObjectModel, camera_from_world: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "poses 4 4"]:
    """Return world_from_object of every path of the model on every path of a picture.

    Args:
        paths: of the picture.
        model: to be found.
        camera_from_world: extrinsics of the picture.
    """
    chosen = model_paths(model)
    if not len(chosen) or not len(paths.rays):
        return np.zeros((0, 4, 4))
    # Every path of the picture with every path of the model, which has both orders of the ends.
    count = len(paths.rays)
    rays = np.repeat(paths.rays, len(chosen), axis=0)
    points = np.tile(model.vertices[chosen], (count, 1, 1))
    poses, good = three_point_poses(rays, points)
    # Half of the solutions show the path from behind.
    good &= _path_faces_camera(model, np.tile(chosen, (count, 1)), poses)
    world_from_camera = np.linalg.inv(camera_from_world)
    return world_from_camera @ poses[good]


def _path_faces_camera(
    model: ObjectModel,
    paths: Int[np.ndarray, "n 3"],
    camera_from_object: Float[np.ndarray, "n 4 4 4"],
) -> Bool[np.ndarray, "n 4"]:
    """Return whether each edge of a path has a face on the camera's side; False for NaN."""
    facing = np.isfinite(camera_from_object[..., 0, 3])
    if not model.faces:
        return facing
    planes = [model.plane(k) for k in range(len(model.faces))]
    normals, points = np.array([(plane.normal, plane.origin) for plane in planes]).swapaxes(0, 1)
    is_facing = _faces_camera(camera_from_object, normals, points)
    owners = _faces_of_edges(model)
    for side in (0, 1):
        faces = owners[paths[:, side], paths[:, side + 1]][:, None]
        # An edge without a face is visible from everywhere.
        facing = facing & ((is_facing & faces).any(axis=-1) | ~faces.any(axis=-1))
    return facing


def _faces_of_edges(model: ObjectModel) -> Bool[np.ndarray, "V V F"]:
    """Return whether the edge between two vertices is a side of a face."""
    count = len(model.vertices)
    owners = np.zeros((count, count, len(model.faces)), dtype=bool)
    for k, face in enumerate(model.faces):
        for a, b in face.directed_edges:
            owners[a, b, k] = owners[b, a, k] = True
    return owners


def _faces_camera(
    camera_from_object: Float[np.ndarray, "*n 4 4"],
    normals: Float[np.ndarray, "F 3"],
    points: Float[np.ndarray, "F 3"],
) -> Bool[np.ndarray, "*n F"]:
    """Return which planes, by their outward normals and a point, face the camera; False for NaN."""
    # c = -R^T t in the object's frame; a face of normal n through o looks at it if n . c > n . o.
    R, t = camera_from_object[..., :3, :3], camera_from_object[..., :3, 3]
    centres = -(np.swapaxes(R, -1, -2) @ t[..., None])[..., 0]
    with np.errstate(invalid="ignore"):
        return np.asarray(centres @ normals.T > (normals * points).sum(axis=1))


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
    poses = poses[(host_transformed(poses, vertices)[..., 2] > 0.0).all(axis=1)]
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


def _projected(
    vertices: Float[np.ndarray, "V 3"], poses: Float[np.ndarray, "poses 4 4"], focal_length: float
) -> Float[np.ndarray, "poses V 2"]:
    """Return the vertices in ideal coordinates."""
    points = host_transformed(poses, vertices)
    return focal_length * points[..., :2] / points[..., 2:]


def _visible_vertices(
    wireframe: Wireframe, poses: Float[np.ndarray, "poses 4 4"]
) -> Bool[np.ndarray, "poses V"]:
    """Return which vertices are on a face that faces the camera, or on no face."""
    normals, points = np.asarray(wireframe.face_normals), np.asarray(wireframe.face_points)
    # Padded faces have a zero normal and face nothing.
    facing = _faces_camera(poses, normals, points)
    owners = np.asarray(wireframe.vertex_faces)[np.asarray(wireframe.vertex_mask)]
    is_seen = (facing[:, None] & owners).any(axis=2) | ~owners.any(axis=1)
    return np.asarray(is_seen)


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
