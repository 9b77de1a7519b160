"""Estimate a target's poses from points that a depth sensor measured, and the sensor's bias.

A depth sensor, or a camera with structured light, measures points of a target in its own frame:
exactly across the line of sight, less exactly along it, and often too near or too far by a few
per cent. The target's known size tells this bias without any robot. All poses, scale and offset of
the depth are fitted together, each coordinate weighted by its estimated noise; points that
contradict the others have no weight.

    corrected point = measured point (scale z + offset) / z

With the robot's poses (`MeasuredPoses.dataset`) they are what `fit_poses` needs. NumPy code: a few
steps for all views at once.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from ..dataset import (
    TYPICAL_OFFSET_STD,
    TYPICAL_SCALE_STD,
    DepthSensor,
    PoseDataset,
    checked_view_ids,
)
from ..geometry import (
    PoseLike,
    host_cross_matrices,
    host_exponentials,
    host_nearest_pose,
    host_transformed,
)
from ..robots import SerialArm
from ..runtime.array_namespace import to_device

MIN_POINTS = 4
"""Smallest number of points of a view whose pose is fitted."""

MIN_SPREAD = 0.05
"""Smallest extent of a view's points in their second direction, over their extent in the first."""

MAX_STEPS = 50
"""Largest number of steps of the fit."""

CONVERGED = 1e-8
"""Relative change of the noise at which the fit has converged."""

MIN_SIGMA = 1e-6
"""Smallest standard deviation of a measured point, m.

No depth sensor is better. Points without any error, across the line of sight or in both
directions, would otherwise determine everything without bound.
"""

REJECTED_SIGMAS = 4.0
"""Distance from its fitted place, in standard deviations, from which a point is left out."""


class MeasuredPoses(NamedTuple):
    """Poses of a target from measured points, and the bias and the noise of the sensor.

    Attributes:
        camera_from_world: pose of the target in each view `(views, 4, 4)`, m; NaN where too few
            points were measured.
        covariance: of each pose `(views, 6, 6)` by the points' noise, for a known sensor: of its
            translation (m) and of its rotation vector (rad), both in the camera's axes.
        sensor_changes: change of each pose by the sensor's scale and offset `(views, 6, 2)`.
        sensor: bias and noise. The standard deviations of the bias are close to their priors where
            a flat target is seen from one distance and without tilt.
        residuals: corrected minus fitted points `(views, points, 3)`, m; NaN where not measured.
        used: points that were measured and not left out.
        converged: whether the noise, and the choice of points, settled.
    """

    camera_from_world: Float[np.ndarray, "views 4 4"]
    covariance: Float[np.ndarray, "views 6 6"]
    sensor_changes: Float[np.ndarray, "views 6 2"]
    sensor: DepthSensor
    residuals: Float[np.ndarray, "views points 3"]
    used: Bool[np.ndarray, "views points"]
    converged: bool

    @property
    def whole_covariance(self) -> Float[np.ndarray, "views 6 6"]:
        """The covariance of each pose alone, with the uncertainty of the sensor's bias."""
        changes = self.sensor_changes
        return self.covariance + changes @ self.sensor.covariance @ changes.swapaxes(1, 2)

    @property
    def point_rms(self) -> Float[np.ndarray, "views"]:
        """The RMS distance of the used points from the fitted target in each view, m; or NaN."""
        squares = np.where(self.used, np.sum(np.square(self.residuals), axis=2), 0.0).sum(axis=1)
        counts = self.used.sum(axis=1)
        return np.where(counts, np.sqrt(squares / np.maximum(counts, 1)), np.nan)

    def dataset(
        self,
        base_from_tool: PoseLike | None,
        mount: str = "eye_in_hand",
        view_ids: Sequence[str | int] | None = None,
        masked_views: Sequence[tuple[str, str]] = (),
        joints: np.ndarray | Array | None = None,
        arm: SerialArm | None = None,
    ) -> PoseDataset:
        """Return the poses with the robot's, as `fit_poses` takes them.

        Args:
            base_from_tool, mount, view_ids, masked_views, joints, arm: as in
                `PoseDataset.from_poses`.

        Raises:
            ValueError: as of `PoseDataset.from_poses`.

        For example:

            >>> seen = sv.geometry.host_matrices(truth.camera_from_world(scene.base_from_tool))
            >>> target = np.asarray(data.points)[0]
            >>> points = target @ seen[:, :3, :3].swapaxes(1, 2) + seen[:, None, :3, 3]
            >>> noisy = points + 1e-4 * np.random.default_rng(0).normal(size=points.shape)
            >>> pairs = sv.depth.poses_from_points(noisy, target).dataset(data.base_from_tool)
            >>> print(pairs.view_count, pairs.states_covariance)
            8 True
        """
        poses = self.camera_from_world
        ids = checked_view_ids(view_ids, len(poses))
        measured = np.isfinite(poses[:, 0, 0])
        reasons = {
            view: f"expected {MIN_POINTS} measured points or more that are not in one line"
            for view, is_measured in zip(ids, measured, strict=True)
            if not is_measured
        } | dict(masked_views)
        data = PoseDataset.from_poses(
            base_from_tool, poses, mount, ids, list(reasons.items()), joints, arm
        ).with_covariance(self.covariance)
        changes = to_device(np.where(measured[:, None, None], self.sensor_changes, 0.0))
        return dataclasses.replace(
            data,
            sensor=self.sensor,
            sensor_changes=changes,
            point_rms=to_device(self.point_rms),
        )


