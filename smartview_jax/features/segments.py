"""Fit straight segments to undistorted edge points.

OpenCV's line segment detector (von Gioi et al., "LSD: a line segment detector", 2012) proposes
pieces in the picture, where the lens bends edges. Each piece is then fitted and extended on
sub-pixel edge points in the ideal plane, where edges are straight, so that pieces of one edge
become one segment.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from .edge_points import EdgePoints
from .gradient import SMOOTHED_LENGTH
from .ideal_plane import IdealPlane
from .line_fits import (
    LineFits,
    Members,
    PointGrid,
    along_lines,
    directions_of,
    fit_lines,
    middles,
    ranges,
    total_least_squares,
)

GREY_LEVEL_BOUND = 1.0
"""Gradient error assumed by OpenCV's detector, grey levels; its default, 2, misses weak edges."""

MAX_PROPOSALS = 6000
"""Largest number of proposals that are fitted; in pictures full of texture the longest are kept."""

MIN_LENGTH = 8.0
"""Length of the shortest segment, px."""

MIN_DENSITY = 0.6
"""Smallest number of edge points per px of length; a straight edge has 0.7 to 1."""

MAX_RMS = 0.5
"""Largest RMS distance of points from their line, px; more is a curve or texture."""

MAX_USED_FRACTION = 0.5
"""Fraction of a proposal's points in earlier segments above which it adds nothing."""

MIN_POINT_SIGMA = 0.03
"""Smallest standard deviation of an edge point, px; a smaller estimate is not believed."""

MODEL_SIGMA = 0.01
"""Standard deviation of a whole line's position, px, no matter how many points it has."""


class Lines(NamedTuple):
    """Fitted straight segments in the ideal plane (px).

    Attributes:
        centres: the means of the fitted points.
        normals: unit normals in the plane, from dark to light.
        ends: first and last end in the direction of `directions`.
        offset_variances: variances of the distance of the centre from the true line, px^2.
        angle_variances: variances of the direction, rad^2.
        rms: distances of the points from their line, px.
        counts: numbers of points.
    """

    centres: Float[np.ndarray, "lines 2"]
    normals: Float[np.ndarray, "lines 2"]
    ends: Float[np.ndarray, "lines 2 2"]
    offset_variances: Float[np.ndarray, "lines"]
    angle_variances: Float[np.ndarray, "lines"]
    rms: Float[np.ndarray, "lines"]
    counts: Int[np.ndarray, "lines"]

    @property
    def directions(self) -> Float[np.ndarray, "lines 2"]:
        """The unit directions, a quarter turn from the normals."""
        return directions_of(self.normals)

    def variances_at(
        self, index: Int[np.ndarray, "points"], points: Float[np.ndarray, "points 2"]
    ) -> Float[np.ndarray, "points"]:
        """Return the variances across lines at points on them, px^2."""
        # var(s) = var_offset + s^2 var_angle, with s the distance from the centre along the line.
        along = ((points - self.centres[index]) * self.directions[index]).sum(axis=1)
        return self.offset_variances[index] + along**2 * self.angle_variances[index]


def find_lines(
    grey: Float[np.ndarray, "rows columns"], edge_points: EdgePoints, plane: IdealPlane
) -> Lines:
    """Return the straight segments of a picture, the longest proposals first."""
    points, normals = plane.with_normals(edge_points.pixels, edge_points.normals)
    # Points that have no place in the ideal plane are left out.
    usable = np.isfinite(points).all(axis=1) & np.isfinite(normals).all(axis=1)
    grid = PointGrid(points[usable], normals[usable])
    fits = fit_lines(grid, _proposals(grey, plane)[:MAX_PROPOSALS])
    lines, is_line = _lines(grid, fits)
    chosen = _without_repetitions(fits.members, is_line, len(grid.points))
    return Lines(*(part[chosen] for part in lines))


def _proposals(
    grey: Float[np.ndarray, "rows columns"], plane: IdealPlane
) -> Float[np.ndarray, "proposals 2 2"]:
    """Return the ends of OpenCV's line segments in the ideal plane, the longest first."""
    detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, quant=GREY_LEVEL_BOUND)
    detected = detector.detect(grey.astype(np.uint8))[0]
    if detected is None:
        return np.zeros((0, 2, 2))
    ends = plane.from_pixels(detected.reshape(-1, 2).astype(float)).reshape(-1, 2, 2)
    ends = ends[np.isfinite(ends).all(axis=(1, 2))]
    return ends[np.argsort(-np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1))]


