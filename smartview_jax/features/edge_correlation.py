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
from .groups import grouped_indices

MIN_LENGTH = 24.0
"""Length of the shortest segment that is measured, px: some lengths of smoothing."""

END_MARGIN = 4.0
"""Length at both ends of a segment that is left out, px: there blur rounds the corners."""

REACH = 1.5
"""Largest distance of an edge point from its segment, px."""

MIDDLES_APART = 4.0
"""Distance of the places on a segment about which edge points are looked up, px."""

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
        lone: which of them no other edge displaces.
    """
    lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    order = np.argsort(-lengths, kind="stable")[:MAX_SEGMENTS]
    longest = segments[order[lengths[order] >= MIN_LENGTH]]
    line, places, distances = _along(longest, points.pixels[lone])
    residuals = distances - _parabolas(line, places, distances)
    # A segment with larger errors than the others counts no more than they do.
    squares = np.bincount(line, residuals**2) / np.maximum(np.bincount(line), 1)
    scaled = residuals / np.sqrt(np.maximum(squares, 1e-12))[line]
    first, second = _near_pairs(line, places)
    if not len(first):
        return SMOOTHED_LENGTH
    lags = np.rint(places[second] - places[first]).astype(int)
    products = np.bincount(lags, scaled[first] * scaled[second], MAX_LAG)[:MAX_LAG]
    correlations = products / np.maximum(np.bincount(lags, minlength=MAX_LAG)[:MAX_LAG], 1)
    end = int(np.argmax(np.append(correlations, 0.0) <= 0.0))
    return max(1.0 + 2.0 * float(correlations[1:end].sum()), SMOOTHED_LENGTH)


def _along(
    segments: Float[np.ndarray, "segments 2 2"], pixels: Float[np.ndarray, "points 2"]
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return the segment that each nearby edge point is on, its place along it and its distance.

    Places and distances are px. Segments ascend, and so do the places on each; distances to one
    side are negative. Segments with few points are left out.
    """
    lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    along = (segments[:, 1] - segments[:, 0]) / lengths[:, None]
    # Circles about middles `MIDDLES_APART` px apart cover what is within `REACH` of a segment.
    counts = np.ceil(lengths / MIDDLES_APART).astype(int) + 1
    owner, steps = grouped_indices(counts)
    middles = segments[owner, 0] + MIDDLES_APART * steps[:, None] * along[owner]
    pairs = KDTree(middles).sparse_distance_matrix(
        KDTree(pixels), float(np.hypot(0.5 * MIDDLES_APART, REACH)), output_type="ndarray"
    )
    line, point = np.unique(np.stack([owner[pairs["i"]], pairs["j"]]), axis=1)
    offsets = pixels[point] - segments[line, 0]
    places, distances = (
        (offsets * directions[line]).sum(axis=1)
        for directions in (along, np.stack([-along[:, 1], along[:, 0]], axis=1))
    )
    kept = (places >= END_MARGIN) & (places <= lengths[line] - END_MARGIN)
    kept &= np.abs(distances) <= REACH
    kept &= np.bincount(line, kept, len(segments))[line] >= MIN_POINTS
    order = np.lexsort((places[kept], line[kept]))
    return line[kept][order], places[kept][order], distances[kept][order]


def _parabolas(
    line: Int[np.ndarray, "n"], places: Float[np.ndarray, "n"], distances: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Return the distances by the parabola that fits each segment's points best, px."""
    count = int(line.max(initial=-1)) + 1
    sizes = np.maximum(np.bincount(line, minlength=count), 1)
    middles = np.bincount(line, places, count) / sizes
    spreads = np.sqrt(np.bincount(line, (places - middles[line]) ** 2, count) / sizes)
    powers = ((places - middles[line]) / np.maximum(spreads, 1e-12)[line]) ** np.arange(3)[:, None]

    def sums(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "segments"]:
        return np.bincount(line, values, count)

    matrix = np.stack([np.stack([sums(p * q) for q in powers], -1) for p in powers], -1)
    vector = np.stack([sums(p * distances) for p in powers], -1)
    coefficients = (np.linalg.pinv(matrix, hermitian=True) @ vector[..., None])[..., 0]
    return (coefficients[line] * powers.T).sum(axis=1)


def _near_pairs(
    line: Int[np.ndarray, "n"], places: Float[np.ndarray, "n"]
) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
    """Return the indices of points of one segment less than `MAX_LAG` apart, each with itself too.

    The segments ascend, and the places of each.
    """
    # One after the other, the segments are farther apart than any two places of a pair.
    starts, apart = np.arange(len(places)), places.max(initial=0.0) + 2.0 * MAX_LAG
    counts = np.searchsorted(places + apart * line, places + apart * line + MAX_LAG) - starts
    # The pairs of each place begin with itself.
    first, steps = grouped_indices(counts)
    return first, first + steps
