"""Triangulate points from the pixels of two or more views, with the covariance of each cause.

The estimate minimises the squared reprojection errors (the paper's "least-mean-square
minimisation", Section 5.1). Its errors come from the pictures, independently for each point, and
from the calibration, in common for all points: the two are kept separate.

Reference: Hartley and Zisserman, Multiple view geometry in computer vision, 2004, chapter 12.
"""

import dataclasses
from collections.abc import Sequence
from typing import Unpack

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..engine import AbstractLoss
from ..evaluation import root_mean_square
from ..robots import CommandLike
from ..runtime.array_namespace import to_device
from .calibration_uncertainty import CalibrationUncertainty, UncertaintyOptions
from .estimated_features import EstimatedPoints, PointStatus
from .pixel_jacobians import pixel_jacobians
from .point_estimation import estimate_points
from .rig_views import AnyCalibration
from .view_poses import (
    PADDED_FEATURES,
    SeenViews,
    padded_count,
    padded_to,
    whitening_of,
)

CLICK_SIGMA = 0.5
"""Default standard deviation of u and of v of a clicked feature, px."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TriangulatedPoints(EstimatedPoints):
    """Triangulated points with their errors by cause; failed points (see `status`) are NaN."""

    def joint_picture_covariance(
        self, points: Sequence[int]
    ) -> Float[np.ndarray, "coordinates coordinates"]:
        """Return the part of the joint covariance that is due to the pictures, m^2."""
        # Errors of the pictures are independent between points: the matrix is block-diagonal.
        covariance = np.zeros((3 * len(points), 3 * len(points)))
        for k, point in enumerate(points):
            covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = self.picture_covariance[point]
        return covariance

    @property
    def rms(self) -> float:
        """The root mean square reprojection error of all estimated points, px."""
        return root_mean_square(np.linalg.norm(self.residuals[:, self.ok], axis=-1))


def triangulate_points(
    calibration: AnyCalibration,
    poses: CommandLike | None,
    pixels: np.ndarray | Array,
    visible: np.ndarray | Array | None = None,
    *,
    pixel_sigma: float | np.ndarray = CLICK_SIGMA,
    loss: AbstractLoss | None = None,
    **uncertainty: Unpack[UncertaintyOptions],
) -> TriangulatedPoints:
    """Triangulate points from their pixels in two or more views.

    A point that cannot be triangulated is NaN, and `status` and `failures` name the reason. The
    covariance due to the calibration is valid for views not used to estimate the calibration.

    Args:
        calibration: the calibrated camera; results are in its world frame, in true metres.
            `RigViews` for views of several cameras.
        poses: poses that the robot reported in each view, `base_from_tool`; None where the robot
            does not matter (`RigViews`).
        pixels: `(views, points, 2)`, px, OpenCV's convention.
        visible: `(views, points)`, where each is visible; by default where its pixel is finite.
        pixel_sigma: standard deviation of u and of v, px, as one number or `(views, points)`; or
            covariances `(views, points, 2, 2)`, px^2.
        loss: robust loss of the whitened residuals; None is least squares.
        uncertainty: `covariance`, a joint fit or a bound with the uncertainty of the calibration,
            which is else taken as exact; `noise`, sizes of the robot's noise in these views, by
            default the noise of the fit.

    Raises:
        ValueError: arrays whose shapes do not match, pixels outside the picture, poses that are not
            rigid, or a covariance of other parameters.
    """
    # Everything is checked on the host first.
    views = SeenViews.of(calibration, poses)
    measured, visible = views.checked_points(pixels, visible)
    whitening = whitening_of(pixel_sigma, visible.shape)
    points, picture_covariance, residuals, status = solve_points(
        views, measured, whitening, visible, loss
    )
    ok = status == PointStatus.OK
    picture_covariance = np.where(ok[:, None, None], picture_covariance, np.nan)
    known = CalibrationUncertainty.of(views, calibration, **uncertainty)
    # The calibration's part takes longer than the points, so it is computed only on request.
    jacobian = np.zeros((len(points), 3, 0))
    if known.names:
        jacobian = _calibration_jacobian(
            views, known, points, picture_covariance, whitening, visible & ok
        )
    return TriangulatedPoints(
        points=np.where(ok[:, None], points, np.nan),
        picture_covariance=picture_covariance,
        calibration_jacobian=jacobian,
        calibration_covariance=known.covariance,
        calibration_names=known.names,
        residuals=np.where((visible & ok)[..., None], residuals, np.nan),
        status=status,
    )


def solve_points(
    views: SeenViews,
    pixels: Float[np.ndarray, "views points 2"],
    whitening: Float[np.ndarray, "#views #points 2 2"],
    visible: Bool[np.ndarray, "views points"],
    loss: AbstractLoss | None = None,
) -> tuple[
    Float[np.ndarray, "points 3"],
    Float[np.ndarray, "points 3 3"],
    Float[np.ndarray, "views points 2"],
    Int[np.ndarray, "points"],
]:
    """Run `estimate_points` on padded arrays; return points, covariances, residuals, status."""
    count = visible.shape[1]
    poses = views.poses_for(count)
    shape = (len(poses), padded_count(count))
    safe = np.where(visible[..., None], pixels, 0.0)
    if count <= PADDED_FEATURES[-1]:
        # One program, whether the observations have one sigma or each its own.
        whitening = padded_to(np.broadcast_to(whitening, (*visible.shape, 2, 2)), shape)
    solution = estimate_points(
        views.camera_for(len(poses)),
        to_device(poses),
        to_device(padded_to(safe, shape)),
        to_device(whitening),
        to_device(padded_to(visible, shape, False)),
        loss,
    )
    points, covariance, residuals, status = map(np.asarray, solution)
    return (
        points[:count],
        covariance[:count],
        residuals[: len(visible), :count],
        status[:count].astype(int),
    )


def _calibration_jacobian(
    views: SeenViews,
    uncertainty: CalibrationUncertainty,
    points: Float[np.ndarray, "points 3"],
    covariance: Float[np.ndarray, "points 3 3"],
    whitening: Float[np.ndarray, "#views #points 2 2"],
    visible: Bool[np.ndarray, "views points"],
) -> Float[np.ndarray, "points 3 numbers"]:
    """Return the derivatives of estimated points by the uncertain numbers of the calibration."""
    # At the optimum J^T W (z - f(x, t)) = 0. With A the derivatives of f by t,
    #     dx/dt = -P J^T W A,   with P = (J^T W J)^-1 the covariance due to the pictures,
    # up to terms in the residuals.
    jacobians = pixel_jacobians(views, np.where(np.any(visible, axis=0)[:, None], points, 0.0))
    # Invisible observations have no weight, whatever their values.
    information = whitening.swapaxes(-1, -2) @ whitening
    weighted = np.where(visible[..., None, None], information @ jacobians.by_point, 0.0)
    sensitivity = -weighted.swapaxes(-1, -2) @ jacobians.by_view
    return covariance @ uncertainty.propagate(sensitivity)
