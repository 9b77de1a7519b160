"""The result of a refinement: points and lines with covariance, and verdicts on the constraints.

Every constraint is judged by the chi-square that releasing it would save.

Reference: Rao, Large sample tests of statistical hypotheses, 1948 (the score test).
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import chdtrc

from ...evaluation import root_mean_square
from ...fit_result import FitResult
from ..estimated_features import EstimatedPoints
from ..line_jacobians import Lines
from .constrained_system import EXACT_VARIANCE, Factorisation
from .constraints import AbstractConstraint
from .refinement_problem import RefinementProblem, RefinementState, linearise

VIOLATION = 1e-2
"""Largest violation of an exact constraint, in standard deviations that the pictures leave it."""


class ConstraintVerdict(NamedTuple):
    """The agreement of a constraint with the pictures and with the other constraints.

    Attributes:
        constraint: the constraint.
        residuals: its numbers at the solution, m or rad; zero if it holds exactly.
        cost: chi-square that releasing it alone would save.
        degrees_of_freedom: number of independent numbers that it fixes; zero if the other
            constraints imply it.
        p_value: probability of such a cost if the constraint is true.
        contradicts: whether it contradicts the pictures, at the false-alarm probability of the
            call.
        violated: whether it is exact and does not hold, because others contradict it.
    """

    constraint: AbstractConstraint
    residuals: Float[np.ndarray, "numbers"]
    cost: float
    degrees_of_freedom: int
    p_value: float
    contradicts: bool
    violated: bool

    def __str__(self) -> str:
        if self.violated:
            return f"{self.constraint} cannot hold together with the other exact constraints"
        return (
            f"{self.constraint} costs {self.cost:.1f} (chi-square of {self.degrees_of_freedom}), "
            f"p = {self.p_value:.2g}"
        )


def constraint_verdicts(
    problem: RefinementProblem, state: RefinementState, false_alarm: float
) -> tuple[tuple[ConstraintVerdict, ...], float]:
    """Return the verdict on every constraint, and the p-value of all of them together."""
    if not problem.constraints:
        return (), 1.0
    # All uncertain numbers are free here, even if they were fixed in the fit: a slightly wrong
    # calibration must not be mistaken for a wrong constraint.
    at = linearise(problem, state, np.ones(len(problem.free), dtype=bool))
    factors = at.system.factorised()
    _, rest = factors.solve(at.feature_right, at.reduced_right)
    multipliers = rest[factors.border_size :]
    information = -factors.reduced[factors.border_size :, factors.border_size :]
    picture_variance = at.system.variance_by_pictures(factors.features)
    # Bonferroni: the probabilities of all tests add up to at most the stated one.
    per_test = false_alarm / len(problem.constraints)
    verdicts = []
    for constraint, rows in zip(problem.constraints, at.rows, strict=True):
        cost, dof = _score(multipliers[rows], information[rows, rows], picture_variance[rows])
        p_value = float(chdtrc(dof, cost)) if dof else 1.0
        values = at.values[rows]
        # An exact constraint is violated only if other exact ones contradict it.
        tolerance = VIOLATION * np.sqrt(picture_variance[rows])
        violated = constraint.sigma is None and bool(np.any(np.abs(values) > tolerance))
        verdicts.append(
            ConstraintVerdict(constraint, values, cost, dof, p_value, p_value < per_test, violated)
        )
    cost, dof = _score(multipliers, information, picture_variance)
    return tuple(verdicts), float(chdtrc(dof, cost)) if dof else 1.0


def _score(
    multipliers: Float[np.ndarray, "rows"],
    information: Float[np.ndarray, "rows rows"],
    picture_variance: Float[np.ndarray, "rows"],
) -> tuple[float, int]:
    """Return the chi-square that releasing some rows saves, and its degrees of freedom."""
    # m^T (Cov m)^-1 m; the covariance of the multipliers is a block of the inverse matrix. In units
    # of the pictures' standard deviations its eigenvalues are one or more for independent rows and
    # zero for directions that an unknown plane absorbs; for redundant exact rows they are limited
    # by `EXACT_VARIANCE` alone.
    scale = np.sqrt(picture_variance)
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    used = (values > 1e-6) & (values < 1e-2 / EXACT_VARIANCE)
    # In the eigenvectors the quadratic form is a sum of squares of independent unit normals.
    parts = vectors.T @ (multipliers * scale)
    return float(np.sum(parts[used] ** 2 / values[used])), int(used.sum())


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RefinedFeatures(EstimatedPoints):
    """Refined points and lines, with their errors by cause.

    `picture_covariance` also includes the effect of the constraints and of the free numbers; the
    numbers of the calibration are the ones that were fixed.

    Attributes:
        lines: refined lines; NaN where `line_status` is not OK.
        line_status: a `PointStatus` for each line.
        line_covariance: covariance of each line's four numbers, as `picture_covariance`.
        verdicts: one for each constraint, in order.
        constraints_p_value: probability of the cost of all constraints together if they are true.
        result: whether it converged.
        posterior: the factorised equations, for covariances between features.
        point_rows: numbers of each point's coordinates among the unknowns of `posterior`.
    """

    lines: Lines
    line_status: np.ndarray
    line_covariance: Float[np.ndarray, "lines 4 4"]
    verdicts: tuple[ConstraintVerdict, ...]
    constraints_p_value: float
    result: FitResult
    posterior: Factorisation
    point_rows: Int[np.ndarray, "points 3"]

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
        return self.posterior.covariance(self.point_rows[np.asarray(points, dtype=int)].ravel())
