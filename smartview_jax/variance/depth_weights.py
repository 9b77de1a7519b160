"""Weigh depths against pixels: the pixels' noise within views, and the depths' error by view.

Depths have a standard deviation in metres (`dataset.DepthNoise`), pixels an unknown one in px: the
fit of camera and free poses to the pixels alone tells it. The poses of this fit also tell how far
the depths of a view are off together. Both noises are scaled together afterwards: where views
scatter more than their points tell (effective pixel sigma), depths are trusted less as well.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize_scalar

from ..calibration import Calibration, flat_shape
from ..cameras import Camera
from ..dataset import Dataset
from ..engine import DEPTH_BIAS, Noise, ParameterChoice, build_problem
from ..geometry import host_cross_matrices, host_transformed
from ..robot_errors import FieldChoice
from .free_poses import choice_for_free_poses, fit_free_poses
from .model_selection import encompassing_field
from .view_statistics import SIGMA_FLOOR, chain_at

LARGEST_RATIO = 2.0
"""Largest ratio of measured and predicted depths: beyond it they have another unit or origin."""

COMMON_STD_RANGE = 1e-6, 0.1
"""Range in which the standard deviation of the depths' common error is sought, m."""


def with_weighed_depths(
    data: Dataset,
    start: Calibration,
    choice: ParameterChoice,
    field: FieldChoice = "auto",
    pixel_sigma: float | None = None,
) -> Dataset:
    """Return the data with depths that count relative to the noise of pixels within views.

    Args:
        data: data set; one without depths, or with weighed ones, is returned as it is.
        start: a calibration near the solution, with the lens to fit.
        choice: parameters that are held, free, and with priors.
        field: robot error field, with which later fits share a program.
        pixel_sigma: standard deviation of u and of v within views, px, if it is known.

    Raises:
        ValueError: depths that are far from where the pixels put the target.
    """
    if data.depths is None or data.depth_noise is None or data.depths.is_weighed:
        return data
    usable = data.usable_views()
    basis = encompassing_field(data, len(usable)) if field == "auto" else field
    # Without priors of the poses depths have no weight yet (see `build_problem`).
    free = Noise(1.0, np.inf, np.inf).with_unit_groups(basis)
    choice = choice_for_free_poses(choice.holding(DEPTH_BIAS), start, len(usable))
    built = build_problem(data, start, noise=free, field=basis, **choice._asdict())
    fit = fit_free_poses(built, usable, flat_shape(*map(np.asarray, (data.points, data.visible))))
    if pixel_sigma is None:
        free_camera = np.asarray(built.problem.is_camera)[np.asarray(built.problem.free)]
        parameters = built.pose_parameters(usable) + int(free_camera.sum())
        freedom = max(2 * fit.problem.visible_count - parameters, 1)
        pixel_sigma = max(float(np.sqrt(fit.sum_of_squares / freedom)), SIGMA_FLOOR)
    chain = chain_at(fit.problem, fit.z)
    scale = float(chain.calibration.target_scale)
    placed = host_transformed(np.asarray(chain.camera_from_world), scale * np.asarray(data.points))
    used = data.depths.used & np.asarray(data.visible)
    used &= np.isin(np.arange(data.view_count), usable)[:, None]
    _refuse_other_unit(np.asarray(data.depths.measured)[used], placed[used][:, 2])
    common = data.depth_noise.common
    if common is None:
        common = _common_std(data, placed, used, chain.calibration.camera, pixel_sigma)
    noise = dataclasses.replace(data.depth_noise, common=common)
    depths = data.depths.weighed(pixel_sigma, common)
    return dataclasses.replace(data, depths=depths, depth_noise=noise)


def _refuse_other_unit(
    measured: Float[np.ndarray, "used"], expected: Float[np.ndarray, "used"]
) -> None:
    """Raise a ValueError for depths far from where the pixels put the target."""
    if not len(measured):
        return
    read, predicted = np.median(measured), np.median(expected)
    if not 1.0 / LARGEST_RATIO < read / predicted < LARGEST_RATIO:
        raise ValueError(
            f"depths: expected about {predicted:.3g} m, where the pixels put the target, found "
            f"{read:.3g} (medians): are they metres along the optical axis?"
        )


