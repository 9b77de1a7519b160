"""Fit straight segments to edge points that were taken through the lens.

OpenCV's line segment detector (von Gioi et al., "LSD: a line segment detector", 2012) proposes
pieces in the picture, where the lens bends edges. Each piece is then fitted and extended on
sub-pixel edge points in the ideal plane, where an edge is straight, so that pieces of one edge
become one segment.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from .edge_points import SMOOTHING, EdgePoints
from .ideal_plane import IdealPlane

GREY_LEVEL_BOUND = 1.0
"""Error of a gradient, grey levels, that OpenCV's detector expects; its own 2 misses weak edges."""

BAND_HALF_WIDTHS = (2.5, 1.5, 1.2)
"""Largest distances of edge points from the line, px, in the fits that follow one another."""

MAX_EXTENSION = 30.0
"""Length beyond twice its own by which a segment may grow in each of these fits, px."""

MAX_GAP = 4.0
"""Largest distance between neighbouring points of one segment, px."""

MIN_LENGTH = 8.0
"""Length of the shortest segment, px."""

MIN_DENSITY = 0.6
"""Smallest number of edge points per px of length; a straight edge has 0.7 to 1."""

MAX_RMS = 0.5
"""Largest RMS distance of points from their line, px; more is a curve or texture."""

MIN_ALIGNMENT = float(np.cos(np.deg2rad(22.5)))
"""Smallest cosine between an edge point's gradient and the line's normal."""

END_MARGIN = 3.0
"""Length at either end of a segment that is not fitted, px: other edges bend it there."""

MAX_USED_FRACTION = 0.5
"""Fraction of a proposal's points in earlier segments above which it adds nothing."""

CORRELATED_POINTS = 2.0 * np.sqrt(np.pi) * SMOOTHING
"""Number of neighbouring points whose errors count as one, because the picture was smoothed.

The noise of gradients that are d px apart has the correlation exp(-d^2 / (4 s^2)), whose sum over
all d is 2 sqrt(pi) s.
"""

MIN_POINT_SIGMA = 0.03
"""Smallest standard deviation of an edge point that is believed, px: pixels have an extent."""

MODEL_SIGMA = 0.01
"""Standard deviation of a whole line's position however many points it has, px."""


class Lines(NamedTuple):
    """Fitted straight segments in the ideal plane (px).

    Attributes:
        centres: the means of the fitted points.
        normals: unit normals in the plane, from dark to light.
        ends: first and last end along the direction of `directions`.
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
        return np.column_stack([-self.normals[:, 1], self.normals[:, 0]])

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
    points = plane.from_pixels(edge_points.pixels)
    normals = _ideal_normals(edge_points, plane)
    # Points that the lens cannot place in the ideal plane are left out.
    usable = np.isfinite(points).all(axis=1) & np.isfinite(normals).all(axis=1)
    search = _Search(points[usable], normals[usable])
    # The longest first: each takes its points, and the pieces of the same edge find them used.
    for start, end in _proposals(grey, plane):
        search.follow(start, end)
    return search.lines()


def _proposals(
    grey: Float[np.ndarray, "rows columns"], plane: IdealPlane
) -> Float[np.ndarray, "proposals 2 2"]:
    """Return the ends of OpenCV's line segments in the ideal plane, the longest first."""
    detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, quant=GREY_LEVEL_BOUND)
    found = detector.detect(grey.astype(np.uint8))[0]
    if found is None:
        return np.zeros((0, 2, 2))
    ends = plane.from_pixels(found.reshape(-1, 2).astype(float)).reshape(-1, 2, 2)
    ends = ends[np.isfinite(ends).all(axis=(1, 2))]
    return ends[np.argsort(-np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1))]


def _ideal_normals(edge_points: EdgePoints, plane: IdealPlane) -> Float[np.ndarray, "points 2"]:
    """Return the directions of the gradients in the ideal plane."""
    # A gradient is a covector: with J the derivative of ideal coordinates by pixels, J^-T g.
    inverse = plane.to_pixels(plane.from_pixels(edge_points.pixels))[1]
    normals = np.einsum("nji,nj->ni", inverse, edge_points.normals)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


