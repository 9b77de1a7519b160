"""Prepare a picture for measuring how well it agrees with many poses of known objects.

The projected wireframe of an object should lie on edges of the picture with the same direction.
Distance maps answer this for any place and direction at once (directional chamfer matching;
Gavrila, "Multi-feature hierarchical template matching using distance transforms", 1998; Liu et al.,
"Fast directional chamfer matching", 2010). They are made in the ideal plane, where straight edges
are straight and projection needs no lens.
"""

from functools import lru_cache
from typing import NamedTuple

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import KDTree

from ..cameras import Camera, in_picture
from .edge_correlation import correlated_length
from .edge_points import EdgePoints, find_edge_points
from .features import Features, features_from_edge_points
from .gradient import MIN_GRADIENT_SIGMA, SMOOTHED_LENGTH, Gradient
from .groups import grouped_indices
from .ideal_plane import IdealPlane
from .lone_edges import lone_points
from .picture_checks import grey_levels
from .picture_scale import edge_width, gradient_at, resized, scale_for, scaled_camera

ORIENTATIONS = 8
"""Number of distance maps; directions are modulo half a turn, since an edge has no orientation."""

ORIENTATION_TOLERANCE = float(np.deg2rad(22.5))
"""Largest angle between an edge and the direction of a map that contains it, rad."""

MAX_CELLS = 640
"""Largest number of cells along the longer side of the picture, to limit memory and time."""

DISTANCE_STEP = 1.0 / 16.0
"""Unit of the distances, in cells; the largest one is `FAR` units."""

FAR, UNSEEN = 254, 255
"""Distance of cells far from all edge points, and value of cells outside the picture."""

PLACES_ON_SEGMENT = 16
"""Number of places along a segment at which its edge points are looked up."""

MAX_WIDENING = 1.5
"""Largest extent of the maps over the picture's extent; wider views of a lens are cut off."""


class EdgeMaps(NamedTuple):
    """Points along the straight segments of a picture, and the distances from them.

    Texture has edge points everywhere, but segments only where something is straight. All
    coordinates are ideal (`IdealPlane`), px. Cell (i, j) of a map has its centre at
    `origin + cell_size * (j, i)`. Map k is for edges of direction `k * pi / ORIENTATIONS`, the
    angle from u towards v.

    Attributes:
        distances: to the cell of the nearest edge point with about this direction, in units of
            `DISTANCE_STEP` cells, or `FAR` or `UNSEEN`.
        nearest: index of that point, however far; 0 in maps without points.
        points: points along the segments, one px apart.
        normals: unit normals of the segments, from dark to light.
        origin: centre of the first cell.
        cell_size: px.
        focal_length: of the ideal plane, px.
    """

    distances: UInt8[np.ndarray, "orientations rows columns"]
    nearest: Int[np.ndarray, "orientations rows columns"]
    points: Float[np.ndarray, "points 2"]
    normals: Float[np.ndarray, "points 2"]
    origin: Float[np.ndarray, "2"]
    cell_size: float
    focal_length: float


class PictureEvidence(NamedTuple):
    """Everything found in one picture that does not depend on the objects.

    Attributes:
        features: segments and corners.
        edge_points: of the whole picture, sub-pixel.
        lone: which of them no other edge is near enough to displace.
        maps: distances from its segments.
        grey: the picture as it was given; None if it is unknown.
        scale: size of the searched picture over the given one; all pixels above are of the searched
            picture, whose camera is `scaled_camera`.
        correlated_length: length of an edge whose points count as one observation, px.
        gradient_sigma: standard deviation of the gradient's noise, grey levels per px.
    """

    features: Features
    edge_points: EdgePoints
    lone: Bool[np.ndarray, "points"]
    maps: EdgeMaps
    grey: UInt8[np.ndarray, "rows columns"] | None = None
    scale: float = 1.0
    correlated_length: float = SMOOTHED_LENGTH
    gradient_sigma: float = MIN_GRADIENT_SIGMA

    def at(self, scale: float, camera: Camera) -> "PictureEvidence":
        """Return the evidence of the same picture, searched at another scale.

        Args:
            scale: size of the picture to be searched over the given one.
            camera: that took the picture as it was given.

        Raises:
            ValueError: the given picture is unknown.
        """
        if scale == self.scale:
            return self
        if self.grey is None:
            raise ValueError("the picture was not kept, so it cannot be searched at another scale")
        return _evidence(self.grey.astype(float), camera, scale)


