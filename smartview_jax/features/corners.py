"""Find corners: where straight segments meet, and where the gradient alone shows one.

A corner of segments is the point with the least squared distances from their lines, in the ideal
plane, each weighted by the line's variance there. Other corners are peaks of the structure tensor's
determinant over its trace (Foerstner and Guelch, "A fast operator for detection and precise
location of distinct points, corners and centres of circular features", 1987), and the vertices near
them that OpenCV's cornerSubPix finds.
"""

from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from .gradient import SMOOTHING, Gradient
from .segments import Lines, is_between

MAX_END_GAP = 10.0
"""Largest distance of a segment's end from a corner that it belongs to, px."""

MIN_ANGLE = float(np.deg2rad(12.0))
"""Smallest angle between two segments that make a corner, rad."""

MAX_MERGED_DISTANCE = 1.2
"""Distance within which intersections of pairs of segments are the same corner, px."""

MAX_CORNER_SIGMA = 1.0
"""Largest standard deviation of a corner of segments in its worst direction, px."""

MAX_SEGMENTS_PER_CORNER = 6
"""Largest number of segments that are kept for one corner."""

INTEGRATION_SIGMA = 1.0
"""Standard deviation of the window over which the structure tensor is summed, px."""

STRUCTURE_GATE = 50.0
"""Smallest strength of a gradient corner, in variances of the gradient's noise."""

MIN_ROUNDNESS = 0.35
"""Smallest roundness 4 det / trace^2 of the structure tensor: 0 on an edge, 1 on a dot."""

MAX_GRADIENT_CORNERS = 6000
"""Largest number of gradient corners in a picture; the strongest are kept."""

REFINEMENT_RADIUS = 4
"""Half the width of the window in which a vertex is refined, px."""

CORRELATED_AREA = 4.0 * np.pi * SMOOTHING**2
"""Number of pixels that count as one observation of the gradient: smoothing correlates them."""

MAX_REFINEMENT = 2.5
"""Largest distance by which refinement may move a corner, px; beyond it another corner is found."""

CERTAIN_VERTEX_SIGMA = 0.3
"""Standard deviation of a vertex, px, below which it replaces the peaks next to it."""

MAX_VERTEX_SIGMA = 1.2
"""Largest standard deviation of a vertex, px; above it the edges do not meet in one point.

Blurred edges do not quite satisfy the equations of a vertex. Where several cross, the errors of
both sides cancel; where two end, 0.8 to 1 px remains, though the vertex is within 0.4 px on drawn
pictures. The peak of the structure is then 1.3 to 2.4 px inside, or farther with texture nearby.
"""

VERTEX_MODEL_SIGMA, PEAK_MODEL_SIGMA = 0.1, 0.3
"""Standard deviations of vertices and of peaks beyond the noise, px.

Blur rounds vertices off, and the peak of the structure depends on the pattern of the picture.
"""

MIN_PEAK_DISTANCE = 1.0
"""Distance from a corner, px, within which a less certain corner is dropped."""


class LineCorners(NamedTuple):
    """Corners where segments meet, in the ideal plane.

    Attributes:
        points: ideal coordinates, px.
        covariances: px^2.
        segments: indices of the segments that meet, padded with -1.
    """

    points: Float[np.ndarray, "corners 2"]
    covariances: Float[np.ndarray, "corners 2 2"]
    segments: Int[np.ndarray, "corners joined"]


def line_corners(lines: Lines) -> LineCorners:
    """Return the corners where two or more segments end, or one ends on another."""
    first, second, meeting = _meeting_points(lines)
    groups = _groups(meeting)
    # Which pairs meet in each corner, and which segments, each of them once.
    corner = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
    pair = np.concatenate([np.zeros(0, dtype=int), *groups])
    both = np.stack([np.tile(corner, 2), np.concatenate([first[pair], second[pair]])])
    corner_of, segment = np.unique(both, axis=1)
    starts = np.stack([np.bincount(corner, x, len(groups)) for x in meeting[pair].T], axis=1)
    starts = starts / np.maximum(np.bincount(corner, minlength=len(groups)), 1)[:, None]
    points, covariances, good = _common_points(lines, corner_of, segment, starts)
    # The same number of columns for every corner, so that corners form one array.
    joined = np.full((len(groups), MAX_SEGMENTS_PER_CORNER), -1)
    column = np.arange(len(segment)) - np.searchsorted(corner_of, corner_of)
    few = column < MAX_SEGMENTS_PER_CORNER
    joined[corner_of[few], column[few]] = segment[few]
    return LineCorners(points[good], covariances[good], joined[good])


