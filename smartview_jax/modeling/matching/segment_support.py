"""Find which points are joined by straight segments of the pictures."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from ...features import Features, IdealPlane
from ...geometry import host_transformed
from ..view_poses import SeenViews, project_points
from .tracks import flags_of

MAX_OFFSET = 1.5
"""Largest distance of a point from the line of a segment that joins it, px."""

MAX_END_DISTANCE = 8.0
"""Largest distance of a point beyond the end of a segment that joins it, px."""

MIN_COVERED = 0.75
"""Smallest share of the distance between two points that a segment covers."""

MIN_SEPARATION = 6.0
"""Smallest distance in the picture between two points that are joined, px."""


def joined_points(
    features: Features,
    pixels: Float[np.ndarray, "points 2"],
    rays: Float[np.ndarray, "points 3"],
    focal_length: float,
) -> tuple[Int[np.ndarray, "joined 2"], Int[np.ndarray, "joined"]]:
    """Return the pairs of points that follow one another on a segment, and the segment of each.

    Pixels are NaN where a point is not visible; rays are unit vectors in the camera's frame.
    """
    visible = np.flatnonzero(np.isfinite(pixels).all(axis=1))
    # The sine of the angle between a ray and a segment's plane is the distance in units of 1 / f.
    offset = np.abs(features.lines @ rays[visible].T) * focal_length
    starts, ends = features.segments[:, 0], features.segments[:, 1]
    lengths = np.linalg.norm(ends - starts, axis=1)
    directions = (ends - starts) / np.maximum(lengths, 1e-12)[:, None]
    along = np.einsum("skj,sj->sk", pixels[visible] - starts[:, None], directions)
    near = (offset < MAX_OFFSET) & (along > -MAX_END_DISTANCE)
    near &= along < lengths[:, None] + MAX_END_DISTANCE
    pairs, segments = [], []
    for k in np.flatnonzero(near.sum(axis=1) >= 2):
        # Neighbours along the segment are joined directly; others through them.
        members = np.flatnonzero(near[k])
        members = members[np.argsort(along[k, members])]
        for p, q in pairwise(members):
            low, high = along[k, p], along[k, q]
            covered = min(high, lengths[k]) - max(low, 0.0)
            if high - low >= MIN_SEPARATION and covered >= MIN_COVERED * (high - low):
                pairs.append(sorted((visible[p], visible[q])))
                segments.append(k)
    return np.array(pairs, dtype=int).reshape(-1, 2), np.array(segments, dtype=int)


def junction_counts(
    views_features: tuple[Features, ...], corners: Int[np.ndarray, "views points"]
) -> Int[np.ndarray, "points"]:
    """Return in how many views two or more segments meet in the corner of each point."""
    joins = [
        flags_of(row, features.corner_segments[:, 1] >= 0)
        for row, features in zip(corners, views_features, strict=True)
    ]
    return np.sum(joins, axis=0)


def joined_edges(
    views: SeenViews, views_features: tuple[Features, ...], points: Float[np.ndarray, "points 3"]
) -> tuple[Int[np.ndarray, "edges 2"], Int[np.ndarray, "views edges"]]:
    """Return pairs of points that segments of two or more views join, and these segments."""
    # Segments count wherever both points project, even where no corner was found.
    projected = project_points(views, points)
    segment_of: dict[tuple[int, int], Int[np.ndarray, "views"]] = {}
    for k, features in enumerate(views_features):
        plane = IdealPlane(views.cameras[k])
        rays = host_transformed(views.camera_from_world[k], points)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        pairs, segments = joined_points(features, projected[k], rays, plane.focal_length)
        for pair, segment in zip(map(tuple, pairs.tolist()), segments, strict=True):
            segment_of.setdefault(pair, np.full(len(views_features), -1))[k] = segment
    kept = sorted(pair for pair, in_views in segment_of.items() if (in_views >= 0).sum() >= 2)
    edges = np.array(kept, dtype=int).reshape(-1, 2)
    columns = [segment_of[pair] for pair in kept]
    return edges, np.array(columns, dtype=int).reshape(-1, len(views_features)).T