def picture_evidence(
    picture: np.ndarray, camera: Camera, scale: float | None = None
) -> PictureEvidence:
    """Find the features of a picture and prepare the distance maps of its edges.

    A picture whose edges are wide is reduced first, and a small sharp one enlarged
    (`picture_scale`).

    Args:
        picture: uint8, grey `(rows, columns)` or BGR `(rows, columns, 3)`.
        scale: size of the picture to be searched over the given one; by default from the width of
            its edges.

    Raises:
        ValueError: as `find` does.
    """
    return _evidence(grey_levels(picture, camera), camera, scale)


def _evidence(
    grey: Float[np.ndarray, "rows columns"], camera: Camera, scale: float | None
) -> PictureEvidence:
    """Return the evidence of a picture, given its grey levels."""
    gradient = Gradient.of(grey)
    scale = scale_for(edge_width(gradient), camera.image_size) if scale is None else scale
    searched_by = scaled_camera(camera, scale)
    searched = grey
    if scale != 1.0:
        searched = resized(grey, searched_by)
        gradient = gradient_at(scale, gradient, searched)
    edge_points = find_edge_points(gradient)
    features = features_from_edge_points(searched, gradient, edge_points, searched_by)
    lone, maps = lone_points(edge_points), edge_maps(features, searched_by)
    correlated = correlated_length(features.segments, edge_points, lone)
    return PictureEvidence(
        features,
        edge_points,
        lone,
        maps,
        grey.astype(np.uint8),
        scale,
        correlated,
        gradient.sigma,
    )


def evidence_of_points(
    evidence: PictureEvidence, free: Bool[np.ndarray, "points"], camera: Camera
) -> PictureEvidence:
    """Return the evidence of a picture without segments along edge points that are not free."""
    segments, pixels = evidence.features.segments, evidence.edge_points.pixels
    if free.all() or not len(segments):
        return evidence
    # A segment is taken if the edge points next to most of it are.
    shares = np.linspace(0.0, 1.0, PLACES_ON_SEGMENT)[:, None]
    places = segments[:, None, 0] + shares * (segments[:, 1] - segments[:, 0])[:, None]
    _, nearest = KDTree(pixels).query(places.reshape(-1, 2))
    is_free = free[nearest].reshape(len(segments), -1).mean(axis=1) > 0.5
    features = evidence.features.with_segments(is_free)
    return evidence._replace(features=features, maps=edge_maps(features, camera))


def edge_maps(features: Features, camera: Camera) -> EdgeMaps:
    """Return the distance maps of the segments of a picture."""
    plane = IdealPlane(camera)
    points, normals = _points_on_segments(features, plane)
    origin, is_seen, cell_size = _grid(_ByValue(camera))
    # Direction modulo half a turn, perpendicular to the normal.
    angles = np.arctan2(normals[:, 0], -normals[:, 1])
    cells = np.rint((points - origin) / cell_size).astype(int)
    inside = ((cells >= 0) & (cells < is_seen.shape[::-1])).all(axis=1)
    distances = np.full((ORIENTATIONS, *is_seen.shape), FAR, np.uint8)
    nearest = np.zeros((ORIENTATIONS, *is_seen.shape), np.int32)
    for k in range(ORIENTATIONS):
        turn = angles - k * np.pi / ORIENTATIONS
        turn = np.abs((turn + 0.5 * np.pi) % np.pi - 0.5 * np.pi)
        members = np.flatnonzero(inside & (turn <= ORIENTATION_TOLERANCE))
        if len(members):
            nearest[k], gap = _nearest_points(cells[members], members, is_seen.shape)
            distances[k] = np.minimum(gap / DISTANCE_STEP, FAR).astype(np.uint8)
    # Last, because edges reach into cells outside the picture.
    distances[:, ~is_seen] = UNSEEN
    return EdgeMaps(distances, nearest, points, normals, origin, cell_size, plane.focal_length)