def _meeting_points(lines: Lines) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pairs of segments that meet near an end of at least one, and their intersections."""
    first, second = np.triu_indices(len(lines.centres), k=1)
    n, m = lines.normals[first], lines.normals[second]
    sine = n[:, 0] * m[:, 1] - n[:, 1] * m[:, 0]
    # The intersection of nearly parallel lines is arbitrary.
    steep = np.abs(sine) > np.sin(MIN_ANGLE)
    first, second, n, m, sine = (x[steep] for x in (first, second, n, m, sine))
    # n . x = a and m . x = b: Cramer's rule.
    a, b = ((k * lines.centres[i]).sum(axis=1) for k, i in ((n, first), (m, second)))
    meeting = np.column_stack([a * m[:, 1] - b * n[:, 1], b * n[:, 0] - a * m[:, 0]])
    meeting = meeting / sine[:, None]
    near = is_between(lines, first, meeting, MAX_END_GAP)
    near &= is_between(lines, second, meeting, MAX_END_GAP)
    near &= _ends_near(lines, first, meeting) | _ends_near(lines, second, meeting)
    return first[near], second[near], meeting[near]


def _ends_near(lines: Lines, index: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return whether either end of a segment is near a point."""
    distance = np.linalg.norm(lines.ends[index] - points[:, None], axis=2)
    return distance.min(axis=1) < MAX_END_GAP


def _groups(points: Float[np.ndarray, "points 2"]) -> list[np.ndarray]:
    """Return the indices of points that are close together, each point in one group."""
    if not len(points):
        return []
    neighbours = KDTree(points).query_ball_point(points, MAX_MERGED_DISTANCE)
    free, groups = np.ones(len(points), dtype=bool), []
    # Points with the most neighbours form their groups first.
    for k in sorted(range(len(points)), key=lambda i: -len(neighbours[i])):
        group = [i for i in neighbours[k] if free[i]]
        if free[k]:
            groups.append(np.array(group))
            free[group] = False
    return groups


def _common_points(
    lines: Lines,
    corner: Int[np.ndarray, "members"],
    segment: Int[np.ndarray, "members"],
    starts: Float[np.ndarray, "corners 2"],
) -> tuple[
    Float[np.ndarray, "corners 2"], Float[np.ndarray, "corners 2 2"], Bool[np.ndarray, "corners"]
]:
    """Return the points nearest to several lines each, their covariances, and which are certain.

    A corner and a segment are the indices of a point and of a line through it.
    """
    variances, normals = lines.variances_at(segment, starts[corner]), lines.normals[segment]
    distances = (normals * lines.centres[segment]).sum(axis=1)

    def sums(values: Float[np.ndarray, "members"]) -> Float[np.ndarray, "corners"]:
        return np.bincount(corner, values, len(starts))

    # Least squares: (sum n n^T / var) x = sum n d / var, whose matrix is the inverse covariance.
    weighted = normals / variances[:, None]
    uu, uv, vv = (sums(weighted[:, i] * normals[:, j]) for i, j in ((0, 0), (0, 1), (1, 1)))
    information = np.stack([np.stack([uu, uv], axis=-1), np.stack([uv, vv], axis=-1)], axis=-1)
    good = np.linalg.eigvalsh(information)[:, 0] >= MAX_CORNER_SIGMA**-2
    covariances = np.linalg.inv(np.where(good[:, None, None], information, np.eye(2)))
    towards = np.stack([sums(part * distances) for part in weighted.T], axis=-1)
    points = (covariances @ towards[..., None])[..., 0]
    # Lines that miss their common point by more than their variance do not form one vertex: the
    # covariance grows by the excess, as for a weighted mean.
    misses = sums(((normals * points[corner]).sum(axis=1) - distances) ** 2 / variances)
    freedom = np.bincount(corner, minlength=len(starts)) - 2
    excess = np.where(freedom > 0, misses / np.maximum(freedom, 1), 1.0)
    return points, covariances * np.maximum(excess, 1.0)[:, None, None], good