def _lines(grid: PointGrid, fits: LineFits) -> tuple[Lines, Bool[np.ndarray, "lines"]]:
    """Return lines with their variances, and which of them are long, dense and straight enough."""
    members, count = fits.members, len(fits.lines.centres)
    along = along_lines(grid, members, fits.lines.centres, fits.lines.normals)
    low, high = ranges(members, along, count)
    lengths = np.nan_to_num(high - low)
    # Outliers are removed from the fitted points only; the extent includes all points.
    fitted = _without_outliers(grid, middles(members, along), fits.lines.normals)
    means, normals, variances = total_least_squares(grid, fitted, fits.lines.normals)
    low, high = ranges(members, along_lines(grid, members, means, normals), count)
    ends = (
        means[:, None]
        + np.stack([low, high], axis=1)[..., None] * (directions_of(normals)[:, None])
    )
    along = along_lines(grid, fitted, means, normals)
    spreads = np.bincount(fitted.line, along**2, minlength=count)
    points = np.bincount(members.line, minlength=count)
    numbers = np.bincount(fitted.line, minlength=count)
    is_line = (lengths >= MIN_LENGTH) & (points >= MIN_DENSITY * lengths) & (numbers >= 4)
    is_line &= np.sqrt(variances) <= MAX_RMS
    # One independent error per `SMOOTHED_LENGTH` points: variances grow by that factor.
    point_variances = SMOOTHED_LENGTH * np.maximum(variances, MIN_POINT_SIGMA**2)
    offsets = point_variances / np.maximum(numbers, 1) + MODEL_SIGMA**2
    tilts = (2.0 * MODEL_SIGMA / np.maximum(lengths, MIN_LENGTH)) ** 2
    angles = point_variances / np.where(spreads > 0.0, spreads, 1.0) + tilts
    return Lines(means, normals, ends, offsets, angles, np.sqrt(variances), numbers), is_line


def _without_outliers(
    grid: PointGrid, members: Members, normals: Float[np.ndarray, "lines 2"]
) -> Members:
    """Return the points within four robust standard deviations of their line."""
    means, fitted, _ = total_least_squares(grid, members, normals)
    line = members.line
    gaps = grid.points[members.point] - means[line]
    distances = np.abs((gaps * fitted[line]).sum(axis=1))
    counts = np.bincount(line, minlength=len(normals))
    starts = np.cumsum(counts) - counts
    ordered = np.append(distances[np.lexsort((distances, line))], 0.0)
    # The median, as the mean of the two middle values.
    middle = [starts + np.maximum(counts - k, 0) // 2 for k in (1, 0)]
    medians = 0.5 * (ordered[middle[0]] + ordered[middle[1]])
    limits = 4.0 * np.maximum(1.48 * medians, MIN_POINT_SIGMA)
    return members.of((distances <= limits[line]) | (counts < 4)[line])


def _without_repetitions(
    members: Members, is_line: Bool[np.ndarray, "lines"], points: int
) -> Int[np.ndarray, "kept"]:
    """Return the lines that do not repeat points of earlier lines, which are longer proposals."""
    used, kept = np.zeros(points, dtype=bool), []
    bounds = np.searchsorted(members.line, np.arange(len(is_line) + 1))
    for k in np.flatnonzero(is_line):
        on_line = members.point[bounds[k] : bounds[k + 1]]
        # A kept line uses up its points, so that further pieces of the same edge are dropped.
        if used[on_line].mean() <= MAX_USED_FRACTION:
            used[on_line] = True
            kept.append(int(k))
    return np.array(kept, dtype=int)


def is_between(
    lines: Lines,
    index: Int[np.ndarray, "points"],
    points: Float[np.ndarray, "points 2"],
    margin: float,
) -> Bool[np.ndarray, "points"]:
    """Return whether points are within a margin (px) of a segment's extent along its line."""
    middle = lines.ends[index].mean(axis=1)
    half_length = 0.5 * np.linalg.norm(lines.ends[index, 1] - lines.ends[index, 0], axis=1)
    along = ((points - middle) * lines.directions[index]).sum(axis=1)
    return np.abs(along) <= half_length + margin
