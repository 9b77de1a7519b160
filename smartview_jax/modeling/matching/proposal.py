"""Propose the points and edges of an object from its pictures, for a person to accept or reject.

The paper offers "automatically extracted feature candidates" (Section 5.1); here they are matched
over all views, triangulated, and joined where segments of the pictures join them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ...argument_checks import errors_at
from ...evaluation import CalibrationEstimate
from ...features import Features, IdealPlane, describe, find
from ...robots import CommandLike
from ..rig_views import AnyCalibration
from ..triangulation import TriangulatedPoints, triangulate_points
from ..view_poses import SeenViews, project_points
from .region import Region
from .segment_support import joined_edges, junction_counts
from .tracks import CornerView, Pairs, Tracks, epipolar_pairs, supported_tracks

MIN_VIEWS = 3
"""Smallest number of views of a proposed point, unless there are only two views."""

MAX_RMS = 1.0
"""Largest RMS reprojection error of a proposed point, px."""

MIN_SIMILARITY = 0.7
"""Smallest mean correlation of the patches of a proposed point."""

SAME_POINT_DISTANCE = 2.5
"""Distance in all common views below which two proposed points are the same, px."""


MATCH_SIGMA = 0.3
"""Standard deviation between matched corners of two views beyond their own errors, px."""

MAX_DISTANCE = 2.0
"""Distance of a corner from its point, px, above which a point's worst corner is left out."""


class ModelProposal(NamedTuple):
    """Proposed points and edges with their evidence, the best supported points first.

    Attributes:
        points: in the world, m.
        covariances: due to the pictures and, if a fit was given, the calibration, m^2.
        corners: index of the corner in each view's features, -1 where it was not found.
        pixels: pixels of these corners, NaN where there is none.
        rms: reprojection error of each point, px.
        similarity: mean correlation of the patches of each point.
        edges: pairs of points that segments join.
        edge_segments: index of the segment in each view's features, -1 where there is none.
        features: of each view.
    """

    points: Float[np.ndarray, "points 3"]
    covariances: Float[np.ndarray, "points 3 3"]
    corners: Int[np.ndarray, "views points"]
    pixels: Float[np.ndarray, "views points 2"]
    rms: Float[np.ndarray, "points"]
    similarity: Float[np.ndarray, "points"]
    edges: Int[np.ndarray, "edges 2"]
    edge_segments: Int[np.ndarray, "views edges"]
    features: tuple[Features, ...]


def propose_model(
    calibration: AnyCalibration,
    poses: CommandLike | None,
    pictures: Sequence[np.ndarray],
    depths: tuple[float, float] = (0.0, np.inf),
    *,
    features: Sequence[Features] | None = None,
    min_views: int | None = None,
    covariance: CalibrationEstimate | None = None,
    region: Region | None = None,
) -> ModelProposal:
    """Match the corners of all views automatically, and propose points and edges.

    Args:
        calibration: the calibrated camera; results are in its world frame, m. `RigViews` for views
            of several cameras.
        poses: poses that the robot reported in each view, `base_from_tool`; None where the robot
            does not matter (`RigViews`).
        depths: smallest and largest distance of the object's points from the cameras, m.
        features: of each picture, if `features.find` was called already.
        min_views: smallest number of views in which a point has to be found; by default 3, or 2 for
            two views.
        covariance: the fit of the calibration, for the points' covariances; None takes the
            calibration as exact.
        region: where points are searched; None for everywhere within `depths`.

    Raises:
        ValueError: fewer than two views, numbers of poses, pictures and features that differ, wrong
            depths, a region with nothing inside, or a picture that `features.find` refuses; the
            view is named.
    """
    # Poses are checked before pictures, which take longer.
    camera_views = SeenViews.of(calibration, poses)
    count = len(camera_views.camera_from_world)
    sizes = camera_views.image_sizes
    needed = _checked(pictures, features, depths, min_views, sizes)
    region = region or Region()
    region.check([str(k) for k in range(count)], sizes)
    picture_features = tuple(features or ())
    for k, picture in enumerate(() if features else pictures):
        with errors_at(f"view {k}"):
            picture_features += (find(picture, camera_views.cameras[k]),)
    views = _corner_views(camera_views, pictures, picture_features)
    # Every two views, since a point may be hidden or missed in any of them.
    all_pairs = [
        epipolar_pairs(views, a, b, depths) for a in range(count) for b in range(a + 1, count)
    ]
    pairs = Pairs(*(np.concatenate(parts) for parts in zip(*all_pairs, strict=True)))
    projected = project_points(camera_views, pairs.points)
    # Before corners are assigned to points, so that points outside take no corners away.
    inside = region.contains(pairs.points, projected)
    pairs = Pairs(*(part[inside] for part in pairs))
    tracks = supported_tracks(views, pairs, projected[:, inside], needed)
    proposal = _proposal(
        calibration, poses, camera_views, picture_features, tracks, needed, covariance
    )
    # The final points differ from the pairs' points: at the border one may have moved out.
    return _within(
        proposal, region.contains(proposal.points, project_points(camera_views, proposal.points))
    )