def _common_std(
    data: Dataset,
    placed: Float[np.ndarray, "views points 3"],
    used: Bool[np.ndarray, "views points"],
    camera: Camera,
    pixel_sigma: float,
) -> float:
    """Return the standard deviation of the error that depths of a view have in common, m.

    The mean depth of a view is an affine function of its mean by the pixels, up to the noise of
    depths and pixels, which is known, and the common error, whose variance maximises the restricted
    likelihood. Zero for fewer than four views.

    Args:
        data: data set with depths.
        placed: points in the camera's frame by the pixels alone, m.
        used: mask of the depths that count.
        camera: the camera.
        pixel_sigma: standard deviation of u and of v within views, px.
    """
    assert data.depths is not None
    views = np.flatnonzero(used.any(axis=1))
    if len(views) < 4:
        return 0.0
    weight = np.where(used, np.square(np.asarray(data.depths.precision)), 0.0)[views]
    share = weight / weight.sum(axis=1, keepdims=True)
    means = (share * np.asarray(data.depths.measured)[views]).sum(axis=1)
    predicted = (share * placed[views, :, 2]).sum(axis=1)
    variances = 1.0 / weight.sum(axis=1) + [
        _variance_by_pixels(
            placed[view], np.asarray(data.visible)[view], view_share, camera, pixel_sigma
        )
        for view, view_share in zip(views, share, strict=True)
    ]
    design = np.column_stack([np.ones(len(views)), predicted - predicted.mean()])

    def deviance(logarithm: float) -> float:
        """Return -2 log of the restricted likelihood."""
        root = np.sqrt(variances + np.exp(2.0 * logarithm))
        q, r = np.linalg.qr(design / root[:, None])
        rest = means / root - q @ (q.T @ (means / root))
        return float(
            2.0 * np.log(root).sum() + 2.0 * np.log(np.abs(np.diagonal(r))).sum() + rest @ rest
        )

    smallest, largest = np.log(COMMON_STD_RANGE)
    # The deviance may be flat where the error is negligible: the search begins at the best of some.
    tried = np.linspace(smallest, largest, 40)
    best = tried[int(np.argmin([deviance(candidate) for candidate in tried]))]
    step = tried[1] - tried[0]
    bounds = max(best - step, smallest), min(best + step, largest)
    optimum = minimize_scalar(deviance, bounds=bounds, method="bounded")
    log_std = float(optimum.x)  # pyright: ignore[reportAttributeAccessIssue]
    return 0.0 if deviance(smallest) <= deviance(log_std) else float(np.exp(log_std))


def _variance_by_pixels(
    points: Float[np.ndarray, "points 3"],
    visible: Bool[np.ndarray, "points"],
    share: Float[np.ndarray, "points"],
    camera: Camera,
    pixel_sigma: float,
) -> float:
    """Return the variance of a view's mean depth, of a free pose by the pixels of a known camera.

    Distortion, which changes it by some per cent, is left out.
    """
    seen = points[visible]
    x, y, z = seen.T
    by_point = np.zeros((2, len(seen), 3))
    by_point[0, :, 0], by_point[0, :, 2] = 1.0 / z, -x / z**2
    by_point[1, :, 1], by_point[1, :, 2] = 1.0 / z, -y / z**2
    by_point *= np.array([float(camera.alpha_u), float(camera.alpha_v)])[:, None, None]
    # A twist (v, w) moves a point by v + w x p = v - p x w.
    eye = np.broadcast_to(np.eye(3), (len(seen), 3, 3))
    by_twist = np.concatenate([eye, -host_cross_matrices(seen)], axis=2)
    jacobian = (by_point[:, :, None] @ by_twist[None])[:, :, 0].reshape(-1, 6)
    # The depth moves by v_z + w_x y - w_y x.
    mean_x, mean_y, _ = share @ points
    towards = np.array([0.0, 0.0, 1.0, mean_y, -mean_x, 0.0])
    information = jacobian.T @ jacobian
    return pixel_sigma**2 * float(towards @ np.linalg.pinv(information, hermitian=True) @ towards)
