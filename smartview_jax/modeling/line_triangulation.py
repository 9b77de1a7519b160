"""Triangulate straight lines from segments of two or more views whose ends do not correspond.

Every segment spans a plane with its camera's centre, and the line lies in all these planes. The
initial line is their intersection by linear least squares; Gauss-Newton then minimises the
distances of the segments' ends from the picture of the line, with the real lens. A line in the
epipolar plane of its views has only one plane: any line in this plane explains the pictures, and
the line is reported as failed.

Reference: Hartley and Zisserman, Multiple view geometry in computer vision, 2004, section 8.1; the
four numbers of a line follow Bartoli and Sturm, Structure-from-motion using lines, 2005.
"""

import dataclasses
from typing import NamedTuple, Unpack

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..cameras import unit_rays
from ..evaluation import root_mean_square
from ..robots import CommandLike
from ..runtime.array_namespace import to_device
from .calibration_uncertainty import CalibrationUncertainty, UncertaintyOptions
from .estimated_features import MAX_RELATIVE_STD, EstimatedFeatures, PointStatus
from .line_jacobians import Lines, line_jacobians
from .point_estimation import CONVERGED_DECREMENT, MAX_STEPS
from .rig_views import AnyCalibration
from .triangulation import CLICK_SIGMA
from .view_poses import SeenViews, checked_sigma, padded_count, padded_to

MIN_SEGMENT_LENGTH = 2.0
"""Shortest segment, px, that has a direction."""

MIN_PLANE_SPREAD = 1e-14
"""Smallest ratio of the second to the largest eigenvalue, in the scatter of the planes' unit
normals, for planes that differ: below it, at angles of some 1e-7 rad, their intersection is
rounding error."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TriangulatedLines(EstimatedFeatures):
    """Triangulated lines with their errors by cause; failed lines (see `status`) are NaN.

    Attributes:
        lines: a point and the unit direction of each; the point is in the middle of `ends`.
        ends: ends of the part of each line that at least one view saw, m.
    """

    lines: Lines
    ends: Float[np.ndarray, "lines 2 3"]

    @property
    def rms(self) -> float:
        """The root mean square distance of segments' ends from their lines, px."""
        return root_mean_square(self.residuals[:, self.ok])


def triangulate_lines(
    calibration: AnyCalibration,
    poses: CommandLike | None,
    segments: np.ndarray | Array,
    visible: np.ndarray | Array | None = None,
    *,
    pixel_sigma: float | np.ndarray = CLICK_SIGMA,
    **uncertainty: Unpack[UncertaintyOptions],
) -> TriangulatedLines:
    """Triangulate straight lines from their segments in two or more views.

    A line that cannot be triangulated is NaN, and `status` and `failures` name the reason.

    Args:
        calibration: the calibrated camera; results are in its world frame, in true metres.
            `RigViews` for views of several cameras.
        poses: poses that the robot reported in each view, `base_from_tool`; None where the robot
            does not matter (`RigViews`).
        segments: `(views, lines, 2, 2)`, both ends of each line's segment, px. The ends in
            different views need not be the same points of the line.
        visible: `(views, lines)`, where each has a segment; by default where it is finite.
        pixel_sigma: standard deviation of an end, px, as one number or `(views, lines)`; or
            covariances of the ends `(views, lines, 2, 2, 2)`, px^2.
        uncertainty: `covariance` and `noise`, as in `triangulate_points`.

    Raises:
        ValueError: arrays whose shapes do not match, ends outside the picture, a segment without
            length, or as in `triangulate_points`.
    """
    views = SeenViews.of(calibration, poses)
    measured, visible = views.checked_segments(segments, visible)
    _check_lengths(measured, visible)
    covariances = end_covariances(pixel_sigma, visible.shape)
    rays, visible = world_rays(views, measured, visible)
    start = _plane_intersections(views, rays, visible)
    estimate = _refine(views, start, measured, covariances, visible)
    status = _status(views, rays, visible, start, estimate)
    ok = status == PointStatus.OK
    kept = Lines(
        *(np.where(ok[:, None], a, b) for a, b in zip(estimate.lines, start.lines, strict=True))
    )
    ends = _seen_part(views, rays, visible, kept)
    lines = Lines(ends.mean(axis=1), kept.directions)
    # The four numbers refer to the middle of the visible part, where they are least correlated.
    known = CalibrationUncertainty.of(views, calibration, **uncertainty)
    local = line_jacobians(views, lines, measured, covariances, visible)
    weighted = local.by_line * local.weights[..., None] ** 2
    normal = np.einsum("vlei,vlej->lij", weighted, local.by_line)
    normal[~ok] = np.eye(4)
    sensitivity = -np.einsum("vlei,vlej->vlij", weighted, local.by_view)
    jacobian = np.linalg.solve(normal, known.propagate(sensitivity))
    where = ok[:, None, None]
    return TriangulatedLines(
        lines=Lines(*(np.where(ok[:, None], array, np.nan) for array in lines)),
        ends=np.where(where, ends, np.nan),
        picture_covariance=np.where(where, np.linalg.inv(normal), np.nan),
        calibration_jacobian=np.where(where, jacobian, np.nan),
        calibration_covariance=known.covariance,
        calibration_names=known.names,
        residuals=np.where((visible & ok)[..., None], local.distances, np.nan),
        status=status,
    )