def _checked(
    pictures: Sequence[np.ndarray],
    features: Sequence[Features] | None,
    depths: tuple[float, float],
    min_views: int | None,
    image_sizes: Int[np.ndarray, "views 2"],
) -> int:
    """Return the smallest number of views of a point; raise a ValueError for wrong arguments."""
    count = len(image_sizes)
    if count < 2:
        raise ValueError(f"poses: expected at least two views, found {count}")
    if len(pictures) != count:
        raise ValueError(f"pictures: expected one for each of {count} poses, found {len(pictures)}")
    if features is not None and len(features) != count:
        raise ValueError(f"features: expected one for each of {count} views, found {len(features)}")
    for k, view_features in enumerate(features or ()):
        width, height = view_features.image_size
        if (width, height) != tuple(image_sizes[k]):
            raise ValueError(
                f"view {k}: features of a picture of {width} x {height} px; "
                f"the camera's have {image_sizes[k][0]} x {image_sizes[k][1]} px"
            )
    if not 0.0 <= depths[0] < depths[1]:
        raise ValueError(f"depths: expected 0 <= near < far, found {depths[0]} and {depths[1]}")
    needed = min(MIN_VIEWS, count) if min_views is None else min_views
    if not 2 <= needed <= count:
        raise ValueError(f"min_views: expected 2 to {count}, found {needed}")
    return needed


def _corner_views(
    views: SeenViews, pictures: Sequence[np.ndarray], view_features: tuple[Features, ...]
) -> list[CornerView]:
    """Return the corners of all views with their rays and their appearance."""
    rotations = views.camera_from_world[:, :3, :3]
    # The mean of the cameras' x axes is perpendicular to the line of sight in all of them.
    reference = rotations[:, 0].mean(axis=0)
    corner_views = []
    for k, (picture, features) in enumerate(zip(pictures, view_features, strict=True)):
        plane = IdealPlane(views.cameras[k])
        # If the features were given, the picture has not been checked yet.
        with errors_at(f"view {k}"):
            look = describe(picture, views.cameras[k], features, rotations[k] @ reference)
        rays = plane.rays(plane.from_pixels(features.corners)) @ rotations[k]
        corner_views.append(
            CornerView(
                features.corners,
                rays,
                views.centres[k],
                look.patches,
                look.directions,
                features.corner_segments[:, 1] >= 0,
                plane.focal_length,
            )
        )
    return corner_views


def _proposal(
    calibration: AnyCalibration,
    poses: CommandLike | None,
    seen: SeenViews,
    view_features: tuple[Features, ...],
    tracks: Tracks,
    needed: int,
    covariance: CalibrationEstimate | None,
) -> ModelProposal:
    """Return the triangulated tracks that agree with their pictures, and the edges between them."""
    corners = tracks.corners
    corners, kept = without_misfits(calibration, poses, view_features, corners, needed)
    similarity = tracks.similarity[kept]
    points = triangulated_tracks(calibration, poses, view_features, corners, covariance)
    rms = track_rms(points)
    # Points that fit badly or look different are not worth a person's time.
    good = points.ok & (rms < MAX_RMS) & (similarity > MIN_SIMILARITY)
    order = np.flatnonzero(good)
    order = order[_distinct(project_points(seen, points.points[order]))]
    # Edges run between junctions: dots and grain on an edge would divide it into pieces.
    ends = np.flatnonzero(junction_counts(view_features, corners[:, order]) >= 2)
    edges, edge_segments = joined_edges(seen, view_features, points.points[order[ends]])
    return ModelProposal(
        points.points[order],
        points.covariance()[order],
        corners[:, order],
        corner_pixels(view_features, corners[:, order]),
        rms[order],
        similarity[order],
        ends[edges],
        edge_segments,
        view_features,
    )


def _within(proposal: ModelProposal, inside: Bool[np.ndarray, "points"]) -> ModelProposal:
    """Return a proposal reduced to the selected points, and the edges between them."""
    number = np.cumsum(inside) - 1
    kept = inside[proposal.edges].all(axis=1)
    return proposal._replace(
        points=proposal.points[inside],
        covariances=proposal.covariances[inside],
        corners=proposal.corners[:, inside],
        pixels=proposal.pixels[:, inside],
        rms=proposal.rms[inside],
        similarity=proposal.similarity[inside],
        edges=number[proposal.edges[kept]],
        edge_segments=proposal.edge_segments[:, kept],
    )


def _distinct(projected: Float[np.ndarray, "views points 2"]) -> Bool[np.ndarray, "points"]:
    """Return which points do not coincide, in every view, with a better point before them."""
    keep = np.ones(projected.shape[1], dtype=bool)
    for k in range(1, len(keep)):
        before = np.flatnonzero(keep[:k])
        gap = np.linalg.norm(projected[:, before] - projected[:, k : k + 1], axis=-1)
        # NaN where either point is not visible.
        largest = np.where(np.isfinite(gap), gap, 0.0).max(axis=0)
        keep[k] = not (np.isfinite(gap).any(axis=0) & (largest < SAME_POINT_DISTANCE)).any()
    return keep


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