def poses_from_points(
    points_in_camera: Float[np.ndarray, "views _ 3"], target_points: Float[np.ndarray, "_ 3"]
) -> MeasuredPoses:
    """Return the poses of a target whose points a depth sensor measured.

    A target that is 1 % larger than stated looks like a sensor whose depths are 1 % too large.

    Args:
        points_in_camera: measured points in the sensor's frame `(views, points, 3)`, z along its
            optical axis, m; NaN where a point was not measured.
        target_points: the same points in the target's frame `(points, 3)`, m.

    Raises:
        ValueError: arrays that do not fit, points behind the sensor, points in another unit, or no
            view with enough points; the message says what was found.

    For example:

        >>> seen = sv.geometry.host_matrices(truth.camera_from_world(scene.base_from_tool))
        >>> target = np.asarray(data.points)[0]
        >>> points = target @ seen[:, :3, :3].swapaxes(1, 2) + seen[:, None, :3, 3]
        >>> measured = sv.depth.poses_from_points(points / 1.02, target)
        >>> print(f"{measured.sensor.scale:.3f}")
        1.020
        >>> print(f"{sv.depth.poses_from_points(points, target / 1.01).sensor.scale:.3f}")
        0.990
    """
    points, target = _checked(points_in_camera, target_points)
    seen = np.asarray(np.isfinite(points).all(axis=2))
    whole = _has_enough(target, seen)
    if not whole.any():
        raise ValueError(
            f"points_in_camera: expected a view with {MIN_POINTS} points or more that are not in "
            f"one line; the most in a view are {int(seen.sum(axis=1).max(initial=0))}"
        )
    _refuse_other_unit(points[whole], target, seen[whole])
    fit = _fitted(points[whole], target, seen[whole])

    def of_all_views(values: np.ndarray, missing: float = np.nan) -> np.ndarray:
        every = np.full((len(points), *values.shape[1:]), missing, dtype=values.dtype)
        every[whole] = values
        return every

    return fit._replace(
        camera_from_world=of_all_views(fit.camera_from_world),
        covariance=of_all_views(fit.covariance),
        sensor_changes=of_all_views(fit.sensor_changes),
        residuals=of_all_views(fit.residuals),
        used=of_all_views(fit.used, missing=False),
    )


