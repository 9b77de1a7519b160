"""Measure over what length along an edge the errors of its edge points are the same error.

Smoothing gives neighbouring points the same noise, over `SMOOTHED_LENGTH`. Real edges are rough
besides: what displaces a point, such as a worn corner, a grain of the surface or the blocks of a
compressed picture, displaces the points next to it too. A line has as many independent points as
its length contains such lengths.

Parabolas are fitted to the edge points along the segments of the picture, because lenses and round
parts bend edges. The correlation of their residuals at each distance is the mean over all segments,
and its sum over all distances the length (the integrated autocorrelation; Geyer, "Practical Markov
chain Monte Carlo", 1992, who sums up to the first distance without correlation). A parabola follows
the longest waves of the errors, so that a length of a tenth of the segments' comes out a third too
short.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from .edge_points import EdgePoints
from .gradient import SMOOTHING

SMOOTHED_LENGTH = float(2.0 * np.sqrt(np.pi)) * SMOOTHING
"""Length over which smoothing alone correlates the points of an edge, px.

White noise smoothed by s has the correlation exp(-d^2 / 4 s^2) at the distance d, and the integral
of it over all d is 2 sqrt(pi) s.
"""

MIN_LENGTH = 24.0
"""Length of the shortest segment that is measured, px: some lengths of smoothing."""

END_MARGIN = 4.0
"""Length at both ends of a segment that is left out, px: there blur rounds the corners."""

REACH = 1.5
"""Largest distance of an edge point from its segment, px."""

MAX_LAG = 32
"""Largest distance along an edge at which the correlation is computed, px."""

MAX_SEGMENTS = 64
"""Largest number of segments that are measured, the longest ones, to limit the time."""


def correlated_length(
    segments: Float[np.ndarray, "segments 2 2"], points: EdgePoints, lone: Bool[np.ndarray, "_"]
) -> float:
    """Return the length along an edge of which the points count as one observation, px.

    It is at least `SMOOTHED_LENGTH`.

    Args:
        segments: straight segments of the picture, px.
        points: its edge points.
        lone: which of them no other edge displaces.
    """
    lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    order = np.argsort(-lengths, kind="stable")[:MAX_SEGMENTS]
    usable = np.flatnonzero(lone)
    products, counts = np.zeros(MAX_LAG), np.zeros(MAX_LAG)
    tree = KDTree(points.pixels[usable]) if len(usable) else None
    for k in order[lengths[order] >= MIN_LENGTH]:
        if tree is None:
            break
        places, residuals = _residuals(segments[k], points.pixels[usable], tree)
        if len(residuals) < 2.0 * END_MARGIN:
            continue
        lags = np.rint(np.abs(places[:, None] - places)).astype(int)
        is_counted = lags < MAX_LAG
        # A segment with larger errors than the others counts no more than they do.
        scaled = np.outer(residuals, residuals) / max(float(np.mean(residuals**2)), 1e-12)
        products += np.bincount(lags[is_counted], scaled[is_counted], MAX_LAG)
        counts += np.bincount(lags[is_counted], minlength=MAX_LAG)
    if not counts[0]:
        return SMOOTHED_LENGTH
    correlations = products / np.maximum(counts, 1.0)
    end = int(np.argmax(np.append(correlations, 0.0) <= 0.0))
    return max(1.0 + 2.0 * float(correlations[1:end].sum()), SMOOTHED_LENGTH)


def _residuals(
    segment: Float[np.ndarray, "2 2"], pixels: Float[np.ndarray, "points 2"], tree: KDTree
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return the places along a segment of the edge points next to it, and their distances.

    The distances are from the parabola that fits these points best.
    """
    length = float(np.linalg.norm(segment[1] - segment[0]))
    along = (segment[1] - segment[0]) / length
    # A pixel apart, so that no point next to the segment is farther than that from all of them.
    middles = segment[0] + np.arange(END_MARGIN, length - END_MARGIN)[:, None] * along
    near = np.unique(np.concatenate([[], *tree.query_ball_point(middles, REACH)]).astype(int))
    offsets = pixels[near] - segment[0]
    places = offsets @ along
    inside = (places >= END_MARGIN) & (places <= length - END_MARGIN)
    distances = (offsets @ np.array([-along[1], along[0]]))[inside]
    places = places[inside]
    if len(places) < 4:
        return places, distances
    curve = np.polynomial.Polynomial.fit(places, distances, 2)
    return places, distances - curve(places)
