"""Rank the features of a view that may correspond to a pixel of another view.

A feature is judged by its distance from the epipolar curve, by the similarity of its appearance, by
the directions of the segments that meet there, and, where a depth is expected, by its position on
the curve. The four add up to a cost like a chi-square: each is squared over its variance.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .epipolar import EpipolarCurve

MAX_DISTANCE = 4.0
"""Largest distance of a candidate from the curve, px, unless stated."""

CURVE_SIGMA = 0.7
"""Standard deviation of the curve's position, px, from the clicked pixel and the poses."""

DISSIMILARITY_SIGMA = 0.3
"""Standard deviation of one minus the correlation of patches of the same corner."""

DIRECTION_SIGMA = float(np.deg2rad(20.0))
"""Standard deviation of the angle between segments of the same corner in two views, rad."""

MAX_DIRECTION_COST = 6.0
"""Largest cost of differing directions: some segments are found in only one of two views."""


class Candidates(NamedTuple):
    """Features near an epipolar curve, the most probable first.

    Attributes:
        indices: of the features.
        distance: from the curve, px.
        depth: along the ray of the pixel, at the nearest point of the curve, m.
        cost: the sum of squares over variances; smaller is more probable.
    """

    indices: Int[np.ndarray, "candidates"]
    distance: Float[np.ndarray, "candidates"]
    depth: Float[np.ndarray, "candidates"]
    cost: Float[np.ndarray, "candidates"]


def rank_candidates(
    curve: EpipolarCurve,
    corners: Float[np.ndarray, "corners 2"],
    covariances: Float[np.ndarray, "corners 2 2"] | None = None,
    *,
    similarity: Float[np.ndarray, "corners"] | None = None,
    turn: Float[np.ndarray, "corners"] | None = None,
    expected_depth: tuple[float, float] | None = None,
    max_distance: float = MAX_DISTANCE,
) -> Candidates:
    """Return the corners near a curve, ranked by all available cues.

    Args:
        curve: from `epipolar_curve`.
        corners: of the view in which the curve lies, px.
        covariances: of the corners, px^2.
        similarity: correlation of each corner's patch with the pixel's patch, -1 to 1.
        turn: angle between the segments at each corner and at the pixel, rad (`direction_turn`);
            NaN where unknown.
        expected_depth: depth and its standard deviation, m, such as the depth of a neighbour in the
            model.
        max_distance: largest distance of a candidate from the curve, px.
    """
    distance, depth = curve.nearest(corners)
    # Only the distance decides which corners are candidates; the other cues may mislead, and only
    # rank.
    index = np.flatnonzero(distance <= max_distance)
    # The mean variance of both axes; the curve's direction there hardly changes the ranking.
    variance = np.full(len(corners), CURVE_SIGMA**2)
    if covariances is not None:
        variance = variance + 0.5 * np.trace(covariances, axis1=1, axis2=2)
    # cost = d^2 / var + (1 - correlation)^2 / var + angle^2 / var + (depth - expected)^2 / var
    cost = distance[index] ** 2 / variance[index]
    if similarity is not None:
        cost = cost + ((1.0 - similarity[index]) / DISSIMILARITY_SIGMA) ** 2
    if turn is not None:
        cost = cost + turn_cost(turn[index])
    if expected_depth is not None:
        cost = cost + ((depth[index] - expected_depth[0]) / expected_depth[1]) ** 2
    order = np.argsort(cost, kind="stable")
    index = index[order]
    return Candidates(index, distance[index], depth[index], cost[order])


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