def _checked(
    points_in_camera: Float[np.ndarray, "views _ 3"], target_points: Float[np.ndarray, "_ 3"]
) -> tuple[Float[np.ndarray, "views points 3"], Float[np.ndarray, "points 3"]]:
    """Return the arrays, or raise a ValueError for wrong shapes and impossible points."""
    points, target = np.array(points_in_camera, float), np.array(target_points, float)
    if points.shape[1:] != target.shape:
        raise ValueError(
            f"points_in_camera: expected shape (views, {len(target)}, 3) for {len(target)} target "
            f"points, found {points.shape}"
        )
    if not np.isfinite(target).all():
        raise ValueError("target_points: expected finite numbers, found NaN or infinity")
    behind = np.argwhere(points[..., 2] <= 0.0)
    if len(behind):
        view, point = behind[0]
        raise ValueError(
            f"points_in_camera: view {view}, point {point}: expected a depth above 0, found "
            f"{points[view, point, 2]:.4g} m; z is along the optical axis, and NaN says that a "
            f"point was not measured{_axes_hint(points)}"
        )
    return points, target


def _axes_hint(points: Float[np.ndarray, "views points 3"]) -> str:
    """Return which other axes the measured points seem to have, as a question, or nothing."""
    seen = points[np.isfinite(points).all(axis=2)]
    ahead = (seen > 0.0).mean(axis=0)
    if ahead[2] < 0.05:
        return (
            ". Nearly all depths are below 0: are these OpenGL's axes, y up and z backwards? "
            "Then give (x, -y, -z)"
        )
    if ahead[0] > 0.95:
        return (
            ". Nearly all x are above 0: are these the axes of a robot's body in ROS, x forwards, "
            "y to the left and z up? Then give (-y, -z, x), or take the optical frame"
        )
    return ""


def _has_enough(
    target: Float[np.ndarray, "points 3"], seen: Bool[np.ndarray, "views points"]
) -> Bool[np.ndarray, "views"]:
    """Return which views show enough points, in two directions at least."""
    weight = seen / np.maximum(seen.sum(axis=1, keepdims=True), 1)
    middle = weight @ target
    centred = np.where(seen[..., None], target - middle[:, None], 0.0)
    extents = np.linalg.svd(centred, compute_uv=False) if target.size else np.zeros((len(seen), 2))
    spread = extents[:, 1] > MIN_SPREAD * np.maximum(extents[:, 0], 1e-300)
    return (seen.sum(axis=1) >= MIN_POINTS) & spread


def _refuse_other_unit(
    points: Float[np.ndarray, "views points 3"],
    target: Float[np.ndarray, "points 3"],
    seen: Bool[np.ndarray, "views points"],
) -> None:
    """Raise a ValueError where the target's size in the measured points is far from the stated."""
    ratios = []
    for seen_points, is_seen in zip(points, seen, strict=True):
        measured, true = seen_points[is_seen], target[is_seen]
        ratios.append(
            np.linalg.norm(measured - np.median(measured, axis=0), axis=1).sum()
            / np.linalg.norm(true - np.median(true, axis=0), axis=1).sum()
        )
    ratio = float(np.median(ratios))
    if not 0.5 < ratio < 2.0:
        raise ValueError(
            f"points_in_camera: the target seems {float(f'{ratio:.3g}'):g} times its size: are the "
            "points in metres (in a folder: is their unit as stated), and in the target's order?"
        )


