"""Find gross errors before the joint fit, using a free pose for every view instead of the robot's.

With a free pose, an outlying point stands out, because the view's other points determine the pose,
whatever the robot reported. The poses are fitted with a robust loss, and points beyond a chi-square
gate are left out; then views whose pose is inconsistent with a common hand-eye transform. Smaller
disagreement can only be judged with the variance components (`influence.py`).
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar, cast

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float

from ..calibration import ONE_ARM_MOUNTS, Calibration
from ..data_checks import find_consistent_views, median_reprojection_errors
from ..dataset import Dataset, Observations, medians_by_view, view_residuals
from ..engine import (
    Cauchy,
    Noise,
    Prior,
    StructuredLM,
    build_problem,
    robust_variance,
    solve,
    solve_with_estimated_sigma,
    squared_residuals,
    updated_sigma,
    variance_factor,
    with_free_camera_poses,
    with_pixel_sigma,
)
from ..fit_result import Rejection
from ..geometry import host_matrices, host_transforms
from ..runtime.array_namespace import AnyArray
from ..runtime.blas_threads import on_one_blas_thread
from ..runtime.modules import with_fields
from ..staged import MAX_UNCHECKED_POINTS, estimate_view_poses
from ..variance import encompassing_field

_Data = TypeVar("_Data", bound=Dataset)

MAX_SQUARED_RESIDUAL = 144.0
"""The squared whitened residual from a view's own best pose beyond which a point is left out.

It is far above the gate of the fit itself, by which one corner in sixty of a good real data set
would be rejected; half of this value would reject corners in pictures of a lens that is slightly
more complex than its model.
"""

MAX_SIGMA_FITS = 8
"""The largest number of fits, each with the pixel sigma estimated in the fit before."""

SIGMA_TOLERANCE = 0.1
"""The relative change of the pixel sigma below which the fits have converged."""

MAX_MEDIAN_RATIO, MAX_MEDIAN_RESIDUAL = 10.0, 20.0
"""The median residual of a view under the start's chain above which its pose is estimated.

The first is relative to the median view, the second in px; both must be exceeded.
"""

MAX_OUTLIER_FRACTION = 0.5
"""The fraction of a view's points outside the gate above which the whole view is left out."""

LOOSE_SOLVER = StructuredLM(rtol=1e-3)
"""The solver of the fits with free poses, with a loose tolerance.

Poses accurate to a thousandth of the cost identify outlying points just as well.
"""


