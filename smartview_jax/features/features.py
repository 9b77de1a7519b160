"""Find the straight segments and the corners of a picture, with their covariances."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..cameras import Camera, in_picture
from .corners import MAX_END_GAP, LineCorners, far_from, gradient_corners, line_corners
from .edge_points import EdgePoints, find_edge_points
from .gradient import Gradient
from .ideal_plane import IdealPlane
from .picture_checks import grey_levels
from .segments import Lines, find_lines

SAME_CORNER_DISTANCE = 1.0
"""Distance from a corner of segments within which a gradient corner is the same, px."""

SAME_END_DISTANCE = 2.5
"""Distance from a corner of segments within which a free end is the same, px."""

MIN_FREE_LENGTH = 15.0
"""Length of the shortest segment whose free ends are corners, px."""

END_SIGMA = 1.0
"""Standard deviation of a free end along its segment, px; an end at a corner has the corner's
covariance."""


class Features(NamedTuple):
    """Segments and corners of one picture; everything is finite.

    Corners in which segments meet come first; then free ends of long segments, with one segment
    each, which are uncertain along it; then gradient corners, without segments. A segment that ends
    at a corner has its end there.

    Attributes:
        corners: pixels.
        corner_covariances: px^2.
        corner_segments: indices of the segments that meet in a corner, padded with -1.
        segments: pixels of the two ends; seen in the picture, the lighter side is to the left of
            the direction from the first end to the second.
        end_covariances: covariances of the ends, px^2: small across the segment.
        lines: unit normals, in the camera's frame, of the planes through the camera's centre and
            the segments: `line @ point == 0` for points on the edge in space.
        line_covariances: covariances of the unit normals, of rank two.
        image_size: width and height of the picture, px.
    """

    corners: Float[np.ndarray, "corners 2"]
    corner_covariances: Float[np.ndarray, "corners 2 2"]
    corner_segments: Int[np.ndarray, "corners joined"]
    segments: Float[np.ndarray, "segments 2 2"]
    end_covariances: Float[np.ndarray, "segments 2 2 2"]
    lines: Float[np.ndarray, "segments 3"]
    line_covariances: Float[np.ndarray, "segments 3 3"]
    image_size: tuple[int, int]

    def with_segments(self, kept: Bool[np.ndarray, "segments"]) -> "Features":
        """Return some of the segments, and all corners without the other segments."""
        # Index -1, for "no segment", selects the last entry.
        index = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)
        joined = index[self.corner_segments]
        # The padding stays behind the segments of a corner.
        order = np.argsort(joined < 0, axis=1, kind="stable")
        return self._replace(
            corner_segments=np.take_along_axis(joined, order, axis=1),
            segments=self.segments[kept],
            end_covariances=self.end_covariances[kept],
            lines=self.lines[kept],
            line_covariances=self.line_covariances[kept],
        )


def find(picture: np.ndarray, camera: Camera) -> Features:
    """Find straight segments and corners in a picture, with their covariances.

    Edge points are found with sub-pixel accuracy, undistorted, and fitted by lines where straight
    edges are straight.

    Args:
        picture: uint8, grey `(rows, columns)` or BGR `(rows, columns, 3)`.

    Raises:
        ValueError: the array is not a picture of the camera's size, or the picture is blank,
            over-exposed or under-exposed; the message says which.
    """
    grey = grey_levels(picture, camera)
    gradient = Gradient.of(grey)
    return features_from_edge_points(grey, gradient, find_edge_points(gradient), camera)


def features_from_edge_points(
    grey: Float[np.ndarray, "rows columns"],
    gradient: Gradient,
    edge_points: EdgePoints,
    camera: Camera,
) -> Features:
    """Return the segments and corners of a picture whose edge points are already known."""
    plane = IdealPlane(camera)
    lines = find_lines(grey, edge_points, plane)
    junctions = line_corners(lines)
    corners, derivatives = plane.to_pixels(junctions.points)
    covariances = derivatives @ junctions.covariances @ derivatives.transpose(0, 2, 1)
    # Two lines may meet beyond the picture's border.
    inside = in_picture(corners, camera.image_size)
    junctions = LineCorners(*(part[inside] for part in junctions))
    corners, covariances = corners[inside], covariances[inside]
    ends, end_covariances, free = _end_pixels(lines, junctions, plane)
    normals, normal_covariances = _plane_normals(lines, plane)
    # In order of certainty; each kind adds corners only where there is none yet.
    free_corners = _free_ends(ends, end_covariances, free, junctions.segments.shape[1], corners)
    junction_parts = (corners, covariances, junctions.segments)
    known = [np.concatenate(parts) for parts in zip(junction_parts, free_corners, strict=True)]
    candidates, other_covariances = gradient_corners(grey, gradient)
    new = far_from(candidates, known[0], SAME_CORNER_DISTANCE)
    joined = np.full((int(new.sum()), junctions.segments.shape[1]), -1)
    return Features(
        np.concatenate([known[0], candidates[new]]),
        np.concatenate([known[1], other_covariances[new]]),
        np.concatenate([known[2], joined]),
        ends,
        end_covariances,
        normals,
        normal_covariances,
        camera.image_size,
    )


def _free_ends(
    ends: Float[np.ndarray, "segments 2 2"],
    covariances: Float[np.ndarray, "segments 2 2 2"],
    free: Bool[np.ndarray, "segments 2"],
    columns: int,
    corners: Float[np.ndarray, "corners 2"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the ends of long segments without a corner: pixels, covariances, segments."""
    # Short segments are often texture, whose ends mean nothing.
    long = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) >= MIN_FREE_LENGTH
    segment, side = np.nonzero(free & long[:, None])
    far = far_from(ends[segment, side], corners, SAME_END_DISTANCE)
    segment, side = segment[far], side[far]
    joined = np.full((len(segment), columns), -1)
    joined[:, 0] = segment
    return ends[segment, side], covariances[segment, side], joined


