"""Prepare a picture for asking how well it agrees with many poses of known objects.

A wireframe that is projected at a pose should lie on edges of the picture that run in its own
direction. Distance maps answer this for any place and direction at once (directional chamfer
matching; Gavrila, "Multi-feature hierarchical template matching using distance transforms", 1998;
Liu et al., "Fast directional chamfer matching", 2010). They are made in the ideal plane, where
straight edges are straight and no lens is needed to project.
"""

from functools import lru_cache
from typing import NamedTuple

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ..cameras import Camera
from .edge_points import EdgePoints, find_edge_points
from .features import Features, features_from_edge_points
from .gradient import Gradient
from .ideal_plane import IdealPlane
from .lone_edges import lone_points
from .picture_checks import grey_levels

ORIENTATIONS = 8
"""Number of distance maps; directions are modulo half a turn, since an edge has two."""

ORIENTATION_TOLERANCE = float(np.deg2rad(22.5))
"""Largest angle between an edge point and the direction of a map that has it, rad."""

MAX_CELLS = 640
"""Number of cells along the longer side of the picture at most, which bounds memory and time."""

DISTANCE_STEP = 1.0 / 16.0
"""Unit of the distances, in cells; the largest one is `FAR` units."""

FAR, UNSEEN = 254, 255
"""Distances of cells that are far from all edge points, and of those that the picture lacks."""

MAX_WIDENING = 1.5
"""Largest extent of the maps over that of the picture; a wide lens sees more, which is left out."""


