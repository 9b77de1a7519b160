"""Propose poses from one picture: two segments that meet in a corner, and two edges of the model.

Such a path has three corners, and three points seen along three rays leave at most four poses.
Every path of the picture is tried with every path of the model.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..features import Features, IdealPlane
from ..modeling import ObjectModel
from .three_point_poses import three_point_poses

MIN_LENGTH = 10.0
"""Length of the shortest segment of a path, px."""

MIN_ANGLE = float(np.deg2rad(10.0))
"""Smallest angle between the two segments of a path, and between them and one line, rad."""


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


def _is_bent(triple: Float[np.ndarray, "3 2"]) -> bool:
    """Return whether three corners are not near one line."""
    first, second = triple[0] - triple[1], triple[2] - triple[1]
    sine = first[0] * second[1] - first[1] * second[0]
    return bool(abs(sine) > np.sin(MIN_ANGLE) * np.linalg.norm(first) * np.linalg.norm(second))


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
        if a != b and _is_bent_in_space(model.vertices[[a, middle, b]])
    ]
    return np.array(paths, dtype=int).reshape(-1, 3)


def _is_bent_in_space(triple: Float[np.ndarray, "3 3"]) -> bool:
    """Return whether three vertices are not near one line."""
    first, second = triple[0] - triple[1], triple[2] - triple[1]
    sine = np.linalg.norm(np.cross(first, second))
    return bool(sine > np.sin(MIN_ANGLE) * np.linalg.norm(first) * np.linalg.norm(second))


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
    # c = -R^T t in the object's frame; a face of normal n through o looks at it if n . c > n . o.
    R, t = camera_from_object[..., :3, :3], camera_from_object[..., :3, 3]
    centres = -(np.swapaxes(R, -1, -2) @ t[..., None])[..., 0]
    facing = np.isfinite(centres[..., 0])
    if not model.faces:
        return facing
    planes = [model.plane(k) for k in range(len(model.faces))]
    normals = np.array([plane.normal for plane in planes])
    offsets = np.array([plane.normal @ plane.origin for plane in planes])
    with np.errstate(invalid="ignore"):
        is_facing = centres @ normals.T > offsets
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
