"""Convert views of several cameras to views of one camera, so that all modelling works with them.

Triangulation, lines, refinement, proposals and the editor take one camera for all views. They use
only the rays of a view, and rays can be expressed in the pixels of any camera in the same place. So
the pixels of each view are converted to pixels of one pinhole camera, which covers all views at the
longest focal length, and pictures are resampled for it (`features.resampled`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration import Calibration
from ..cameras import Camera, Pinhole
from ..features import IdealPlane
from ..robots import CommandLike
from .triangulation import CLICK_SIGMA
from .view_poses import SeenViews

MAX_SLOPE = 4.0
"""Largest tangent of the angle between a ray of a picture's border and its optical axis.

Beyond 76 degrees a pinhole camera's picture is mostly border.
"""

_SAMPLES = 33
"""Number of pixels sampled along each border of a picture."""


class CommonCamera(NamedTuple):
    """Views of several cameras, converted to one pinhole camera.

    Attributes:
        calibration: of the common camera, on a tool of the same frame; in the same world.
        base_from_tool: its pose in the world in each view, in place of the robot's reported pose.
        cameras: the cameras that took the views.
    """

    calibration: Calibration
    base_from_tool: Float[np.ndarray, "views 4 4"]
    cameras: tuple[Camera, ...]

    def pixels(
        self, pixels: Float[np.ndarray, "views points 2"], sigma: float = CLICK_SIGMA
    ) -> tuple[Float[np.ndarray, "views points 2"], Float[np.ndarray, "views points 2 2"]]:
        """Return pixels of the views as pixels of the common camera, with their covariances.

        Args:
            pixels: in the view's own picture, px; NaN where a point is not visible.
            sigma: standard deviation of u and of v there, px.

        Returns:
            Pixels and their covariances (px^2), as `triangulate_points` takes them; NaN, with the
                unit matrix, where a point is not visible or the view's lens has no ray.

        Raises:
            ValueError: numbers of pixels and views that differ.
        """
        if len(pixels) != len(self.cameras):
            raise ValueError(f"pixels: expected {len(self.cameras)} views, found {len(pixels)}")
        common = self.calibration.camera
        f, c = float(common.alpha_u), np.array([float(common.u0), float(common.v0)])
        moved = np.full(pixels.shape, np.nan)
        covariances = np.tile(np.eye(2), (*pixels.shape[:2], 1, 1))
        for k, camera in enumerate(self.cameras):
            plane, visible = IdealPlane(camera), np.isfinite(pixels[k]).all(axis=1)
            moved[k, visible] = f / plane.focal_length * plane.from_pixels(pixels[k, visible]) + c
            # A click error of a short camera is several pixels of a long one.
            J = f / plane.focal_length * plane.derivatives(pixels[k, visible])
            usable = np.isfinite(moved[k, visible]).all(axis=1)
            covariance = sigma**2 * J @ J.swapaxes(1, 2)
            covariances[k, visible] = np.where(usable[:, None, None], covariance, np.eye(2))
        return moved, covariances


def common_camera(calibrations: Sequence[Calibration], poses: CommandLike) -> CommonCamera:
    """Return the common camera of views taken by different cameras.

    The uncertainty of the calibrations is not included: covariances of results from these views
    contain the pixels' errors only.

    Args:
        calibrations: calibration of each view's camera, all in one world frame: calibrated with the
            target in the same place.
        poses: poses that the robot (or each camera's robot) reported in each view,
            `base_from_tool`.

    Raises:
        ValueError: numbers of calibrations and poses that differ, poses that are not rigid, or a
            picture that is too wide for a pinhole camera; the view is named.
    """
    # By identity: most views share one of few calibrations, whose chain is computed once.
    different = {id(calibration): calibration for calibration in calibrations}
    extrinsics_of = {
        key: SeenViews.of(calibration, poses).camera_from_world
        for key, calibration in different.items()
    }
    views = len(next(iter(extrinsics_of.values()))) if extrinsics_of else 0
    if views == 0 or len(calibrations) != views:
        raise ValueError(
            f"calibrations: expected one for each of {views} poses, found {len(calibrations)}"
        )
    extrinsics = np.stack(
        [extrinsics_of[id(calibration)][k] for k, calibration in enumerate(calibrations)]
    )
    cameras = tuple(calibration.camera for calibration in calibrations)
    camera = _camera_that_sees_all(cameras)
    calibration = Calibration.eye_in_hand(camera, np.eye(4), np.eye(4))
    return CommonCamera(calibration, np.linalg.inv(extrinsics), cameras)


def _camera_that_sees_all(cameras: Sequence[Camera]) -> Camera:
    """Return a pinhole camera whose picture contains every pixel of the other cameras."""
    planes = [IdealPlane(camera) for camera in cameras]
    # No view loses resolution; views of shorter cameras are enlarged.
    f = max(plane.focal_length for plane in planes)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for k, (camera, plane) in enumerate(zip(cameras, planes, strict=True)):
        slopes = plane.from_pixels(_border(camera.image_size)) / plane.focal_length
        # A lens model that ends within the picture has no rays in the corners.
        slopes = slopes[np.isfinite(slopes).all(axis=1)]
        if not len(slopes) or np.abs(slopes).max() > MAX_SLOPE:
            raise ValueError(
                f"view {k}: its picture is too wide for a pinhole camera: rays of its border are "
                f"more than {np.rad2deg(np.arctan(MAX_SLOPE)):.0f} degrees from the axis"
            )
        low, high = np.minimum(low, slopes.min(axis=0)), np.maximum(high, slopes.max(axis=0))
    # Pixel centres from 0: a pixel of margin on each side, against rounding.
    centre = 1.0 - f * low
    width, height = np.ceil(f * (high - low)).astype(int) + 3
    return Camera(f, f, float(centre[0]), float(centre[1]), Pinhole(), (int(width), int(height)))


def _border(image_size: tuple[int, int]) -> Float[np.ndarray, "pixels 2"]:
    """Return pixels around the border of a picture."""
    width, height = image_size
    # From edge to edge: pixels extend by half a pixel around their centres.
    t = np.linspace(0.0, 1.0, _SAMPLES)
    u, v = t * width - 0.5, t * height - 0.5
    sides = [
        np.column_stack(np.broadcast_arrays(*side))
        for side in ((u, -0.5), (u, height - 0.5), (-0.5, v), (width - 0.5, v))
    ]
    return np.concatenate(sides)
