"""Estimate the camera and the views' poses from the pictures alone: the parts of Steps 1 and 2.

Step 1 calibrates each view by itself, or estimates its pose with a known camera. Step 2 starts from
the medians.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool

from ..cameras import AbstractLens, Camera, Pinhole, Radial, initial_lens
from ..data_checks import (
    CameraDoubt,
    CameraMisfit,
    camera_problem,
    mask_unusable_views,
    minimum_points,
    require_minimum_views,
    unusable_views,
)
from ..dataset import (
    Dataset,
    Observations,
)
from ..runtime.array_namespace import to_device
from .kalman import kalman_filter
from .staged_fit import CommonCameraFit, CommonCameraOptions
from .weng import ViewCalibrations, calibrate_views, estimate_view_poses


class Step1(NamedTuple):
    """The views by themselves, and what Step 2 starts from.

    Attributes:
        calibrations: the calibration of each view; None for a known camera.
        camera, camera_from_world: the start of Step 2.
        inliers: mask of the points that are not gross errors.
        rms: RMS reprojection error of each view, px.
    """

    calibrations: ViewCalibrations | None
    camera: Camera
    camera_from_world: SE3
    inliers: Bool[Array, "views points"]
    rms: np.ndarray


def run_step1(
    observations: Observations,
    image_size: tuple[int, int],
    used: np.ndarray,
    lens: str | AbstractLens,
    camera: Camera | None,
) -> Step1:
    """Calibrate each view by itself; with a known camera, estimate its pose."""
    if camera is not None:
        poses, rms, inliers = estimate_view_poses(observations, camera)
        start = _fill_unused_poses(poses, used)
        return Step1(None, camera, start, inliers, np.asarray(rms))
    distortion = not (lens == "pinhole" or isinstance(lens, Pinhole))
    step1 = calibrate_views(observations, image_size, distortion)
    start_camera, start = start_of_step2(step1, used, lens, image_size)
    return Step1(step1, start_camera, start, step1.inliers, np.asarray(step1.rms))


def start_of_step2(
    step1: ViewCalibrations,
    used: Bool[np.ndarray, "views"],
    lens: str | AbstractLens,
    image_size: tuple[int, int],
) -> tuple[Camera, SE3]:
    """Return the camera and the poses from which one camera is fitted to some views.

    Args:
        step1: the calibration of each view by itself.
        used: mask of the views.
        lens: a name or a lens.
        image_size: width and height, px.
    """
    # The median over views: single views with a poor focal length do not spoil the start.
    medians = [float(np.median(np.asarray(values)[used])) for values in step1.intrinsics]
    camera = Camera(
        *medians[:4], lens=initial_lens(lens, Radial(medians[4])), image_size=image_size
    )
    # The size in the picture is alpha / depth. A view with a larger alpha of its own has a larger
    # depth than it has with the common alpha, so depths are rescaled by the ratio.
    poses = np.array(step1.camera_from_world.wxyz_xyz)
    poses[:, 6] *= medians[0] / np.asarray(step1.intrinsics.alpha_u)
    return camera, _fill_unused_poses(SE3(to_device(poses)), used)


def _fill_unused_poses(poses: SE3, used: np.ndarray) -> SE3:
    """Return the poses with an arbitrary finite pose in the views that are not used."""
    # Identity rotation, one metre in front of the camera: everything stays finite.
    placeholder = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    return SE3(to_device(np.where(used[:, None], np.asarray(poses.wxyz_xyz), placeholder)))


def camera_poses_of_views(
    data: Dataset, lens: str | AbstractLens, camera: Camera | None
) -> tuple[SE3, Bool[np.ndarray, "views"]]:
    """Return where each view was taken from by its picture alone (Steps 1 and 2).

    Returns:
        `camera_from_world`, and a mask of the views whose pose is known.
    """
    unusable = unusable_views(data, minimum_points(camera))
    require_minimum_views(data, unusable, minimum_points(camera))
    observations, used = mask_unusable_views(data, unusable)
    step1 = run_step1(observations, data.image_size, used, lens, camera)
    common_fit = kalman_filter(
        observations,
        step1.camera,
        step1.camera_from_world,
        step1.inliers,
        CommonCameraOptions(hold_camera=camera is not None),
        None,
    )
    return common_fit.camera_from_world, used


def pixel_noise(common_fit: CommonCameraFit) -> float:
    """Return the standard deviation of u and v, px, with the freedom of the views' poses."""
    points = np.asarray(common_fit.inliers).sum(axis=1)
    # Six numbers of a pose take up half of the residuals of four corners.
    freedom = max(2.0 * points.sum() - 6.0 * np.count_nonzero(points), 1.0)
    pooled = float(common_fit.rms) * np.sqrt(points.sum() / freedom)
    return max(float(common_fit.pixel_sigma), pooled)


def common_camera_doubt(
    misfit: CameraMisfit,
    observations: Observations,
    used: np.ndarray,
    lens: str | AbstractLens,
    is_known: bool,
    fit_with: Callable[[str], CommonCameraFit],
) -> CameraDoubt:
    """Return what is wrong with the common camera; see `camera_problem`."""

    def camera_and_poses(name: str) -> tuple[Camera, SE3]:
        """Return the common camera with another lens, and the poses of the views."""
        fit = fit_with(name)
        return fit.camera, fit.camera_from_world

    text = camera_problem(misfit, lens, is_known, camera_and_poses, observations, used)
    return CameraDoubt(text, misfit)
