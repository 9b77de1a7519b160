"""Find which corners of several views are the same point in space.

Every two views propose pairs that satisfy the epipolar constraint and look alike. The point of each
pair is searched in all other views. Points found in most views are accepted first, and no corner
belongs to two points.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

EPIPOLAR_GATE = 2.0
"""Largest distance of a corner from the epipolar line of another, px."""

REPROJECTION_GATE = 2.0
"""Largest distance of a corner from the projection of a pair's point, px."""

MIN_PAIR_SIMILARITY, MIN_VIEW_SIMILARITY = 0.6, 0.5
"""Smallest correlation of patches of a pair, and with a pair's patches in a further view."""

CANDIDATES_PER_CORNER = 4
"""Largest number of corners in another view with which a corner is paired."""

MIN_PARALLAX = float(np.deg2rad(1.0))
"""Smallest angle between the rays of a pair, rad; below it the depth is not known."""

DIRECTION_SIGMA = float(np.deg2rad(20.0))
"""Standard deviation of the angle between segments of the same corner in two views, rad."""

MAX_DIRECTION_COST = 6.0
"""Largest cost of differing directions: some segments are found in only one of two views."""


class CornerView(NamedTuple):
    """The corners of one view, as used in the search.

    Attributes:
        pixels: px.
        rays: unit rays in the world.
        centre: the camera's centre in the world, m.
        patches: see `features.Appearance`.
        directions: see `features.Appearance`.
        is_junction: whether two or more segments meet in each corner.
        focal_length: px.
    """

    pixels: Float[np.ndarray, "corners 2"]
    rays: Float[np.ndarray, "corners 3"]
    centre: Float[np.ndarray, "3"]
    patches: Float[np.ndarray, "corners samples"]
    directions: Float[np.ndarray, "corners joined"]
    is_junction: Bool[np.ndarray, "corners"]
    focal_length: float


class Pairs(NamedTuple):
    """Pairs of corners of two views that may be one point.

    Attributes:
        views: indices of the two views.
        corners: indices of the corners.
        points: nearest to both rays, m.
        similarity: correlation of the patches.
    """

    views: Int[np.ndarray, "pairs 2"]
    corners: Int[np.ndarray, "pairs 2"]
    points: Float[np.ndarray, "pairs 3"]
    similarity: Float[np.ndarray, "pairs"]


class Tracks(NamedTuple):
    """Corners that are one point in space, the best supported first.

    Attributes:
        corners: index of the corner in each view, -1 where it was not found.
        similarity: mean correlation of the patches with each other.
    """

    corners: Int[np.ndarray, "views tracks"]
    similarity: Float[np.ndarray, "tracks"]


def epipolar_pairs(
    views: list[CornerView], first: int, second: int, depths: tuple[float, float]
) -> Pairs:
    """Return pairs of corners of two views, at depths (m), among the best of each other."""
    a, b = views[first], views[second]
    i, j, similarity = _alike_on_epipolar_lines(a, b)
    points, in_range = _intersections(a, b, i, j, depths)
    i, j, similarity, points = (x[in_range] for x in (i, j, similarity, points))
    turn = direction_turn(a.directions[i], b.directions[j])
    rank = similarity - 0.05 * turn_cost(turn)
    keep = _among_best(i, rank) & _among_best(j, rank)
    pair_views = np.tile([first, second], (int(keep.sum()), 1))
    return Pairs(pair_views, np.column_stack([i, j])[keep], points[keep], similarity[keep])