def _fitted(
    points: Float[np.ndarray, "views points 3"],
    target: Float[np.ndarray, "points 3"],
    seen: Bool[np.ndarray, "views points"],
) -> MeasuredPoses:
    """Return the fit of views that all have enough points."""
    measured = np.where(seen[..., None], points, [0.0, 0.0, 1.0])
    poses = _aligned(measured, target, seen)
    rays = measured / np.linalg.norm(measured, axis=2, keepdims=True)
    frames = _frames_of(rays)
    # Derivatives of the corrected points by scale and offset.
    by_sensor = np.stack([measured, measured / measured[..., 2:]], axis=-1)
    sensor, used = np.array([1.0, 0.0]), seen
    solved = None
    prior = np.array([TYPICAL_SCALE_STD, TYPICAL_OFFSET_STD]) ** -2
    residuals, in_ray, jacobian = _linearised(poses, target, by_sensor, sensor, frames)
    # Robust: half of the points may be wrong before any noise is known.
    size = np.median(np.linalg.norm(residuals[used], axis=1)) / np.sqrt(2.366)
    sigma, has_converged = np.full(2, max(float(size), MIN_SIGMA)), False
    for _ in range(MAX_STEPS):
        used = seen & (_distances(in_ray, sigma) < REJECTED_SIGMAS)
        # A view in which most points are wrong would keep too few: it keeps all of them.
        used = np.where(_has_enough(target, used)[:, None], used, seen)
        solved = _solved(in_ray, jacobian, used, sigma, prior, sensor - [1.0, 0.0])
        poses = host_exponentials(solved.step) @ poses
        sensor = sensor + solved.sensor_step
        residuals, in_ray, jacobian = _linearised(poses, target, by_sensor, sensor, frames)
        squares = (np.where(used[..., None], in_ray, 0.0) ** 2).sum(axis=(0, 1))
        new = np.sqrt([squares[:2].sum() / solved.freedom[0], squares[2] / solved.freedom[1]])
        new = np.maximum(new, MIN_SIGMA)
        has_converged = bool(np.abs(new / sigma - 1.0).max() < CONVERGED)
        sigma = new
        if has_converged:
            break
    assert solved is not None
    scale_std, offset_std = np.sqrt(np.diag(solved.sensor_covariance))
    # The twist (v, w) from the left moves the target's origin t by v + w x t.
    at_target = np.tile(np.eye(6), (len(poses), 1, 1))
    at_target[:, :3, 3:] = -host_cross_matrices(poses[:, :3, 3])
    return MeasuredPoses(
        poses,
        at_target @ solved.covariance @ at_target.swapaxes(1, 2),
        at_target @ solved.sensor_changes,
        DepthSensor(
            float(sensor[0]),
            float(sensor[1]),
            float(scale_std),
            float(offset_std),
            float(solved.sensor_covariance[0, 1] / (scale_std * offset_std)),
            float(sigma[0]),
            float(sigma[1]),
        ),
        np.where(seen[..., None], residuals, np.nan),
        used,
        has_converged,
    )


def _aligned(
    measured: Float[np.ndarray, "views points 3"],
    target: Float[np.ndarray, "points 3"],
    seen: Bool[np.ndarray, "views points"],
) -> Float[np.ndarray, "views 4 4"]:
    """Return the poses that align the target with the measured points (Kabsch).

    Points far from the others are left out in three rounds.
    """
    poses = np.tile(np.eye(4), (len(measured), 1, 1))
    for k, (seen_points, is_seen) in enumerate(zip(measured, seen, strict=True)):
        kept = is_seen
        for _ in range(3):
            poses[k] = host_nearest_pose(target[kept], seen_points[kept])
            distance = np.linalg.norm(seen_points - host_transformed(poses[k], target), axis=1)
            limit = 3.0 * np.median(distance[is_seen])
            fewer = is_seen & (distance <= limit)
            kept = fewer if fewer.sum() >= MIN_POINTS else kept
    return poses


def _frames_of(rays: Float[np.ndarray, "views points 3"]) -> Float[np.ndarray, "views points 3 3"]:
    """Return orthonormal axes for each ray as rows: two across it, then the ray."""
    # Rays are near z, never along x.
    x = np.array([1.0, 0.0, 0.0]) - rays[..., :1] * rays
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(rays, x), rays], axis=-2)


def _linearised(
    poses: Float[np.ndarray, "views 4 4"],
    target: Float[np.ndarray, "points 3"],
    by_sensor: Float[np.ndarray, "views points 3 2"],
    sensor: Float[np.ndarray, "2"],
    frames: Float[np.ndarray, "views points 3 3"],
) -> tuple[
    Float[np.ndarray, "views points 3"],
    Float[np.ndarray, "views points 3"],
    Float[np.ndarray, "views points 3 8"],
]:
    """Return residuals, also along the rays' axes, and derivatives by a twist and the sensor."""
    placed = host_transformed(poses, target)
    residuals = by_sensor @ sensor - placed
    # d(placed) = v + w x p for the twist (v, w) of the pose, from the left.
    eye = np.broadcast_to(-np.eye(3), (*placed.shape, 3))
    # At the fitted points: derivatives at measured ones share their noise, which pulls the scale
    # towards smaller values.
    ray = placed / placed[..., 2:]
    by_fitted = np.stack([(placed - sensor[1] * ray) / sensor[0], ray], axis=-1)
    jacobian = np.concatenate([eye, host_cross_matrices(placed), by_fitted], axis=-1)
    return residuals, (frames @ residuals[..., None])[..., 0], frames @ jacobian