@on_one_blas_thread
def remove_gross_errors(
    data: Dataset,
    start: Calibration,
    fixed: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[Dataset, tuple[Rejection, ...]]:
    """Return the data without gross outliers and without views that contradict the others.

    Args:
        data: the data; rejected points are hidden, not deleted, and reasons of whole views are in
        `masked_views`.
        start: as for `fit_joint`; views for which its chain is far off get a pose from their
        points.
        fixed: as for `fit_joint`; only paths of the camera are used.
        priors: as for `fit_joint`; only paths of the camera are used.
        progress: called with a line of text on rejections.

    Returns:
        The data, and view id, point and reason of the points left out one by one.
    """
    usable = np.isin(np.arange(data.view_count), data.usable_views())
    if usable.sum() < 3:
        return data, ()
    poses, unlocated = _start_poses(data, start, usable)
    located_data = without_views(data, unlocated)
    sigma, residual_norms, poses = _robust_poses(located_data, start, poses, fixed, priors)
    visible = np.asarray(located_data.visible)
    # Gate on squared whitened residuals: |r|^2 > MAX_SQUARED_RESIDUAL sigma^2.
    count = visible.sum(axis=1)
    checked = visible & (count > MAX_UNCHECKED_POINTS)[:, None]
    outside = checked & (residual_norms > np.sqrt(MAX_SQUARED_RESIDUAL) * sigma)
    outlier_count = outside.sum(axis=1)
    rejected_views = {
        int(k): f"no pose fits: {outlier_count[k]} of {count[k]} points are outliers"
        for k in np.flatnonzero(outlier_count > MAX_OUTLIER_FRACTION * count)
    }
    # A pose needs four points.
    trusted = (count >= 4) & ~np.isin(np.arange(len(count)), list(rejected_views))
    robot_poses = data.mount_from_holder
    rejected_views |= find_consistent_views(
        robot_poses,
        poses,
        trusted.astype(float),
        lambda camera_from_mount, holder_from_world: median_reprojection_errors(
            with_fields(
                start.uncorrected,
                camera_from_mount=camera_from_mount,
                holder_from_world=holder_from_world,
            ),
            located_data.observations,
            visible & ~outside,
        ),
        data.view_ids,
    ).reasons

    # Points of a rejected view are reported with the view, not one by one.
    outside[list(rejected_views)] = False
    point_rejections = tuple(
        Rejection(
            data.view_ids[view],
            int(point),
            _outlier_reason(float(residual_norms[view, point]), sigma),
        )
        for view, point in np.argwhere(outside)
    )
    if progress is not None and (point_rejections or rejected_views or unlocated):
        view_count = len(rejected_views) + len(unlocated)
        progress(f"left out: {len(point_rejections)} points, {view_count} views")
    clean_data = located_data.with_visible(visible & ~outside)
    return without_views(clean_data, rejected_views), point_rejections


def without_views(data: _Data, reasons: Mapping[int, str]) -> _Data:
    """Return the data with some views hidden, given their reasons by index."""
    if not reasons:
        return data
    masked = [(data.view_ids[view], text) for view, text in reasons.items()]
    hidden = cast(_Data, data.mask_views(list(reasons)))
    return dataclasses.replace(hidden, masked_views=(*data.masked_views, *masked))


def _outlier_reason(residual_norm: float, sigma: float) -> str:
    """Return the reason for rejecting a point, with its residual."""
    return (
        f"{residual_norm:.1f} px from the prediction by its view's best pose, "
        f"{residual_norm / sigma:.0f} standard deviations"
    )


def _start_poses(
    data: Dataset, start: Calibration, usable: Bool[np.ndarray, "views"]
) -> tuple[SE3, dict[int, str]]:
    """Return `camera_from_world` of every view, and reasons for views without a pose.

    The pose is from the chain if that is close, otherwise from the view's points.
    """
    chain = np.asarray(start.camera_from_world_matrices(data.command))
    residual_norms = _residual_norms(start, chain, data.observations)
    visible = np.asarray(data.visible)
    # The median is robust against a few outlying points.
    medians = medians_by_view(residual_norms, visible)
    median_residual = np.where(visible.any(axis=1), medians, 0.0)
    limit = max(MAX_MEDIAN_RATIO * float(np.median(median_residual[usable])), MAX_MEDIAN_RESIDUAL)
    misplaced = usable & (median_residual > limit)
    if not misplaced.any():
        return host_transforms(chain), {}
    misplaced_data = data.with_visible(visible & misplaced[:, None])
    located = host_matrices(estimate_view_poses(misplaced_data.observations, start.camera)[0])
    has_pose = np.isfinite(located).all(axis=(1, 2))
    unlocated = {int(k): "no pose was found" for k in np.flatnonzero(misplaced & ~has_pose)}
    relocated = (misplaced & has_pose)[:, None, None]
    return host_transforms(np.where(relocated, located, chain)), unlocated


def _robust_poses(
    data: Dataset,
    start: Calibration,
    poses: SE3,
    fixed: Sequence[str],
    priors: Mapping[str, Prior] | None,
) -> tuple[float, Float[np.ndarray, "views points"], SE3]:
    """Fit a free pose to every view with a robust loss.

    Returns:
        The pixel sigma, px; the norm of every point's residual, px; every view's best pose.
    """
    # Only priors and held parameters of the camera are used. Field and mount have no effect, but
    # with them the fit shares the compiled program of later fits.
    field = encompassing_field(data, len(data.usable_views())) if data.arm is None else None
    mount = data.mount if data.mount in ONE_ARM_MOUNTS else "eye_in_hand"
    free_pose_data, identity_start = with_free_camera_poses(data, start.camera, poses, field, mount)
    # A robust fit of a pose needs enough points in the view.
    count = np.asarray(data.visible).sum(axis=1)
    is_checked = 2 * np.sum(count[count > MAX_UNCHECKED_POINTS]) > np.sum(count)
    camera_priors = {path: prior for path, prior in (priors or {}).items() if _is_camera_path(path)}
    problem = build_problem(
        free_pose_data,
        identity_start,
        noise=Noise(1.0, np.inf, np.inf),
        loss=Cauchy() if is_checked else None,
        fixed=(*identity_start.transform_names, *filter(_is_camera_path, fixed)),
        priors=camera_priors,
    ).problem
    residual_norms = _residual_norms(identity_start, host_matrices(poses), problem.seen_points)
    first_factor = robust_variance(residual_norms**2, np.asarray(problem.observations.visible))
    # Cauchy's loss has the scale sigma, which is estimated from the residuals of the fit.
    problem, solution, _, sigma = solve_with_estimated_sigma(
        with_pixel_sigma(problem, updated_sigma(1.0, first_factor)),
        lambda problem, step: solve(problem, LOOSE_SOLVER, start=step),
        lambda problem, squares: (
            robust_variance(squares, np.asarray(problem.observations.visible))
            if is_checked
            else variance_factor(problem, squares)
        ),
        SIGMA_TOLERANCE,
        MAX_SIGMA_FITS,
    )
    norms = float(problem.pixel_sigma) * np.sqrt(squared_residuals(problem, solution.chain))
    return sigma, norms, host_transforms(np.asarray(solution.chain.camera_from_world))


def _is_camera_path(path: str) -> bool:
    """Return whether a path names parameters of the camera."""
    return path.split(".")[0] == "camera"


def _residual_norms(
    start: Calibration, camera_from_world: Float[AnyArray, "views 4 4"], observations: Observations
) -> Float[np.ndarray, "views points"]:
    """Return the norms of all residuals for given camera poses, px; infinite without projection."""
    residuals = view_residuals(start.camera, start.target_scale, camera_from_world, observations)
    return np.linalg.norm(residuals, axis=-1)