class EdgeMaps(NamedTuple):
    """Points along the straight segments of a picture, and the distances from them.

    Texture has edge points everywhere, and segments only where something is straight. All is in
    ideal coordinates (`IdealPlane`), px. Cell (i, j) of a map has its centre at
    `origin + cell_size * (j, i)`. Map k is for edges of direction `k * pi / ORIENTATIONS`, the
    angle from u towards v.

    Attributes:
        distances: from the cell of the nearest edge point of about this direction, in units of
            `DISTANCE_STEP` cells, or `FAR` or `UNSEEN`.
        nearest: index of that point, however far; 0 in maps without points.
        points: a pixel apart along their segments.
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
    """All that is found in one picture, before anybody asks for an object.

    Attributes:
        features: segments and corners.
        edge_points: of the whole picture, sub-pixel.
        lone: which of them have no other edge beside them, which would displace them.
        maps: distances from its segments.
    """

    features: Features
    edge_points: EdgePoints
    lone: Bool[np.ndarray, "points"]
    maps: EdgeMaps


def picture_evidence(picture: np.ndarray, camera: Camera) -> PictureEvidence:
    """Find the features of a picture and prepare the distance maps of its edges.

    Args:
        picture: uint8, grey `(rows, columns)` or BGR `(rows, columns, 3)`.
        camera: intrinsics and lens of the camera that took it.

    Raises:
        ValueError: as `find` does.
    """
    grey = grey_levels(picture, camera)
    gradient = Gradient.of(grey)
    edge_points = find_edge_points(gradient)
    features = features_from_edge_points(grey, gradient, edge_points, camera)
    lone = lone_points(edge_points)
    return PictureEvidence(features, edge_points, lone, edge_maps(features, camera))


def edge_maps(features: Features, camera: Camera) -> EdgeMaps:
    """Return the distance maps of the segments of a picture."""
    plane = IdealPlane(camera)
    points, normals = _points_on_segments(features, plane)
    origin, seen, cell_size = _grid(_ByValue(camera))
    # Direction modulo half a turn, at a right angle to the normal.
    angles = np.arctan2(normals[:, 0], -normals[:, 1])
    cells = np.rint((points - origin) / cell_size).astype(int)
    inside = ((cells >= 0) & (cells < seen.shape[::-1])).all(axis=1)
    distances = np.full((ORIENTATIONS, *seen.shape), FAR, np.uint8)
    nearest = np.zeros((ORIENTATIONS, *seen.shape), np.int32)
    for k in range(ORIENTATIONS):
        turn = angles - k * np.pi / ORIENTATIONS
        turn = np.abs((turn + 0.5 * np.pi) % np.pi - 0.5 * np.pi)
        own = np.flatnonzero(inside & (turn <= ORIENTATION_TOLERANCE))
        if len(own):
            nearest[k], gap = _nearest_points(cells[own], own, seen.shape)
            distances[k] = np.minimum(gap / DISTANCE_STEP, FAR).astype(np.uint8)
    # Last, because edges reach into cells that the picture lacks.
    distances[:, ~seen] = UNSEEN
    return EdgeMaps(distances, nearest, points, normals, origin, cell_size, plane.focal_length)


class _ByValue:
    """A camera that is equal to another one of the same numbers, so that it is a key."""

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
    """Return the first cell's centre, which cells are within the picture, and their size.

    All pictures of a camera have one grid, which takes its lens a while.
    """
    plane, image_size = IdealPlane(key.camera), key.camera.image_size
    size = np.array(image_size)
    # A whole number of pixels, rounded up.
    cell_size = float(-(-max(image_size) // MAX_CELLS))
    # The border of the picture, with its corners, where distorted pictures reach farthest.
    along = np.linspace(-0.5, 1.0, 65)[:, None].clip(0.0) * (size - 1.0)
    u, v = along.T
    top, left = np.column_stack([u, 0.0 * u]), np.column_stack([0.0 * v, v])
    across, down = np.array([size[0] - 1.0, 0.0]), np.array([0.0, size[1] - 1.0])
    border = np.concatenate([top, top + down, left, left + across])
    ideal = plane.from_pixels(border)
    ideal = ideal[np.isfinite(ideal).all(axis=1)]
    middle = plane.from_pixels(0.5 * (size - 1.0)[None])[0]
    limit = 0.5 * MAX_WIDENING * size
    # Where the lens has no rays at the border, the picture's own size has to do.
    reach = ideal if len(ideal) else middle + 0.5 * np.array([-size, size])
    low = np.maximum(reach.min(axis=0), middle - limit)
    high = np.minimum(reach.max(axis=0), middle + limit)
    columns, rows = np.ceil((high - low) / cell_size).astype(int) + 1
    centres = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
    pixels = plane.to_pixels((low + cell_size * centres).reshape(-1, 2))[0]
    with np.errstate(invalid="ignore"):
        seen = ((pixels > -0.5) & (pixels < size - 0.5)).all(axis=1)
    return low, seen.reshape(rows, columns), cell_size


def _points_on_segments(
    features: Features, plane: IdealPlane
) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2"]]:
    """Return points along the segments, a pixel apart, and their normals, in ideal coordinates."""
    ends = plane.from_pixels(features.segments.reshape(-1, 2)).reshape(-1, 2, 2)
    # Beside the ideal plane, where a wide lens still sees, nothing is looked for.
    ends = ends[np.isfinite(ends).all(axis=(1, 2))]
    starts, spans = ends[:, 0], ends[:, 1] - ends[:, 0]
    lengths = np.linalg.norm(spans, axis=1)
    counts = np.maximum(2, np.ceil(lengths).astype(int) + 1)
    index = np.repeat(np.arange(len(starts)), counts)
    place = np.arange(len(index)) - np.repeat(np.cumsum(counts) - counts, counts)
    along = (place / (counts - 1)[index])[:, None]
    # The lighter side is to the left as seen in the picture, where v points down.
    directions = spans / np.maximum(lengths, 1e-9)[:, None]
    normals = np.column_stack([directions[:, 1], -directions[:, 0]])
    return starts[index] + along * spans[index], normals[index]


def _nearest_points(
    cells: Int[np.ndarray, "points 2"], index: Int[np.ndarray, "points"], shape: tuple[int, int]
) -> tuple[Int[np.ndarray, "rows columns"], Float[np.ndarray, "rows columns"]]:
    """Return the point in the nearest cell that has one, and its cell's distance in cells."""
    own = np.zeros(shape, np.int32)
    is_free = np.ones(shape, np.uint8)
    column, row = cells.T
    # Where several points share a cell, any of them will do: they are on one line.
    own[row, column], is_free[row, column] = index, 0
    gap, found = cv2.distanceTransformWithLabels(
        is_free, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    labels = np.asarray(found, dtype=int)
    # Each occupied cell has a label of its own, which the cells nearest to it share.
    point_of = np.zeros(int(labels.max()) + 1, np.int32)
    occupied = is_free == 0
    point_of[labels[occupied]] = own[occupied]
    return point_of[labels], gap
