"""The result of a refinement: points and lines with covariance, and verdicts on the constraints."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..evaluation import root_mean_square
from ..fit_result import FitResult
from .constrained_system import Factorisation
from .constraint_verdicts import ConstraintVerdict
from .line_jacobians import Lines
from .point_status import PointStatus, failure_messages


class RefinedFeatures(NamedTuple):
    """Refined points and lines, with their errors by cause.

    Attributes:
        points: in the world, m; NaN where `status` is not OK.
        lines: refined lines; NaN likewise.
        status: a `PointStatus` for each point.
        line_status: a `PointStatus` for each line.
        residuals: measured minus predicted pixels, NaN where not visible.
        line_residuals: distances of segments' ends from their lines, px; NaN where not visible.
        picture_covariance: covariance of each point due to the pictures, the constraints and
            what was free, m^2.
        line_covariance: likewise of each line's four numbers.
        calibration_jacobian: derivatives of each point by the numbers that were not free.
        calibration_covariance: covariance of these numbers.
        calibration_names: names of these numbers.
        number_offsets: estimated offsets of the numbers that were free, by name.
        verdicts: one for each constraint, in order.
        constraints_p_value: probability of the cost of all constraints together if they are true.
        result: whether it converged.
        posterior: the factorised equations, from which covariances between features come.
        weak: indices of points that are determined by constraints or not at all.
    """

    points: Float[np.ndarray, "points 3"]
    lines: Lines
    status: np.ndarray
    line_status: np.ndarray
    residuals: Float[np.ndarray, "views points 2"]
    line_residuals: Float[np.ndarray, "views lines 2"]
    picture_covariance: Float[np.ndarray, "points 3 3"]
    line_covariance: Float[np.ndarray, "lines 4 4"]
    calibration_jacobian: Float[np.ndarray, "points 3 numbers"]
    calibration_covariance: Float[np.ndarray, "numbers numbers"]
    calibration_names: tuple[str, ...]
    number_offsets: dict[str, float]
    verdicts: tuple[ConstraintVerdict, ...]
    constraints_p_value: float
    result: FitResult
    posterior: Factorisation
    weak: np.ndarray

    @property
    def vertices(self) -> Float[np.ndarray, "points 3"]:
        """The points, by the name that models use."""
        return self.points

    @property
    def ok(self) -> Bool[np.ndarray, "points"]:
        """Whether each point is determined."""
        return self.status == PointStatus.OK

    @property
    def failures(self) -> dict[int, str]:
        """The reason, in words, of every point that is not determined, by its index."""
        return failure_messages(self.status)

    @property
    def contradictions(self) -> tuple[ConstraintVerdict, ...]:
        """The constraints to be doubted, the most expensive first."""
        doubted = [one for one in self.verdicts if one.contradicts or one.violated]
        return tuple(sorted(doubted, key=lambda one: (one.violated, one.cost), reverse=True))

    @property
    def rms(self) -> float:
        """The root mean square reprojection error of the points, px."""
        return root_mean_square(np.linalg.norm(self.residuals, axis=-1))

    def covariance(self) -> Float[np.ndarray, "points 3 3"]:
        """Return the covariance of each point due to all causes, m^2."""
        J = self.calibration_jacobian
        return self.picture_covariance + J @ self.calibration_covariance @ J.swapaxes(1, 2)

    def joint_covariance(
        self, points: Sequence[int] | None = None
    ) -> Float[np.ndarray, "coordinates coordinates"]:
        """Return the covariance of the coordinates of some points, or of all, m^2."""
        chosen = np.arange(len(self.points)) if points is None else np.asarray(points, dtype=int)
        J = self.calibration_jacobian[chosen].reshape(3 * len(chosen), len(self.calibration_names))
        own = self.joint_picture_covariance(chosen.tolist())
        return own + J @ self.calibration_covariance @ J.T

    def joint_picture_covariance(
        self, points: Sequence[int]
    ) -> Float[np.ndarray, "coordinates coordinates"]:
        """Return the part of it that is due to the pictures, the constraints and what was free.

        Unlike triangulated points, those that a constraint binds have errors in common here.
        """
        rows = [self._rows(int(k)) for k in points]
        return self.posterior.covariance(np.concatenate(rows) if rows else np.zeros(0, int))

    def _rows(self, point: int) -> np.ndarray:
        """Return the rows of a point's coordinates among the unknowns of the posterior."""
        # Points in the border come after those that are eliminated, at its end.
        if point in self.weak:
            place = int(np.flatnonzero(self.weak == point)[0])
            first = self.posterior.features.size + self.posterior.border_size
            return first - 3 * (len(self.weak) - place) + np.arange(3)
        return 3 * point + np.arange(3)