def gradient_corners(
    grey: Float[np.ndarray, "rows columns"], gradient: Gradient
) -> tuple[Float[np.ndarray, "corners 2"], Float[np.ndarray, "corners 2 2"]]:
    """Return pixels and covariances (px^2) of the corners in the picture's gradient.

    Certain vertices come first, where the edges of a window meet in one point; then peaks of the
    structure tensor that are no vertices, such as dots and the grain of a texture; then uncertain
    vertices, mostly of two edges that end in a corner.
    """
    peaks = _structure_peaks(gradient)
    if not len(peaks):
        return np.zeros((0, 2)), np.zeros((0, 2, 2))
    vertices, covariances = _vertices(grey, gradient, peaks)
    sigmas = np.sqrt(np.linalg.eigvalsh(covariances)[:, 1])
    certain = _first_of_groups(vertices, sigmas < CERTAIN_VERTEX_SIGMA)
    is_uncertain = (sigmas >= CERTAIN_VERTEX_SIGMA) & (sigmas < MAX_VERTEX_SIGMA)
    # A certain vertex replaces the peaks next to it; an uncertain one is only added, because the
    # edges of dots and grain, too, seem to meet somewhere nearby.
    peaks = peaks[far_from(peaks, vertices[certain], MIN_PEAK_DISTANCE)]
    known = np.concatenate([vertices[certain], peaks])
    uncertain = _first_of_groups(vertices, is_uncertain)
    uncertain = uncertain[far_from(vertices[uncertain], known, MIN_PEAK_DISTANCE)]
    covariances = covariances + VERTEX_MODEL_SIGMA**2 * np.eye(2)
    peak_covariances = np.tile(PEAK_MODEL_SIGMA**2 * np.eye(2), (len(peaks), 1, 1))
    return (
        np.concatenate([known, vertices[uncertain]]),
        np.concatenate([covariances[certain], peak_covariances, covariances[uncertain]]),
    )


def _first_of_groups(
    points: Float[np.ndarray, "points 2"], selected: Bool[np.ndarray, "points"]
) -> Int[np.ndarray, "first"]:
    """Return the first selected point of each place; several may be found at one place."""
    index = np.flatnonzero(selected)
    return index[np.array([group.min() for group in _groups(points[index])], dtype=int)]


def far_from(
    points: Float[np.ndarray, "points 2"], others: Float[np.ndarray, "others 2"], distance: float
) -> Bool[np.ndarray, "points"]:
    """Return which points are farther from all others than a distance, px."""
    if not len(others):
        return np.ones(len(points), dtype=bool)
    return np.asarray(KDTree(others).query(points)[0]) > distance


def _structure_peaks(gradient: Gradient) -> Float[np.ndarray, "peaks 2"]:
    """Return the sub-pixel peaks of det / trace of the structure tensor, the strongest first."""
    tensor = [
        cv2.GaussianBlur(first * second, (0, 0), INTEGRATION_SIGMA)
        for first, second in combinations_with_replacement((gradient.by_u, gradient.by_v), 2)
    ]
    trace = tensor[0] + tensor[2]
    # The strength is a quarter of the trace at most: few pixels can exceed the gate.
    gate, strength = STRUCTURE_GATE * gradient.sigma**2, np.zeros(trace.shape)
    row, column = np.nonzero(trace > 4.0 * gate)
    strength[row, column] = _strengths(tensor, row, column)
    strong = strength[row, column] > gate
    row, column = row[strong], column[strong]
    largest = np.asarray(cv2.dilate(strength, np.ones((3, 3))))
    is_peak = strength[row, column] == largest[row, column]
    rows, columns = trace.shape
    is_peak &= (row > 0) & (row < rows - 1) & (column > 0) & (column < columns - 1)
    row, column = row[is_peak], column[is_peak]
    # 4 det / trace^2
    is_round = 4.0 * strength[row, column] > MIN_ROUNDNESS * trace[row, column]
    row, column = row[is_round], column[is_round]
    # A textured picture has tens of thousands of peaks; the strongest are found in other views too.
    order = np.argsort(-strength[row, column])[:MAX_GRADIENT_CORNERS]
    row, column = row[order], column[order]
    shifts = [
        _parabola_peak(
            *(_strengths(tensor, row + k * down, column + k * across) for k in (-1, 0, 1))
        )
        for across, down in ((1, 0), (0, 1))
    ]
    return np.column_stack([column, row]) + np.column_stack(shifts)


