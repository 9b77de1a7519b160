"""Propose poses from two pictures: pairs of edges in space are aligned with pairs of the model's.

A segment of a picture and the camera's centre span a plane; the planes of two pictures meet in a
line. Two lines in space that are not parallel define a frame, by their common perpendicular and
their directions. No corners are needed, so that these may be hidden.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from ...features import Features, IdealPlane, grouped_indices
from ...geometry import host_poses
from ...modeling import ObjectModel

MIN_OVERLAP, MIN_OVERLAP_OF_LONGER = 0.5, 0.25
"""Smallest overlap of two segments across the epipolar lines, over the extent of the shorter and of
the longer segment: a part of either may be hidden."""

MIN_EXTENT = 4.0
"""Smallest extent of a segment across the epipolar lines, px; along them the depth is unknown."""

MAX_ANGLE_ERROR = float(np.deg2rad(4.0))
"""Largest difference between the angles of a pair in space and of a pair of the model, rad."""

MAX_DISTANCE_ERROR, MAX_REACH_ERROR = 0.03, 0.08
"""Largest errors of the distance between two lines, and of where their edges begin and end, over
the object's extent."""

MIN_SINE = float(np.sin(np.deg2rad(15.0)))
"""Sine of the smallest angle between two lines that define a frame."""

MAX_PAIRS = 30_000
"""Largest number of pairs of edges in space; the longest are kept."""


class SpaceEdges(NamedTuple):
    """Straight edges in space, of a model or triangulated from two pictures.

    Attributes:
        points: midpoints, m.
        directions: unit vectors.
        half_lengths: m.
    """

    points: Float[np.ndarray, "edges 3"]
    directions: Float[np.ndarray, "edges 3"]
    half_lengths: Float[np.ndarray, "edges"]


class EdgePairs(NamedTuple):
    """Pairs of directed edges that are not parallel, with their invariants under rigid motion.

    Attributes:
        cosine: of the angle between the directions.
        distance: signed distance of the lines along the product of the directions, m.
        reaches: where each edge begins and ends along its line, from the foot of the common
            perpendicular, m.
        feet: midpoint of the common perpendicular.
        frames: axes as columns: along the first edge, along the common perpendicular, and their
            product.
    """

    cosine: Float[np.ndarray, "pairs"]
    distance: Float[np.ndarray, "pairs"]
    reaches: Float[np.ndarray, "pairs 2 2"]
    feet: Float[np.ndarray, "pairs 3"]
    frames: Float[np.ndarray, "pairs 3 3"]