def _alike_on_epipolar_lines(
    a: CornerView, b: CornerView
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return indices of corners on each other's epipolar lines with similar patches."""
    # The plane through both centres and the ray of a corner has the normal t x d; the sine of the
    # angle of another ray to that plane is its distance from the line, in units of 1 / f.
    normals = np.cross(b.centre - a.centre, a.rays)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(lengths > 0.0, lengths, 1.0)
    near = np.abs(normals @ b.rays.T) < EPIPOLAR_GATE / b.focal_length
    # Single precision is enough for correlations, which take most of the time.
    similarity = a.patches.astype(np.float32) @ b.patches.T.astype(np.float32)
    i, j = np.nonzero(near & (similarity > MIN_PAIR_SIMILARITY))
    return i, j, similarity[i, j].astype(float)


def _intersections(
    a: CornerView,
    b: CornerView,
    i: Int[np.ndarray, "pairs"],
    j: Int[np.ndarray, "pairs"],
    depths: tuple[float, float],
) -> tuple[Float[np.ndarray, "pairs 3"], Bool[np.ndarray, "pairs"]]:
    """Return the points nearest to pairs of rays, and whether they are in the range of depths."""
    # The feet a + s d and b + t e of the common perpendicular: with w = b - a and c = d . e,
    #     s = (w . d - c w . e) / (1 - c^2),   t = (c w . d - w . e) / (1 - c^2).
    d, e, w = a.rays[i], b.rays[j], b.centre - a.centre
    c, wd, we = (d * e).sum(axis=1), d @ w, e @ w
    squared_sine = np.maximum(1.0 - c**2, 1e-30)
    s, t = (wd - c * we) / squared_sine, (c * wd - we) / squared_sine
    points = 0.5 * (a.centre + s[:, None] * d + b.centre + t[:, None] * e)
    in_range = squared_sine > np.sin(MIN_PARALLAX) ** 2
    for depth in (s, t):
        in_range &= (depth > depths[0]) & (depth < depths[1])
    return points, in_range


def _among_best(
    corner: Int[np.ndarray, "pairs"], rank: Float[np.ndarray, "pairs"]
) -> Bool[np.ndarray, "pairs"]:
    """Return whether each pair is among the best of its corner."""
    order = np.lexsort((-rank, corner))
    ordered = corner[order]
    # The rank of each pair within its corner.
    first = np.searchsorted(ordered, ordered)
    best = np.zeros(len(corner), dtype=bool)
    best[order] = np.arange(len(corner)) - first < CANDIDATES_PER_CORNER
    return best


def supported_tracks(
    views: list[CornerView],
    pairs: Pairs,
    projected: Float[np.ndarray, "views pairs 2"],
    min_views: int,
) -> Tracks:
    """Return the tracks of pairs whose point is seen in other views too, each corner used once.

    The pairs' points are projected to all views, px; NaN where they are not visible.
    """
    corners, similarity, distance = _supporters(views, pairs, projected)
    count = (corners >= 0).sum(axis=0)
    mean_similarity = np.nansum(similarity, axis=0) / np.maximum(count, 1)
    spread = np.sqrt(np.nansum(distance**2, axis=0) / np.maximum(count, 1))
    junctions = sum(
        flags_of(row, view.is_junction) for row, view in zip(corners, views, strict=True)
    )
    # More views first, then more junctions, then higher similarity and smaller distance.
    score = count + 0.2 * junctions + mean_similarity - 0.5 * spread / REPROJECTION_GATE
    order = np.argsort(-np.where(count >= min_views, score, -np.inf), kind="stable")
    order = order[count[order] >= min_views]
    chosen = _one_to_one(corners[:, order], [len(view.pixels) for view in views])
    order = order[chosen]
    return Tracks(corners[:, order], mean_similarity[order])


def flags_of(
    corners: Int[np.ndarray, "tracks"], flags: Bool[np.ndarray, "corners"]
) -> Bool[np.ndarray, "tracks"]:
    """Return the flag of each track's corner in a view; False for tracks without a corner there."""
    has_flag = corners >= 0
    # Not `flags[corners]` directly: a view without corners has no element -1.
    has_flag[has_flag] = flags[corners[has_flag]]
    return has_flag


def _supporters(
    views: list[CornerView], pairs: Pairs, projected: Float[np.ndarray, "views pairs 2"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the corner in every view that is nearest to each pair's point and looks alike.

    Its index is -1 where there is none, and then correlation and distance (px) are NaN.
    """
    shape = projected.shape[:2]
    corners = np.full(shape, -1)
    similarity, distance = np.full(shape, np.nan), np.full(shape, np.nan)
    patches = [_patches_of(views, pairs, side) for side in (0, 1)]
    for k, view in enumerate(views):
        visible = np.flatnonzero(np.isfinite(projected[k]).all(axis=1))
        if not len(visible) or not len(view.pixels):
            continue
        gap, nearest = map(np.asarray, KDTree(view.pixels).query(projected[k, visible]))
        alike = np.minimum(
            *((view.patches[nearest] * patch[visible]).sum(axis=1) for patch in patches)
        )
        good = (gap < REPROJECTION_GATE) & (alike > MIN_VIEW_SIMILARITY)
        corners[k, visible[good]] = nearest[good]
        similarity[k, visible[good]], distance[k, visible[good]] = alike[good], gap[good]
    for side in (0, 1):
        # The pair's own corners, which may not be the nearest ones.
        of_pair = pairs.views[:, side], np.arange(shape[1])
        corners[of_pair], similarity[of_pair] = pairs.corners[:, side], pairs.similarity
        pixels = np.array(
            [views[v].pixels[c] for v, c in zip(of_pair[0], pairs.corners[:, side], strict=True)]
        ).reshape(-1, 2)
        distance[of_pair] = np.linalg.norm(projected[of_pair] - pixels, axis=1)
    return corners, similarity, distance


def _patches_of(views: list[CornerView], pairs: Pairs, side: int) -> np.ndarray:
    patches = np.empty((len(pairs.views), views[0].patches.shape[1]))
    for k, view in enumerate(views):
        in_view = pairs.views[:, side] == k
        patches[in_view] = view.patches[pairs.corners[in_view, side]]
    return patches


def _one_to_one(
    corners: Int[np.ndarray, "views tracks"], counts: list[int]
) -> Int[np.ndarray, "chosen"]:
    """Return the tracks that share no corner with an earlier one."""
    used = [np.zeros(count, dtype=bool) for count in counts]
    chosen = []
    for k, track in enumerate(corners.T):
        members = [(view, corner) for view, corner in enumerate(track) if corner >= 0]
        if not any(used[view][corner] for view, corner in members):
            chosen.append(k)
            for view, corner in members:
                used[view][corner] = True
    return np.array(chosen, dtype=int)


def turn_cost(turn: Float[np.ndarray, "*corners"]) -> Float[np.ndarray, "*corners"]:
    """Return the cost of an angle between segments; an unknown angle costs as much as one sigma."""
    cost = np.minimum((turn / DIRECTION_SIGMA) ** 2, MAX_DIRECTION_COST)
    return np.where(np.isfinite(turn), cost, 1.0)


def direction_turn(
    first: Float[np.ndarray, "*corners joined"], second: Float[np.ndarray, "*corners joined"]
) -> Float[np.ndarray, "*corners"]:
    """Return the mean angle between the segments of corners and the nearest ones of others, rad.

    Args:
        first, second: angles of the segments at each corner, rad, in the same frame, padded with
            NaN. Their shapes broadcast.

    Returns:
        The mean over the corner with fewer segments; NaN where either has none.
    """
    gap = first[..., :, None] - second[..., None, :]
    # Angles differ by at most pi; a missing one is infinitely far from all others.
    gap = np.abs((gap + np.pi) % (2.0 * np.pi) - np.pi)
    gap = np.where(np.isfinite(gap), gap, np.inf)
    means = [_finite_mean(gap.min(axis=axis)) for axis in (-1, -2)]
    # Each segment of the corner with fewer segments should be found at the other corner.
    fewer = np.isfinite(first).sum(axis=-1) <= np.isfinite(second).sum(axis=-1)
    return np.where(fewer, means[0], means[1])


def _finite_mean(values: np.ndarray) -> np.ndarray:
    """Return the mean of the finite values along the last axis; NaN where there is none."""
    finite = np.isfinite(values)
    total, count = np.where(finite, values, 0.0).sum(axis=-1), finite.sum(axis=-1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