def _strengths(
    tensor: Sequence[Float[np.ndarray, "rows columns"]],
    row: Int[np.ndarray, "pixels"],
    column: Int[np.ndarray, "pixels"],
) -> Float[np.ndarray, "pixels"]:
    """Return det / trace of the structure tensor of pixels, given its entries uu, uv and vv."""
    uu, uv, vv = (part[row, column] for part in tensor)
    return (uu * vv - uv * uv) / np.maximum(uu + vv, 1e-12)


def _parabola_peak(before: np.ndarray, middle: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the peak of a parabola through three neighbouring values, -0.5 to 0.5."""
    curvature = before - 2.0 * middle + after
    shift = 0.5 * (before - after) / np.where(curvature < 0.0, curvature, -np.inf)
    return np.clip(shift, -0.5, 0.5)


def _vertices(
    grey: Float[np.ndarray, "rows columns"],
    gradient: Gradient,
    peaks: Float[np.ndarray, "peaks 2"],
) -> tuple[Float[np.ndarray, "vertices 2"], Float[np.ndarray, "vertices 2 2"]]:
    """Return the points near peaks in which the surrounding edges meet, with covariances.

    They are in the order of the peaks; several peaks may lead to one vertex.
    """
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
    window = (REFINEMENT_RADIUS, REFINEMENT_RADIUS)
    start = peaks[:, None].astype(np.float32)
    refined = cv2.cornerSubPix(grey.astype(np.float32), start, window, (-1, -1), stop)
    refined = refined[:, 0].astype(float)
    # A vertex far from its peak belongs to another peak.
    near = np.linalg.norm(refined - peaks, axis=1) <= MAX_REFINEMENT
    return refined[near], _meeting_covariances(gradient, refined[near])


def _meeting_covariances(
    gradient: Gradient, vertices: Float[np.ndarray, "vertices 2"]
) -> Float[np.ndarray, "vertices 2 2"]:
    """Return the covariance of the point in which the edges of a window meet.

    The gradient g at x of an edge through the vertex q has g . (q - x) = 0. Least squares over the
    window has the covariance s^2 (sum w g g^T)^-1, with s^2 from the residuals of these equations.
    """
    reach = np.arange(-REFINEMENT_RADIUS, REFINEMENT_RADIUS + 1)
    offsets = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    cells = np.rint(vertices).astype(int)[:, None] + offsets
    column, row = np.moveaxis(cells, -1, 0)
    rows, columns = gradient.magnitude.shape
    g = gradient.at(np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1))
    # The weights of cornerSubPix.
    weights = np.exp(-((offsets / REFINEMENT_RADIUS) ** 2).sum(axis=1))
    residuals = np.einsum("nwk,nwk->nw", g, vertices[:, None] - cells)
    variance = (weights * residuals**2).sum(axis=1) / (weights.sum() - 2.0)
    information = np.einsum("w,nwi,nwj->nij", weights, g, g)
    # A window that shows only one edge determines nothing along it.
    ridge = 1e-6 * np.trace(information, axis1=1, axis2=2) + 1e-12
    inverse = np.linalg.inv(information + ridge[:, None, None] * np.eye(2))
    return (CORRELATED_AREA * variance)[:, None, None] * inverse