def end_covariances(
    pixel_sigma: float | np.ndarray, shape: tuple[int, int]
) -> Float[np.ndarray, "views lines 2 2 2"]:
    """Return the covariances of segments' ends, from any form of `pixel_sigma`."""
    sigma = checked_sigma(pixel_sigma, shape, (2, 2, 2))
    if sigma.ndim == 5:
        return sigma
    # Equal in all directions, since only the part across the line counts.
    variance = np.broadcast_to(sigma, shape)[..., None, None, None] ** 2
    return variance * np.broadcast_to(np.eye(2), (*shape, 2, 2, 2))


def _check_lengths(
    segments: Float[np.ndarray, "views lines 2 2"], seen: Bool[np.ndarray, "views lines"]
) -> None:
    """Raise if a segment is too short to have a direction."""
    length = np.linalg.norm(np.diff(segments, axis=2)[:, :, 0], axis=-1)
    wrong = np.argwhere(seen & ~(length >= MIN_SEGMENT_LENGTH))
    if len(wrong):
        view, line = wrong[0]
        raise ValueError(
            f"segments: view {view}, line {line}: a segment of {length[view, line]:.2g} px has no "
            f"direction; at least {MIN_SEGMENT_LENGTH:g} px are expected"
        )


def world_rays(
    views: SeenViews,
    segments: Float[np.ndarray, "views lines 2 2"],
    seen: Bool[np.ndarray, "views lines"],
) -> tuple[Float[np.ndarray, "views lines 2 3"], Bool[np.ndarray, "views lines"]]:
    """Return the rays of all ends in the world, and where both ends are within the lens."""
    shape = (len(views.padded), padded_count(seen.shape[1]))
    safe = np.where(seen[..., None, None], segments, 0.0)
    rays, valid = unit_rays(views.camera_for(shape[0]), to_device(padded_to(safe, shape)))
    # A segment with one end outside the lens is not used at all.
    used = seen & np.asarray(valid)[: len(seen), : seen.shape[1]].all(axis=-1)
    rays = np.asarray(rays)[: len(seen), : seen.shape[1]]
    rays = np.where(used[..., None, None], rays, 0.0)
    return np.einsum("vji,vlej->vlei", views.camera_from_world[:, :3, :3], rays), used


class _Start(NamedTuple):
    """The lines nearest to all planes of their segments, and whether these are all one plane."""

    lines: Lines
    in_one_plane: Bool[np.ndarray, "lines"]


