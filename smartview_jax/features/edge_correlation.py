"""Measure over what length along an edge the errors of its edge points are the same error.

Smoothing gives neighbouring points the same noise, over `SMOOTHED_LENGTH`. Real edges are rough,
too: a worn corner, a grain of the surface or the blocks of a compressed picture displace
neighbouring points together. A line has as many independent points as its length contains such
lengths.

Parabolas are fitted to the edge points along the segments of the picture, because lenses and round
parts bend edges. The correlation of their residuals at each distance is the mean over all segments,
and its sum over all distances the length: the integrated autocorrelation, summed as long as it is
positive (as by Geyer, "Practical Markov chain Monte Carlo", 1992, who adds two distances at a
time). A parabola follows the longest waves of the errors, so that a length of a tenth of the
segments' comes out a third too short.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from .edge_points import EdgePoints
from .gradient import SMOOTHED_LENGTH

MIN_LENGTH = 24.0
"""Length of the shortest segment that is measured, px: some lengths of smoothing."""

END_MARGIN = 4.0
"""Length at both ends of a segment that is left out, px: there blur rounds the corners."""

REACH = 1.5
"""Largest distance of an edge point from its segment, px."""

MIN_POINTS = 8
"""Smallest number of edge points along a segment, several for each number of a parabola."""

MAX_LAG = 32
"""Largest distance along an edge at which the correlation is computed, px."""

MAX_SEGMENTS = 64
"""Largest number of segments that are measured, the longest ones, to limit the time."""


def correlated_length(
    segments: Float[np.ndarray, "segments 2 2"], points: EdgePoints, lone: Bool[np.ndarray, "_"]
) -> float:
    """Return the length of an edge whose points count as one observation, px.

    It is at least `SMOOTHED_LENGTH`.

    Args:
        segments: straight segments of the picture, px.
        points: its edge points.
        lone: which of them no other edge displaces.
    """
    pixels = points.pixels[lone]
    if not len(pixels):
        return SMOOTHED_LENGTH
    lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    order = np.argsort(-lengths, kind="stable")[:MAX_SEGMENTS]
    products, counts, tree = np.zeros(MAX_LAG), np.zeros(MAX_LAG), KDTree(pixels)
    for k in order[lengths[order] >= MIN_LENGTH]:
        places, distances = _along(segments[k], pixels, tree)
        if len(places) < MIN_POINTS:
            continue
        residuals = distances - np.polynomial.Polynomial.fit(places, distances, 2)(places)
        first, second = _near_pairs(places)
        lags = np.rint(places[second] - places[first]).astype(int)
        # A segment with larger errors than the others counts no more than they do.
        scaled = residuals[first] * residuals[second] / max(float(np.mean(residuals**2)), 1e-12)
        products += np.bincount(lags, scaled, MAX_LAG)[:MAX_LAG]
        counts += np.bincount(lags, minlength=MAX_LAG)[:MAX_LAG]
    if not counts[0]:
        return SMOOTHED_LENGTH
    correlations = products / np.maximum(counts, 1.0)
    end = int(np.argmax(np.append(correlations, 0.0) <= 0.0))
    return max(1.0 + 2.0 * float(correlations[1:end].sum()), SMOOTHED_LENGTH)


def _along(
    segment: Float[np.ndarray, "2 2"], pixels: Float[np.ndarray, "points 2"], tree: KDTree
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return the places along a segment of the edge points next to it, and their distances, px.

    The places are in ascending order; distances to one side are negative.
    """
    length = float(np.linalg.norm(segment[1] - segment[0]))
    along = (segment[1] - segment[0]) / length
    # A pixel apart, less than `REACH`: the circles about them cover the segment.
    middles = segment[0] + np.arange(END_MARGIN, length - END_MARGIN)[:, None] * along
    near = np.unique(np.concatenate([[], *tree.query_ball_point(middles, REACH)]).astype(int))
    offsets = pixels[near] - segment[0]
    places, distances = offsets @ along, offsets @ np.array([-along[1], along[0]])
    order = np.argsort(places)
    order = order[(places[order] >= END_MARGIN) & (places[order] <= length - END_MARGIN)]
    return places[order], distances[order]


def _near_pairs(
    places: Float[np.ndarray, "n"],
) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
    """Return the indices of ascending places less than `MAX_LAG` apart, each with itself too."""
    starts = np.arange(len(places))
    counts = np.searchsorted(places, places + MAX_LAG) - starts
    first = np.repeat(starts, counts)
    # The pairs of each place begin with itself.
    steps = np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts)
    return first, first + steps
