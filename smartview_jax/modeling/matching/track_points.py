"""Triangulate the points of corners that were matched over several views, and leave out misfits."""

import numpy as np
from jaxtyping import Float, Int

from ...evaluation import CalibrationEstimate
from ...features import Features
from ...robots import CommandLike
from ..rig_views import AnyCalibration
from ..triangulation import TriangulatedPoints, triangulate_points

MATCH_SIGMA = 0.3
"""Standard deviation between matched corners of two views beyond their own errors, px."""

MAX_DISTANCE = 2.0
"""Distance of a corner from its point, px, above which a point's worst corner is left out."""


def corner_pixels(
    features_of_views: tuple[Features, ...], corners: Int[np.ndarray, "views points"]
) -> Float[np.ndarray, "views points 2"]:
    """Return the pixels of corners by view, NaN where there is none."""
    pixels = np.full((*corners.shape, 2), np.nan)
    for k, features in enumerate(features_of_views):
        has_corner = corners[k] >= 0
        pixels[k, has_corner] = features.corners[corners[k, has_corner]]
    return pixels


def triangulated_tracks(
    calibration: AnyCalibration,
    poses: CommandLike | None,
    features_of_views: tuple[Features, ...],
    corners: Int[np.ndarray, "views points"],
    covariance: CalibrationEstimate | None = None,
) -> TriangulatedPoints:
    """Return the points of corners, each corner weighted by its covariance."""
    sigmas = np.tile(np.eye(2), (*corners.shape, 1, 1))
    for k, features in enumerate(features_of_views):
        has_corner = corners[k] >= 0
        # Corners of different views are never exactly the same point of a surface.
        sigmas[k, has_corner] = features.corner_covariances[
            corners[k, has_corner]
        ] + MATCH_SIGMA**2 * np.eye(2)
    return triangulate_points(
        calibration,
        poses,
        corner_pixels(features_of_views, corners),
        corners >= 0,
        covariance=covariance,
        pixel_sigma=sigmas,
    )


def track_rms(points: TriangulatedPoints) -> Float[np.ndarray, "points"]:
    """Return the RMS reprojection error of each point over its views, px; infinite if it failed."""
    squared = (points.residuals**2).sum(axis=-1)
    count = np.isfinite(squared).sum(axis=0)
    mean = np.nansum(squared, axis=0) / np.maximum(count, 1)
    return np.where(points.ok & (count > 0), np.sqrt(mean), np.inf)


def without_misfits(
    calibration: AnyCalibration,
    poses: CommandLike | None,
    features_of_views: tuple[Features, ...],
    corners: Int[np.ndarray, "views points"],
    needed: int,
) -> tuple[Int[np.ndarray, "views kept"], Int[np.ndarray, "kept"]]:
    """Return the tracks without corners far from their point, and the indices of these tracks."""
    points = triangulated_tracks(calibration, poses, features_of_views, corners)
    distance = np.linalg.norm(points.residuals, axis=-1)
    # A wrong corner moves the point, and so all distances: remove only the worst one.
    distance = np.where(np.isfinite(distance), distance, -np.inf)
    worst = np.argmax(distance, axis=0), np.arange(corners.shape[1])
    corners = corners.copy()
    corners[worst] = np.where(distance[worst] > MAX_DISTANCE, -1, corners[worst])
    kept = np.flatnonzero((corners >= 0).sum(axis=0) >= needed)
    return corners[:, kept], kept
