"""Find corners: where straight segments meet, and where the gradient alone says so.

A corner of segments is the point of least squared distances from their lines, in the ideal plane,
each weighted by the line's own covariance there. Other corners are those of the structure tensor
(Shi and Tomasi, "Good features to track", 1994), refined by OpenCV's cornerSubPix.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from .edge_points import gradient, noise_of
from .segments import Lines, is_between

MAX_END_GAP = 7.0
"""Largest distance of a segment's end from a corner that it belongs to, px."""

MIN_ANGLE = float(np.deg2rad(12.0))
"""Smallest angle between two segments that make a corner, rad."""

MAX_MERGED_DISTANCE = 2.0
"""Distance within which meeting points of pairs of segments are one corner, px."""

MAX_CORNER_SIGMA = 1.0
"""Largest standard deviation of a corner of segments in its worst direction, px."""

MAX_SEGMENTS_PER_CORNER = 6
"""Largest number of segments that are kept for one corner."""

GRADIENT_CORNER_DISTANCE = 4.0
"""Smallest distance between two corners of the gradient, px."""

GRADIENT_CORNER_QUALITY = 0.003
"""Smallest structure of a corner of the gradient, relative to the picture's best."""

MAX_GRADIENT_CORNERS = 3000
"""Largest number of corners of the gradient in a picture."""

REFINEMENT_RADIUS = 4
"""Half the width of the window in which a corner of the gradient is refined, px."""

MAX_REFINEMENT = 2.5
"""Largest distance by which refinement may move a corner, px; beyond it is another one's."""

GRADIENT_MODEL_SIGMA = 0.15
"""Standard deviation of a corner of the gradient beyond noise, px: blur rounds corners off."""


class LineCorners(NamedTuple):
    """Corners where segments meet, in the ideal plane.

    Attributes:
        points: ideal coordinates, px.
        covariances: px^2.
        segments: indices of the segments that meet, -1 where there are fewer.
    """

    points: Float[np.ndarray, "corners 2"]
    covariances: Float[np.ndarray, "corners 2 2"]
    segments: Int[np.ndarray, "corners joined"]


def line_corners(lines: Lines) -> LineCorners:
    """Return the corners where two or more segments end, or one ends on another."""
    first, second, meeting = _meeting_points(lines)
    groups = _groups(meeting)
    points, covariances, joined = [], [], []
    for group in groups:
        members = np.unique(np.concatenate([first[group], second[group]]))
        solved = _common_point(lines, members, meeting[group].mean(axis=0))
        if solved is None:
            continue
        points.append(solved[0])
        covariances.append(solved[1])
        row = np.full(MAX_SEGMENTS_PER_CORNER, -1)
        row[: len(members)] = members[:MAX_SEGMENTS_PER_CORNER]
        joined.append(row)
    return LineCorners(
        np.array(points).reshape(-1, 2),
        np.array(covariances).reshape(-1, 2, 2),
        np.array(joined, dtype=int).reshape(-1, MAX_SEGMENTS_PER_CORNER),
    )


def _meeting_points(lines: Lines) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pairs of segments that meet near an end of at least one, and where their lines do."""
    first, second = np.triu_indices(len(lines.centres), k=1)
    n, m = lines.normals[first], lines.normals[second]
    sine = n[:, 0] * m[:, 1] - n[:, 1] * m[:, 0]
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
    """Return whether one of the ends of a segment is near a point."""
    distance = np.linalg.norm(lines.ends[index] - points[:, None], axis=2)
    return distance.min(axis=1) < MAX_END_GAP


def _groups(points: Float[np.ndarray, "points 2"]) -> list[np.ndarray]:
    """Return the indices of points that are close together, each point in one group."""
    if not len(points):
        return []
    neighbours = cKDTree(points).query_ball_point(points, MAX_MERGED_DISTANCE)
    free, groups = np.ones(len(points), dtype=bool), []
    # The points with the most neighbours collect theirs first.
    for k in sorted(range(len(points)), key=lambda i: -len(neighbours[i])):
        group = [i for i in neighbours[k] if free[i]]
        if free[k]:
            groups.append(np.array(group))
            free[group] = False
    return groups


def _common_point(
    lines: Lines, members: Int[np.ndarray, "members"], start: Float[np.ndarray, "2"]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the point nearest to several lines and its covariance; None if poorly determined."""
    variances = lines.variances_at(members, np.tile(start, (len(members), 1)))
    normals = lines.normals[members]
    distances = (normals * lines.centres[members]).sum(axis=1)
    # Least squares: (sum n n^T / var) x = sum n d / var, whose matrix is the inverse covariance.
    information = (normals / variances[:, None]).T @ normals
    if np.linalg.eigvalsh(information)[0] < MAX_CORNER_SIGMA**-2:
        return None
    covariance = np.linalg.inv(information)
    point = covariance @ (normals / variances[:, None]).T @ distances
    # Lines that miss their common point by more than they should are not of one vertex: the
    # covariance grows by the excess, as that of a weighted mean does.
    misses = (normals @ point - distances) ** 2 / variances
    excess = misses.sum() / max(len(members) - 2, 1) if len(members) > 2 else 1.0
    return point, covariance * max(excess, 1.0)


def gradient_corners(
    grey: Float[np.ndarray, "rows columns"],
) -> tuple[Float[np.ndarray, "corners 2"], Float[np.ndarray, "corners 2 2"]]:
    """Return pixels and covariances (px^2) of the corners that the picture's gradient shows."""
    picture = grey.astype(np.float32)
    found = cv2.goodFeaturesToTrack(
        picture,
        MAX_GRADIENT_CORNERS,
        GRADIENT_CORNER_QUALITY,
        GRADIENT_CORNER_DISTANCE,
        blockSize=3,
    )
    if found is None:
        return np.zeros((0, 2)), np.zeros((0, 2, 2))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
    window = (REFINEMENT_RADIUS, REFINEMENT_RADIUS)
    refined = cv2.cornerSubPix(picture, found.copy(), window, (-1, -1), stop)
    moved = np.linalg.norm(refined - found, axis=-1).ravel()
    pixels = np.where(moved[:, None] <= MAX_REFINEMENT, refined[:, 0], found[:, 0]).astype(float)
    return pixels, _gradient_covariances(grey, pixels)


def _gradient_covariances(
    grey: Float[np.ndarray, "rows columns"], pixels: Float[np.ndarray, "corners 2"]
) -> Float[np.ndarray, "corners 2 2"]:
    """Return the covariances that noise alone gives corners, and a model error on top."""
    slopes = gradient(grey)
    size = (2 * REFINEMENT_RADIUS + 1,) * 2
    products = [slopes[..., i] * slopes[..., j] for i, j in ((0, 0), (0, 1), (1, 1))]
    sums = [cv2.boxFilter(product, -1, size, normalize=False) for product in products]
    column, row = np.rint(pixels).astype(int).T
    column, row = np.clip(column, 0, grey.shape[1] - 1), np.clip(row, 0, grey.shape[0] - 1)
    uu, uv, vv = (total[row, column] for total in sums)
    # Covariance sigma^2 (sum g g^T)^-1, regularised where a window shows one edge only.
    information = np.stack([np.stack([uu, uv], -1), np.stack([uv, vv], -1)], axis=-2)
    ridge = 1e-3 * (uu + vv) + 1e-9
    information = information + ridge[:, None, None] * np.eye(2)
    return noise_of(grey) ** 2 * np.linalg.inv(information) + GRADIENT_MODEL_SIGMA**2 * np.eye(2)