def _end_pixels(
    lines: Lines, junctions: LineCorners, plane: IdealPlane
) -> tuple[
    Float[np.ndarray, "segments 2 2"],
    Float[np.ndarray, "segments 2 2 2"],
    Bool[np.ndarray, "segments 2"],
]:
    """Return pixels and covariances of the segments' ends, and whether they have no corner.

    An end at a corner has the corner's position.
    """
    count = len(lines.centres)
    index = np.repeat(np.arange(count), 2)
    ends = lines.ends.reshape(-1, 2).copy()
    # Accurate across the segment, inaccurate along it: edges fade out rather than end.
    across, along = lines.normals[index], lines.directions[index]
    covariances = lines.variances_at(index, ends)[:, None, None] * _outer(across)
    covariances = covariances + END_SIGMA**2 * _outer(along)
    free = np.ones(2 * count, dtype=bool)
    corner, place = np.nonzero(junctions.segments >= 0)
    segment = junctions.segments[corner, place]
    # The nearer end; the corner of a T is in the middle of one of its segments.
    gaps = np.linalg.norm(lines.ends[segment] - junctions.points[corner][:, None], axis=2)
    near = gaps.min(axis=1) <= MAX_END_GAP
    corner, end = corner[near], (2 * segment + np.argmin(gaps, axis=1))[near]
    ends[end], covariances[end] = junctions.points[corner], junctions.covariances[corner]
    free[end] = False
    pixels, derivatives = plane.to_pixels(ends)
    covariances = derivatives @ covariances @ derivatives.transpose(0, 2, 1)
    free &= np.isfinite(pixels).all(axis=1)
    return (
        pixels.reshape(count, 2, 2),
        covariances.reshape(count, 2, 2, 2),
        free.reshape(count, 2),
    )


def _outer(vectors: Float[np.ndarray, "rows 2"]) -> Float[np.ndarray, "rows 2 2"]:
    """Return the products v v^T."""
    return vectors[:, :, None] * vectors[:, None, :]


def _plane_normals(
    lines: Lines, plane: IdealPlane
) -> tuple[Float[np.ndarray, "segments 3"], Float[np.ndarray, "segments 3 3"]]:
    """Return the unit normals of the planes through lines and the camera's centre, with covariance.

    A line n . x = d of the ideal plane at focal length f lies in the plane through the centre with
    the normal (f n, -d).
    """
    f, n, t = plane.focal_length, lines.normals, lines.directions
    d = (n * lines.centres).sum(axis=1)
    normals = np.column_stack([f * n, -d])
    lengths = np.linalg.norm(normals, axis=1)[:, None]
    normals = normals / lengths
    # A shift by e across the line changes d by e. A turn by a about the centre c changes n by a t
    # and d by a (t . c), since c stays on the line.
    by_shift = np.column_stack([np.zeros_like(n), -np.ones(len(n))]) / lengths
    by_turn = np.column_stack([f * t, -(t * lines.centres).sum(axis=1)]) / lengths
    # The two errors of a line are independent about its centre, so their covariances add up.
    covariances = np.zeros((len(n), 3, 3))
    for derivative, variance in (
        (by_shift, lines.offset_variances),
        (by_turn, lines.angle_variances),
    ):
        # For a unit vector only the derivative perpendicular to it counts.
        tangent = derivative - normals * (normals * derivative).sum(axis=1, keepdims=True)
        covariances += variance[:, None, None] * tangent[:, :, None] * tangent[:, None, :]
    return normals, covariances