class _Search:
    """The search for lines among edge points, of which each belongs to one line at most."""

    def __init__(
        self, points: Float[np.ndarray, "points 2"], normals: Float[np.ndarray, "points 2"]
    ):
        self._points, self._normals = points, normals
        self._tree = KDTree(points) if len(points) else None
        self._used = np.zeros(len(points), dtype=bool)
        self._found: list[tuple] = []

    def follow(self, start: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"]) -> None:
        """Fit a line to the points along a proposal and beyond its ends; keep it if it is one."""
        centre, direction = 0.5 * (start + end), end - start
        half_length = 0.5 * float(np.linalg.norm(direction))
        direction = direction / (2.0 * half_length)
        normal = self._light_side(centre, direction, half_length)
        run = np.zeros(0, dtype=int)
        for half_width in BAND_HALF_WIDTHS:
            # The tree is asked anew, because the segment may have grown.
            near = self._near(centre, half_length)
            run = self._run(near, centre, normal, half_length, half_width)
            if len(run) < MIN_DENSITY * MIN_LENGTH or self._used[run].mean() > MAX_USED_FRACTION:
                return
            centre, normal, half_length = self._fit(run, normal)
        self._keep(run, centre, normal)

    def _near(self, centre: np.ndarray, half_length: float) -> np.ndarray:
        """Return the indices of the points around a line so far and around what may continue it."""
        if self._tree is None:
            return np.zeros(0, dtype=int)
        # A disc is more than is needed, but a tree answers it quickly.
        reach = 2.0 * half_length + MAX_EXTENSION
        return np.array(self._tree.query_ball_point(centre, reach), dtype=int)

    def _light_side(
        self, centre: np.ndarray, direction: np.ndarray, half_length: float
    ) -> np.ndarray:
        """Return the normal of a proposal's direction that most of its gradients agree with."""
        normal, near = np.array([-direction[1], direction[0]]), self._near(centre, half_length)
        offset = self._points[near] - centre
        members = near[
            (np.abs(offset @ direction) <= half_length)
            & (np.abs(offset @ normal) < BAND_HALF_WIDTHS[0])
        ]
        alignment = self._normals[members] @ normal
        # Where two edges run side by side, both polarities are near: the more frequent one wins.
        lighter, darker = (alignment > MIN_ALIGNMENT).sum(), (alignment < -MIN_ALIGNMENT).sum()
        return normal if lighter >= darker else -normal

    def _run(
        self,
        near: np.ndarray,
        centre: np.ndarray,
        normal: np.ndarray,
        half_length: float,
        half_width: float,
    ) -> np.ndarray:
        """Return the points of a line without gaps that cover most of the interval so far."""
        aligned = self._normals[near] @ normal > MIN_ALIGNMENT
        close = np.abs((self._points[near] - centre) @ normal) < half_width
        chosen = near[aligned & close]
        along = (self._points[chosen] - centre) @ np.array([-normal[1], normal[0]])
        # Cut into pieces at the gaps; the piece over the proposal goes on.
        order = np.argsort(along)
        pieces = np.split(order, np.nonzero(np.diff(along[order]) > MAX_GAP)[0] + 1)
        inside = [(np.abs(along[piece]) <= half_length).sum() for piece in pieces]
        return chosen[pieces[int(np.argmax(inside))]]

    def _fit(self, run: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Return centre, normal and half the length of the line of least squared distances."""
        centre, fitted_normal, _ = _total_least_squares(self._points[self._middle(run, normal)])
        fitted_normal = fitted_normal if fitted_normal @ normal > 0.0 else -fitted_normal
        along = (self._points[run] - centre) @ np.array([-fitted_normal[1], fitted_normal[0]])
        middle = 0.5 * (along.max() + along.min())
        direction = np.array([-fitted_normal[1], fitted_normal[0]])
        return centre + middle * direction, fitted_normal, 0.5 * float(np.ptp(along))

    def _middle(self, run: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Return the points of a run that are fitted: those away from the ends of a long one."""
        along = self._points[run] @ np.array([-normal[1], normal[0]])
        first, last = along.min(), along.max()
        margin = min(END_MARGIN, 0.25 * (last - first))
        middle = run[(along >= first + margin) & (along <= last - margin)]
        # A short run may have points at its ends only.
        return middle if len(middle) >= 2 else run

    def _keep(self, run: np.ndarray, centre: np.ndarray, normal: np.ndarray) -> None:
        """Store a line, if its points are many, straight and dense enough."""
        direction = np.array([-normal[1], normal[0]])
        along = (self._points[run] - centre) @ direction
        length = float(np.ptp(along))
        # Only what is fitted is freed of outliers; the extent is that of all points.
        fitted = self._without_outliers(self._middle(run, normal))
        if length < MIN_LENGTH or len(run) < MIN_DENSITY * length or len(fitted) < 4:
            return
        mean, own_normal, variance = _total_least_squares(self._points[fitted])
        if np.sqrt(variance) > MAX_RMS:
            return
        own_normal = own_normal if own_normal @ normal > 0.0 else -own_normal
        own_direction = np.array([-own_normal[1], own_normal[0]])
        reach = (self._points[run] - mean) @ own_direction
        spread = float((((self._points[fitted] - mean) @ own_direction) ** 2).sum())
        # One independent error in `CORRELATED_POINTS` points: variances grow by that factor.
        point_variance = CORRELATED_POINTS * max(variance, MIN_POINT_SIGMA**2)
        ends = mean + np.array([[reach.min()], [reach.max()]]) * own_direction
        offset_variance = point_variance / len(fitted) + MODEL_SIGMA**2
        angle_variance = point_variance / spread + (2.0 * MODEL_SIGMA / length) ** 2
        self._used[run] = True
        self._found.append(
            (mean, own_normal, ends, offset_variance, angle_variance, variance**0.5, len(fitted))
        )

    def _without_outliers(self, run: np.ndarray) -> np.ndarray:
        """Return the points within four robust standard deviations of their line."""
        if len(run) < 4:
            return run
        mean, normal, _ = _total_least_squares(self._points[run])
        distance = np.abs((self._points[run] - mean) @ normal)
        return run[distance <= 4.0 * max(1.48 * float(np.median(distance)), MIN_POINT_SIGMA)]

    def lines(self) -> Lines:
        """Return all lines that were found."""
        columns = zip(*self._found, strict=True)
        centres, normals, ends, offsets, angles, rms, counts = (
            [np.array(column) for column in columns] if self._found else [np.zeros(0)] * 7
        )
        return Lines(
            centres.reshape(-1, 2),
            normals.reshape(-1, 2),
            ends.reshape(-1, 2, 2),
            offsets,
            angles,
            rms,
            counts.astype(int),
        )


def _total_least_squares(
    points: Float[np.ndarray, "points 2"],
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"], float]:
    """Return mean, unit normal and variance across of the line of least squared distances."""
    mean = points.mean(axis=0)
    # The eigenvector of the smaller eigenvalue of the scatter matrix is the normal.
    values, vectors = np.linalg.eigh((points - mean).T @ (points - mean))
    # Two numbers of a line are fitted.
    return mean, vectors[:, 0], float(max(values[0], 0.0)) / max(len(points) - 2, 1)


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