def stereo_edges(
    first: Features,
    second: Features,
    planes: tuple[IdealPlane, IdealPlane],
    camera_from_world: Float[np.ndarray, "2 4 4"],
) -> SpaceEdges:
    """Return an edge in space for every two segments of two pictures that may correspond.

    Args:
        first, second: features of the two pictures.
        planes: of the cameras that took them.
        camera_from_world: extrinsics of the two pictures.
    """
    R, t = camera_from_world[:, :3, :3], camera_from_world[:, :3, 3]
    centres = -np.einsum("vji,vj->vi", R, t)
    baseline = centres[1] - centres[0]
    length = float(np.linalg.norm(baseline))
    # Two pictures from the same place do not determine depth.
    if length == 0.0 or not len(first.segments) or not len(second.segments):
        return SpaceEdges(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    rays = [_end_rays(view, planes[k]) @ R[k] for k, view in enumerate((first, second))]
    least = [MIN_EXTENT / plane.focal_length for plane in planes]
    angles = _epipolar_angles(rays, baseline / length, least)
    low = np.maximum(angles[0].min(axis=1)[:, None], angles[1].min(axis=1)[None])
    high = np.minimum(angles[0].max(axis=1)[:, None], angles[1].max(axis=1)[None])
    extents = np.ix_(*(np.ptp(angle, axis=1) for angle in angles))
    needed = np.maximum(
        MIN_OVERLAP * np.minimum(*extents), MIN_OVERLAP_OF_LONGER * np.maximum(*extents)
    )
    # The lighter side is left of the direction in both views, so that corresponding segments cross
    # the epipolar lines in the same sense.
    senses = np.ix_(*(np.sign(angle[:, 1] - angle[:, 0]) for angle in angles))
    # Comparisons with NaN (segments along the epipolar lines) are false.
    with np.errstate(invalid="ignore"):
        i, j = np.nonzero((high - low > needed) & (senses[0] == senses[1]))
    # Normals of the planes through the centres and the segments; the edge lies in both planes.
    across = [np.cross(ray[:, 0], ray[:, 1]) for ray in rays]
    directions = np.cross(across[0][i], across[1][j])
    sines = np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions / np.where(sines > 0.0, sines, 1.0)
    # The first camera's rays to the ends of the overlap meet the second plane.
    ends = []
    for angle in (low[i, j], high[i, j]):
        share = (angle - angles[0][i, 0]) / (angles[0][i, 1] - angles[0][i, 0])
        ray = (1.0 - share)[:, None] * rays[0][i, 0] + share[:, None] * rays[0][i, 1]
        towards = (ray * across[1][j]).sum(axis=1)
        depth = (baseline * across[1][j]).sum(axis=1) / np.where(towards == 0.0, np.nan, towards)
        ends.append(centres[0] + depth[:, None] * ray)
    in_front = [(((end @ R[k].T + t[k])[:, 2]) > 0.0) for end in ends for k in (0, 1)]
    # Segments of different edges often meet behind a camera.
    good = np.all(in_front, axis=0) & (sines[:, 0] > 0.0)
    middle, half = 0.5 * (ends[0] + ends[1])[good], 0.5 * (ends[1] - ends[0])[good]
    return SpaceEdges(middle, directions[good], np.linalg.norm(half, axis=1))


def _end_rays(features: Features, plane: IdealPlane) -> Float[np.ndarray, "segments 2 3"]:
    """Return the unit rays of both ends of all segments, in the camera's frame."""
    return plane.rays(plane.from_pixels(features.segments.reshape(-1, 2))).reshape(-1, 2, 3)


def _epipolar_angles(
    rays: list[Float[np.ndarray, "_ 2 3"]], axis: Float[np.ndarray, "3"], least: Sequence[float]
) -> list[Float[np.ndarray, "_ 2"]]:
    """Return the angles about the baseline of the planes through the baseline and each ray, rad.

    The rays to one point in space have the same angle in both views. NaN for segments whose extent
    is below the least of their view.
    """
    # Zero is in the middle of the rays, so that no segment is split by the jump at half a turn.
    mean = np.concatenate([ray.reshape(-1, 3) for ray in rays]).mean(axis=0)
    x = mean - axis * (mean @ axis)
    x = x / np.linalg.norm(x)
    y = np.cross(axis, x)
    angles = [np.arctan2(ray @ y, ray @ x) for ray in rays]
    return [
        np.where(np.ptp(x, axis=1, keepdims=True) > smallest, x, np.nan)
        for x, smallest in zip(angles, least, strict=True)
    ]


def model_edges(model: ObjectModel) -> SpaceEdges:
    """Return the edges of a model."""
    starts, ends = model.vertices[model.edges].transpose(1, 0, 2)
    lengths = np.linalg.norm(ends - starts, axis=1)
    return SpaceEdges(0.5 * (starts + ends), (ends - starts) / lengths[:, None], 0.5 * lengths)


def edge_pairs(
    edges: SpaceEdges, i: Int[np.ndarray, "pairs"], j: Int[np.ndarray, "pairs"]
) -> tuple[EdgePairs, Bool[np.ndarray, "pairs"]]:
    """Return the frames of pairs of edges, and a mask of the pairs that have one."""
    d, e = edges.directions[i], edges.directions[j]
    normals = np.cross(d, e)
    sines = np.linalg.norm(normals, axis=1)
    good = sines > MIN_SINE
    i, j, d, e, normals = i[good], j[good], d[good], e[good], normals[good]
    normals = normals / sines[good][:, None]
    # Feet p + s d and q + r e of the common perpendicular: with w = q - p and c = d . e,
    #     s = (w . d - c w . e) / (1 - c^2),   r = (c w . d - w . e) / (1 - c^2).
    w, c = edges.points[j] - edges.points[i], (d * e).sum(axis=1)
    wd, we = (w * d).sum(axis=1), (w * e).sum(axis=1)
    s, r = (wd - c * we) / (1.0 - c**2), (c * wd - we) / (1.0 - c**2)
    feet = 0.5 * (edges.points[i] + s[:, None] * d + edges.points[j] + r[:, None] * e)
    halves = np.stack([edges.half_lengths[i], edges.half_lengths[j]], axis=1)[..., None]
    reaches = -np.stack([s, r], axis=1)[..., None] + halves * np.array([-1.0, 1.0])
    frames = np.stack([d, normals, np.cross(d, normals)], axis=-1)
    return EdgePairs(c, (w * normals).sum(axis=1), reaches, feet, frames), good


def poses_from_edges(scene: SpaceEdges, model: ObjectModel) -> Float[np.ndarray, "poses 4 4"]:
    """Return world_from_object for every match of a model's edge pair with a pair in space.

    Args:
        scene: edges in the world.
        model: model to be found.
    """
    edges = model_edges(model)
    extent = float(np.linalg.norm(np.ptp(model.vertices, axis=0)))
    in_space = _pairs_in_space(scene, extent, 2.0 * float(edges.half_lengths.max(initial=0.0)))
    in_model = _model_pairs(edges)
    if not len(in_space.cosine) or not len(in_model.cosine):
        return np.zeros((0, 4, 4))
    a, b = _alike(in_space, in_model, extent)
    rotations = in_space.frames[a] @ np.swapaxes(in_model.frames[b], -1, -2)
    # R aligns the frames, and t the feet.
    turned_feet = (rotations @ in_model.feet[b][..., None])[..., 0]
    return host_poses(rotations, in_space.feet[a] - turned_feet)


def _pairs_in_space(scene: SpaceEdges, extent: float, longest: float) -> EdgePairs:
    """Return the pairs of edges in space that may belong to one object of a given extent."""
    # Longer than any edge of the model: a table's edge, or segments that do not correspond.
    short = np.flatnonzero(2.0 * scene.half_lengths < longest + MAX_REACH_ERROR * extent)
    edges = SpaceEdges(*(part[short] for part in scene))
    if not len(short):
        return edge_pairs(edges, short, short)[0]
    i, j = KDTree(edges.points).query_pairs(extent, output_type="ndarray").T
    # Long edges determine the directions best.
    order = np.argsort(-np.minimum(edges.half_lengths[i], edges.half_lengths[j]), kind="stable")
    return edge_pairs(edges, i[order[:MAX_PAIRS]], j[order[:MAX_PAIRS]])[0]


def _model_pairs(edges: SpaceEdges) -> EdgePairs:
    """Return all pairs of a model's edges in both orders and all four choices of direction."""
    count = len(edges.half_lengths)
    # An edge in space has no known direction relative to the model's edge.
    both = SpaceEdges(
        np.tile(edges.points, (2, 1)),
        np.concatenate([edges.directions, -edges.directions]),
        np.tile(edges.half_lengths, 2),
    )
    i, j = np.nonzero(np.arange(2 * count)[:, None] % count != np.arange(2 * count) % count)
    return edge_pairs(both, i, j)[0]


def _alike(
    in_space: EdgePairs, in_model: EdgePairs, extent: float
) -> tuple[Int[np.ndarray, "matches"], Int[np.ndarray, "matches"]]:
    """Return which pairs in space agree with which pairs of the model."""
    # Sorted by angle, so that each pair of the model is compared only with pairs of similar angle.
    order = np.argsort(in_space.cosine)
    angles = np.arccos(np.clip(in_model.cosine, -1.0, 1.0))
    bounds = [np.cos(np.clip(angles + e, 0.0, np.pi)) for e in (MAX_ANGLE_ERROR, -MAX_ANGLE_ERROR)]
    first, last = (np.searchsorted(in_space.cosine[order], bound) for bound in bounds)
    b, place = grouped_indices(last - first)
    a = order[first[b] + place]
    near = np.abs(in_space.distance[a] - in_model.distance[b]) < MAX_DISTANCE_ERROR * extent
    a, b = a[near], b[near]
    # The visible part of an edge lies within it.
    slack = MAX_REACH_ERROR * extent
    within = in_space.reaches[a, :, 0] > in_model.reaches[b, :, 0] - slack
    within &= in_space.reaches[a, :, 1] < in_model.reaches[b, :, 1] + slack
    good = within.all(axis=1)
    return a[good], b[good]