class _ByValue:
    """A camera as a dictionary key: cameras with equal numbers are equal."""

    def __init__(self, camera: Camera):
        self.camera = camera
        leaves, structure = jax.tree.flatten(camera)
        self._key = structure, tuple(np.asarray(leaf).tobytes() for leaf in leaves)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByValue) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


@lru_cache(maxsize=4)
def _grid(
    key: _ByValue,
) -> tuple[Float[np.ndarray, "2"], Bool[np.ndarray, "rows columns"], float]:
    """Return the first cell's centre, which cells are within the picture, and the cell size.

    All pictures of a camera share one grid, whose computation takes a while.
    """
    plane, image_size = IdealPlane(key.camera), key.camera.image_size
    size = np.array(image_size)
    # A whole number of pixels, rounded up.
    cell_size = float(-(-max(image_size) // MAX_CELLS))
    # The border of the picture with its corners, where a distorted picture reaches farthest.
    along = np.linspace(-0.5, 1.0, 65)[:, None].clip(0.0) * (size - 1.0)
    u, v = along.T
    top, left = np.column_stack([u, 0.0 * u]), np.column_stack([0.0 * v, v])
    across, down = np.array([size[0] - 1.0, 0.0]), np.array([0.0, size[1] - 1.0])
    border = np.concatenate([top, top + down, left, left + across])
    ideal = plane.from_pixels(border)
    ideal = ideal[np.isfinite(ideal).all(axis=1)]
    middle = plane.from_pixels(0.5 * (size - 1.0)[None])[0]
    limit = 0.5 * MAX_WIDENING * size
    # Where the lens has no rays at the border, use the picture's own size.
    reach = ideal if len(ideal) else middle + 0.5 * np.array([-size, size])
    low = np.maximum(reach.min(axis=0), middle - limit)
    high = np.minimum(reach.max(axis=0), middle + limit)
    columns, rows = np.ceil((high - low) / cell_size).astype(int) + 1
    centres = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
    pixels = plane.to_pixels((low + cell_size * centres).reshape(-1, 2))[0]
    return low, in_picture(pixels, image_size).reshape(rows, columns), cell_size


def _points_on_segments(
    features: Features, plane: IdealPlane
) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2"]]:
    """Return points along the segments, a pixel apart, and their normals, in ideal coordinates."""
    ends = plane.from_pixels(features.segments.reshape(-1, 2)).reshape(-1, 2, 2)
    # Segments outside the ideal plane, where a wide lens still sees, are left out.
    ends = ends[np.isfinite(ends).all(axis=(1, 2))]
    starts, spans = ends[:, 0], ends[:, 1] - ends[:, 0]
    lengths = np.linalg.norm(spans, axis=1)
    counts = np.maximum(2, np.ceil(lengths).astype(int) + 1)
    index, place = grouped_indices(counts)
    along = (place / (counts - 1)[index])[:, None]
    # The lighter side is to the left as seen in the picture, where v points down.
    directions = spans / np.maximum(lengths, 1e-9)[:, None]
    normals = np.column_stack([directions[:, 1], -directions[:, 0]])
    return starts[index] + along * spans[index], normals[index]


def _nearest_points(
    cells: Int[np.ndarray, "points 2"], index: Int[np.ndarray, "points"], shape: tuple[int, int]
) -> tuple[Int[np.ndarray, "rows columns"], Float[np.ndarray, "rows columns"]]:
    """Return the point in the nearest occupied cell, and the distance of that cell in cells."""
    point_in = np.zeros(shape, np.int32)
    is_free = np.ones(shape, np.uint8)
    column, row = cells.T
    # Where several points share a cell, any of them is fine: they are on one line.
    point_in[row, column], is_free[row, column] = index, 0
    gap, nearest = cv2.distanceTransformWithLabels(
        is_free, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    labels = np.asarray(nearest, np.int32)
    # Each occupied cell has its own label, shared by the cells nearest to it.
    point_of = np.zeros(int(labels.max()) + 1, np.int32)
    occupied = is_free == 0
    point_of[labels[occupied]] = point_in[occupied]
    return point_of[labels], gap