def _distances(
    in_ray: Float[np.ndarray, "views points 3"], sigma: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "views points"]:
    """Return the distance of each point from its fitted place, in standard deviations."""
    return np.linalg.norm(in_ray / [sigma[0], sigma[0], sigma[1]], axis=-1)


class _Solved(NamedTuple):
    """A Gauss-Newton step of poses and sensor.

    Attributes:
        step: a twist of each pose.
        sensor_step: of scale and offset.
        covariance: of each pose's twist, for a known sensor.
        sensor_covariance: of scale and offset.
        sensor_changes: change of each pose's twist by scale and offset.
        freedom: degrees of freedom across and along the rays.
    """

    step: Float[np.ndarray, "views 6"]
    sensor_step: Float[np.ndarray, "2"]
    covariance: Float[np.ndarray, "views 6 6"]
    sensor_covariance: Float[np.ndarray, "2 2"]
    sensor_changes: Float[np.ndarray, "views 6 2"]
    freedom: Float[np.ndarray, "2"]


def _solved(
    in_ray: Float[np.ndarray, "views points 3"],
    jacobian: Float[np.ndarray, "views points 3 8"],
    used: Bool[np.ndarray, "views points"],
    sigma: Float[np.ndarray, "2"],
    prior: Float[np.ndarray, "2"],
    off: Float[np.ndarray, "2"],
) -> _Solved:
    """Return the Gauss-Newton step of poses and sensor.

    Args:
        in_ray: residuals along the rays' axes.
        jacobian: their derivatives.
        used: points that count.
        sigma: standard deviations across and along the rays.
        prior: inverse variances of scale and offset.
        off: their distance from the priors' means.
    """
    weight = np.array([sigma[0], sigma[0], sigma[1]]) ** -2 * used[..., None]
    gram = np.einsum("vpci,vpc,vpcj->vij", jacobian, weight, jacobian)
    gradient = np.einsum("vpci,vpc,vpc->vi", jacobian, weight, in_ray)
    # The poses are eliminated: A - B^T D^-1 B, each view's D of its own pose.
    D, B, A = gram[:, :6, :6], gram[:, :6, 6:], gram[:, 6:, 6:]
    inverse = np.linalg.inv(D)
    gain = inverse @ B
    reduced = A.sum(axis=0) + np.diag(prior) - (B.swapaxes(1, 2) @ gain).sum(axis=0)
    right = gradient[:, 6:].sum(axis=0) + prior * off
    right = right - (gain.swapaxes(1, 2) @ gradient[:, :6, None]).sum(axis=0)[:, 0]
    sensor_covariance = np.linalg.inv(reduced)
    sensor_step = -sensor_covariance @ right
    step = -(inverse @ gradient[:, :6, None])[..., 0] - gain @ sensor_step
    covariance = inverse + gain @ sensor_covariance @ gain.swapaxes(1, 2)
    # The fit takes up its leverage of each residual; the rest tells the noise.
    whole = np.zeros((len(gram), 8, 8))
    whole[:, :6, :6], whole[:, :6, 6:] = covariance, -gain @ sensor_covariance
    whole[:, 6:, :6] = whole[:, :6, 6:].swapaxes(1, 2)
    whole[:, 6:, 6:] = sensor_covariance
    leverage = np.einsum("vpci,vij,vpcj->vpc", jacobian, whole, jacobian) * weight
    taken, count = leverage.sum(axis=(0, 1)), int(used.sum())
    freedom = np.array([2 * count - taken[:2].sum(), count - taken[2]])
    return _Solved(step, sensor_step, inverse, sensor_covariance, -gain, np.maximum(freedom, 1.0))