def _plane_intersections(
    views: SeenViews,
    rays: Float[np.ndarray, "views lines 2 3"],
    seen: Bool[np.ndarray, "views lines"],
) -> _Start:
    """Return the initial lines."""
    normals = np.cross(rays[:, :, 0], rays[:, :, 1])
    # Unit normals; otherwise a long segment would have too much weight in the start.
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0.0)
    # The direction is perpendicular to all normals: the last right singular vector.
    stacked = np.moveaxis(normals, 0, 1)
    scatter = np.einsum("lvi,lvj->lij", stacked, stacked)
    values, vectors = np.linalg.eigh(scatter)
    directions = vectors[:, :, 0]
    # The point: n_i . (p - c_i) = 0 for all planes, and d . (p - m) = 0 for the cameras' middle m.
    offsets = np.einsum("vli,vi->lv", normals, views.centres)
    middle = directions @ views.centres.mean(axis=0)
    rows = np.concatenate([stacked, directions[:, None]], axis=1)
    right = np.concatenate([offsets, middle[:, None]], axis=1)
    points = np.einsum("lij,lj->li", np.linalg.pinv(rows), right)
    # Then move the point to the middle of the visible part, where turns and shifts are least
    # correlated.
    lines = Lines(points, directions)
    points = _seen_part(views, rays, seen, lines).mean(axis=1)
    in_one_plane = ~(values[:, 1] > MIN_PLANE_SPREAD * values[:, 2])
    return _Start(Lines(points, directions), in_one_plane)


class _Estimate(NamedTuple):
    """The lines of least squares, their normal matrices, and whether the steps did not converge."""

    lines: Lines
    information: Float[np.ndarray, "lines 4 4"]
    failed: Bool[np.ndarray, "lines"]


def _refine(
    views: SeenViews,
    start: _Start,
    segments: Float[np.ndarray, "views lines 2 2"],
    covariances: Float[np.ndarray, "views lines 2 2 2"],
    seen: Bool[np.ndarray, "views lines"],
) -> _Estimate:
    # All lines step together, each with its own damping; for so few of them a loop within a
    # compiled program does not pay.
    lines, enough = start.lines, seen.sum(axis=0) >= 2
    damping = np.full(len(enough), 1e-6)
    cost, decrement = np.full(len(enough), np.inf), np.full(len(enough), np.inf)
    normal = np.tile(np.eye(4), (len(enough), 1, 1))
    gradient, trial = np.zeros((len(enough), 4)), lines
    for _ in range(MAX_STEPS):
        at = line_jacobians(views, trial, segments, covariances, seen)
        r, J = at.distances * at.weights, at.by_line * at.weights[..., None]
        new_cost = np.sum(r**2, axis=(0, 2))
        better = (new_cost <= cost) & np.isfinite(J).all(axis=(0, 2, 3))
        cost = np.where(better, new_cost, cost)
        lines = Lines(*(np.where(better[:, None], a, b) for a, b in zip(trial, lines, strict=True)))
        normal[better] = np.einsum("vlei,vlej->lij", J, J)[better]
        gradient[better] = np.einsum("vlei,vle->li", J, r)[better]
        damping = np.where(better, np.maximum(0.1 * damping, 1e-12), 100.0 * damping)
        decrement = np.einsum("li,li->l", gradient, _solve(normal, gradient, 0.0 * damping))
        if np.all((decrement <= CONVERGED_DECREMENT) | ~enough):
            break
        trial = lines.moved(-_solve(normal, gradient, damping))
    return _Estimate(lines, normal, ~(decrement <= CONVERGED_DECREMENT))


def _solve(
    normal: Float[np.ndarray, "lines 4 4"],
    right: Float[np.ndarray, "lines 4"],
    damping: Float[np.ndarray, "lines"],
) -> Float[np.ndarray, "lines 4"]:
    """Solve the damped normal equations of all lines; singular ones by pseudo-inverse."""
    scaled, scale = _with_unit_diagonal(normal)
    scaled = scaled + damping[:, None, None] * np.eye(4)
    inverse = np.linalg.pinv(scaled, rcond=1e-13, hermitian=True)
    return np.einsum("lij,lj->li", inverse, right / scale) / scale


def _with_unit_diagonal(
    normal: Float[np.ndarray, "lines 4 4"],
) -> tuple[Float[np.ndarray, "lines 4 4"], Float[np.ndarray, "lines 4"]]:
    """Return normal matrices in units that make their diagonals one, and these units."""
    scale = np.sqrt(np.einsum("lii->li", normal))
    scale = np.where(scale > 0.0, scale, 1.0)
    return normal / (scale[:, :, None] * scale[:, None]), scale


