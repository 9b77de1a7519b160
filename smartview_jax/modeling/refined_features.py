"""The result of a refinement: points and lines with covariance, and verdicts on the constraints."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..evaluation import root_mean_square
from ..fit_result import FitResult
from .constrained_system import Factorisation
from .constraint_verdicts import ConstraintVerdict
from .estimated_features import EstimatedPoints
from .line_jacobians import Lines


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RefinedFeatures(EstimatedPoints):
    """Refined points and lines, with their errors by cause.

    `picture_covariance` also includes the effect of the constraints and of the free numbers; the
    numbers of the calibration are the ones that were fixed.

    Attributes:
        lines: refined lines; NaN where `line_status` is not OK.
        line_status: a `PointStatus` for each line.
        line_residuals: distances of segments' ends from their lines, px; NaN where not visible.
        line_covariance: covariance of each line's four numbers, as `picture_covariance`.
        number_offsets: estimated offsets of the numbers that were free, by name.
        verdicts: one for each constraint, in order.
        constraints_p_value: probability of the cost of all constraints together if they are true.
        result: whether it converged.
        posterior: the factorised equations, for covariances between features.
        weak: indices of points that are determined by constraints or not at all.
    """

    lines: Lines
    line_status: np.ndarray
    line_residuals: Float[np.ndarray, "views lines 2"]
    line_covariance: Float[np.ndarray, "lines 4 4"]
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
    def contradictions(self) -> tuple[ConstraintVerdict, ...]:
        """The constraints that contradict the pictures or each other, the worst first."""
        doubted = [verdict for verdict in self.verdicts if verdict.contradicts or verdict.violated]
        return tuple(
            sorted(doubted, key=lambda verdict: (verdict.violated, verdict.cost), reverse=True)
        )

    @property
    def rms(self) -> float:
        """The root mean square reprojection error of the points, px."""
        return root_mean_square(np.linalg.norm(self.residuals, axis=-1))

    def joint_picture_covariance(
        self, points: Sequence[int]
    ) -> Float[np.ndarray, "coordinates coordinates"]:
        """Return the covariance due to the pictures, the constraints and the free numbers, m^2.

        Unlike triangulated points, points that share a constraint have correlated errors here.
        """
        rows = [self._rows(int(k)) for k in points]
        return self.posterior.covariance(np.concatenate(rows) if rows else np.zeros(0, int))

    def _rows(self, point: int) -> np.ndarray:
        """Return the rows of a point's coordinates among the unknowns of the posterior."""
        # Points in the border come after the eliminated ones, at the end.
        if point in self.weak:
            place = int(np.flatnonzero(self.weak == point)[0])
            first = self.posterior.features.size + self.posterior.border_size
            return first - 3 * (len(self.weak) - place) + np.arange(3)
        return 3 * point + np.arange(3)
