"""Define the common part of all features estimated from pictures: status, residuals, errors."""

import abc
import dataclasses
from collections.abc import Sequence
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float, Int

MAX_RELATIVE_STD = 0.25
"""Largest standard deviation of a point's distance, over the distance, of a returned point.

Above it its rays are parallel within their errors, and no Gaussian describes its position."""


class PointStatus(IntEnum):
    """The outcome of the estimation of one point or line."""

    OK = 0
    TOO_FEW_VIEWS = 1
    DEGENERATE_BASELINE = 2
    BEHIND_CAMERA = 3
    NOT_CONVERGED = 4
    EPIPOLAR_PLANE = 5

    @property
    def message(self) -> str:
        """A sentence for people that says what is wrong."""
        return _MESSAGES[self]


_MESSAGES = {
    PointStatus.OK: "it was estimated",
    PointStatus.TOO_FEW_VIEWS: "fewer than two views see it where their lens is valid",
    PointStatus.DEGENERATE_BASELINE: "its rays are parallel within their errors, so that its "
    "distance is undetermined: views from further apart are needed",
    PointStatus.BEHIND_CAMERA: "its rays meet behind a camera that sees it, or outside its "
    "lens: the correspondence or a pose is wrong",
    PointStatus.NOT_CONVERGED: "the least-squares estimate did not converge",
    PointStatus.EPIPOLAR_PLANE: "it lies in the epipolar plane of its views within its errors: "
    "any line of that plane explains them, and a view from outside it is needed",
}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class EstimatedFeatures(abc.ABC):
    """Points or lines, each of n numbers, that were estimated from pictures.

    A feature's errors have two causes: the pictures, with separate errors for each feature, and the
    calibration, whose errors are common to all features.

    Attributes:
        picture_covariance: covariance of each feature's numbers due to the pictures; m^2 for
            points, and m and rad for lines (see `Lines`).
        calibration_jacobian: derivatives of each feature's numbers by the uncertain numbers of the
            calibration and of the views' poses; empty without a covariance of the calibration.
        calibration_covariance: covariance of the uncertain numbers, in their own units.
        calibration_names: names of the uncertain numbers.
        residuals: px, NaN where not visible: for points, measured minus predicted pixels; for
            lines, the distances of both ends of each segment from the line's picture.
        status: a `PointStatus` for each feature; failed features are NaN.
    """

    picture_covariance: Float[np.ndarray, "features n n"]
    calibration_jacobian: Float[np.ndarray, "features n numbers"]
    calibration_covariance: Float[np.ndarray, "numbers numbers"]
    calibration_names: tuple[str, ...]
    residuals: Float[np.ndarray, "views features 2"]
    status: Int[np.ndarray, "features"]

    @property
    def ok(self) -> Bool[np.ndarray, "features"]:
        """Whether each feature was estimated."""
        return self.status == PointStatus.OK

    @property
    def failures(self) -> dict[int, str]:
        """The reason, in words, of every feature that was not estimated, by its index."""
        failed = np.flatnonzero(~self.ok)
        return {int(k): PointStatus(self.status[k]).message for k in failed}

    def covariance(self) -> Float[np.ndarray, "features n n"]:
        """Return the covariance of each feature's numbers due to pictures and calibration."""
        # Independent causes: their covariances add up.
        J = self.calibration_jacobian
        return self.picture_covariance + J @ self.calibration_covariance @ J.swapaxes(1, 2)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class EstimatedPoints(EstimatedFeatures):
    """Points (m) in the world that were estimated from pictures."""

    points: Float[np.ndarray, "points 3"]

    def joint_covariance(
        self, points: Sequence[int] | None = None
    ) -> Float[np.ndarray, "coordinates coordinates"]:
        """Return the covariance of the coordinates of some points, or of all, m^2.

        The coordinates are x, y, z of each point in turn.
        """
        chosen = np.arange(len(self.points)) if points is None else np.asarray(points, dtype=int)
        J = self.calibration_jacobian[chosen].reshape(3 * len(chosen), len(self.calibration_names))
        from_pictures = self.joint_picture_covariance(chosen.tolist())
        return from_pictures + J @ self.calibration_covariance @ J.T

    @abc.abstractmethod
    def joint_picture_covariance(
        self, points: Sequence[int]
    ) -> Float[np.ndarray, "coordinates coordinates"]:
        """Return the part of the joint covariance that is not due to the calibration, m^2."""