def _status(
    views: SeenViews,
    rays: Float[np.ndarray, "views lines 2 3"],
    seen: Bool[np.ndarray, "views lines"],
    start: _Start,
    estimate: _Estimate,
) -> Int[np.ndarray, "lines"]:
    """Return a `PointStatus` for every line."""
    enough, information = seen.sum(axis=0) >= 2, estimate.information
    # The line's own distance from a camera, and the signed depth of the points that are seen.
    parameters, depths = _nearest_on_lines(views, rays, estimate.lines)
    visible_depths = np.where(seen[..., None], depths, np.nan)
    behind = np.nanmin(np.where(enough[None, :, None], visible_depths, 1.0), axis=(0, 2)) <= 0.0
    distance = np.abs(np.nanmean(np.where(enough[None, :, None], visible_depths, 1.0), axis=(0, 2)))
    # Two numbers turn the line about the point and two shift it: at a distance t from the point, in
    # the middle of the visible part, the shift has the covariance of u + t w.
    middle = np.sum(np.where(seen[..., None], parameters, 0.0), axis=(0, 2)) / np.maximum(
        2.0 * seen.sum(axis=0), 1.0
    )
    # u + t w: the rows of the two shifts and, t times, of the two turns.
    shift = np.concatenate(
        [np.tile(np.eye(2), (len(middle), 1, 1)), middle[:, None, None] * np.eye(2)], axis=2
    )
    correlation, scale = _with_unit_diagonal(information)
    values, vectors = np.linalg.eigh(correlation)
    # An eigenvalue at rounding error means that nothing determines its direction.
    roots = vectors / np.sqrt(np.maximum(values, 1e-14))[:, None] / scale[:, :, None]
    variance = np.sum((shift @ roots) ** 2, axis=(1, 2))
    # For a single plane the estimate is an arbitrary line in it, possibly through a camera's
    # centre, so that neither the variance nor the depth means anything.
    degenerate = start.in_one_plane | ~(variance < (MAX_RELATIVE_STD * distance) ** 2)
    status = np.where(estimate.failed, PointStatus.NOT_CONVERGED, PointStatus.OK)
    status = np.where(behind, PointStatus.BEHIND_CAMERA, status)
    status = np.where(degenerate, PointStatus.EPIPOLAR_PLANE, status)
    return np.where(enough, status, PointStatus.TOO_FEW_VIEWS)


def _nearest_on_lines(
    views: SeenViews, rays: Float[np.ndarray, "views lines 2 3"], lines: Lines
) -> tuple[Float[np.ndarray, "views lines 2"], Float[np.ndarray, "views lines 2"]]:
    """Return where on each line each end's ray comes nearest, and how far along the ray, m."""
    # min |p + t d - c - s q|:  with w = p - c,
    #   t = ((q.d)(q.w) - d.w) / (1 - (q.d)^2),   s = q.w + t q.d
    w = lines.points[None] - views.centres[:, None]
    qd = np.einsum("vlei,li->vle", rays, lines.directions)
    qw = np.einsum("vlei,vli->vle", rays, w)
    dw = np.einsum("li,vli->vl", lines.directions, w)[..., None]
    t = (qd * qw - dw) / np.maximum(1.0 - qd**2, 1e-12)
    return t, qw + t * qd


def _seen_part(
    views: SeenViews,
    rays: Float[np.ndarray, "views lines 2 3"],
    seen: Bool[np.ndarray, "views lines"],
    lines: Lines,
) -> Float[np.ndarray, "lines 2 3"]:
    """Return the ends of the part of each line that at least one view saw."""
    t, _ = _nearest_on_lines(views, rays, lines)
    low = np.where(seen[..., None], t, np.inf).min(axis=(0, 2), initial=np.inf)
    high = np.where(seen[..., None], t, -np.inf).max(axis=(0, 2), initial=-np.inf)
    # A line that no view sees has no such part; its status says so.
    limits = np.nan_to_num(np.stack([low, high], axis=1), posinf=0.0, neginf=0.0)
    return lines.points[:, None] + limits[..., None] * lines.directions[:, None]
