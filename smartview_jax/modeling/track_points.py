"""Triangulate the points of corners that were matched over several views, and leave out misfits."""

import numpy as np
from jaxtyping import Float, Int

from ..calibration import Calibration
from ..evaluation import CalibrationEstimate
from ..features import Features
from ..robots import CommandLike
from .triangulation import TriangulatedPoints, triangulate_points

MATCH_SIGMA = 0.3
"""Standard deviation of a corner of one view from the same corner of another, px."""

MAX_DISTANCE = 2.0
"""Distance of a corner from its point, px, beyond which the worst corner of a point is left out."""


def corner_pixels(
    found: tuple[Features, ...], corners: Int[np.ndarray, "views points"]
) -> Float[np.ndarray, "views points 2"]:
    """Return the pixels of corners by view, NaN where there is none."""
    pixels = np.full((*corners.shape, 2), np.nan)
    for k, features in enumerate(found):
        own = corners[k] >= 0
        pixels[k, own] = features.corners[corners[k, own]]
    return pixels


def triangulated_tracks(
    calibration: Calibration,
    poses: CommandLike,
    found: tuple[Features, ...],
    corners: Int[np.ndarray, "views points"],
    covariance: CalibrationEstimate | None = None,
) -> TriangulatedPoints:
    """Return the points of corners, each weighted by its own covariance."""
    sigmas = np.tile(np.eye(2), (*corners.shape, 1, 1))
    for k, features in enumerate(found):
        own = corners[k] >= 0
        # Corners of different views are never quite the same point of a surface.
        sigmas[k, own] = features.corner_covariances[corners[k, own]] + MATCH_SIGMA**2 * np.eye(2)
    return triangulate_points(
        calibration,
        poses,
        corner_pixels(found, corners),
        corners >= 0,
        covariance=covariance,
        pixel_sigma=sigmas,
    )


def track_rms(points: TriangulatedPoints) -> Float[np.ndarray, "points"]:
    """Return the RMS reprojection error of each point over its views, px; infinite if it failed."""
    squared = (points.residuals**2).sum(axis=-1)
    count = np.isfinite(squared).sum(axis=0)
    # A point that failed has no residuals, and its error is infinite.
    mean = np.nansum(squared, axis=0) / np.maximum(count, 1)
    return np.where(points.ok & (count > 0), np.sqrt(mean), np.inf)


def without_misfits(
    calibration: Calibration,
    poses: CommandLike,
    found: tuple[Features, ...],
    corners: Int[np.ndarray, "views points"],
    needed: int,
) -> tuple[Int[np.ndarray, "views kept"], Int[np.ndarray, "kept"]]:
    """Return the tracks without corners that are too far from their point, and which remain."""
    points = triangulated_tracks(calibration, poses, found, corners)
    distance = np.linalg.norm(points.residuals, axis=-1)
    # One wrong corner moves the point, and with it all distances: only the worst one goes.
    distance = np.where(np.isfinite(distance), distance, -np.inf)
    worst = np.argmax(distance, axis=0), np.arange(corners.shape[1])
    corners = corners.copy()
    corners[worst] = np.where(distance[worst] > MAX_DISTANCE, -1, corners[worst])
    kept = np.flatnonzero((corners >= 0).sum(axis=0) >= needed)
    return corners[:, kept], kept
