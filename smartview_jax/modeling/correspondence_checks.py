"""Find clicks and matches that belong to another feature, and name them by view and feature.

A wrong correspondence pulls its point towards itself, so that its own residual is smaller than its
error and those of the others are larger. So every observation is compared with the point that all
*others* give. If all is right, the squared difference over its covariance is chi-square; it also
equals what the chi-square of the whole point would lose without the observation.

Reference: Cook and Weisberg, Residuals and influence in regression, 1982, section 2.2.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import chdtrc

from ..calibration import Calibration
from ..engine import Noise
from ..evaluation import CalibrationEstimate
from ..robots import CommandLike
from .calibration_uncertainty import CalibrationUncertainty
from .pixel_jacobians import pixel_jacobians
from .point_status import PointStatus
from .triangulation import CLICK_SIGMA, solve_points
from .view_poses import SeenViews, whitening_of

FALSE_ALARM_PROBABILITY = 0.01
"""Probability that any observation is named wrong although all are right."""

RELATIVE_EIGENVALUE_FLOOR = 1e-8
"""Smallest eigenvalue, over the trace of the whole matrix, that does not count as zero."""


class WrongCorrespondence(NamedTuple):
    """An observation that contradicts the others of its feature.

    Attributes:
        view: index of the view.
        feature: index of the feature.
        distance: distance from where the other views see the feature, px; NaN for two views.
        chi_square: squared distance over its covariance.
        p_value: probability of so large a value if the correspondence is right.
        instead: views any of which may be the wrong one instead: without it, too, the rest agrees.
    """

    view: int
    feature: int
    distance: float
    chi_square: float
    p_value: float
    instead: tuple[int, ...]

    def __str__(self) -> str:
        away, others = "", ", ".join(map(str, self.instead))
        if np.isfinite(self.distance):
            away = f", {self.distance:.1f} px from where the others see it"
        doubt = f"; or it is the one in view {others}" if self.instead else ""
        place = f"feature {self.feature} in view {self.view}"
        return f"{place} is wrong{away} (p = {self.p_value:.1g}){doubt}"


def wrong_correspondences(
    calibration: Calibration,
    poses: CommandLike,
    pixels: np.ndarray | Array,
    visible: np.ndarray | Array | None = None,
    *,
    covariance: CalibrationEstimate | None = None,
    noise: Noise | None = None,
    pixel_sigma: float | np.ndarray = CLICK_SIGMA,
    false_alarm: float = FALSE_ALARM_PROBABILITY,
) -> list[WrongCorrespondence]:
    """Return the observations that contradict the others of their feature, the worst first.

    The worst of each feature is left out, and what remains is checked again, as long as two views
    remain. The uncertainty of the calibration and of the robot counts: what they explain is not
    named.

    Args:
        calibration, poses, pixels, visible, covariance, noise, pixel_sigma: as in
            `triangulate_points`.
        false_alarm: probability that any observation is named although all are right, by the bound
            of Bonferroni.

    Raises:
        ValueError: as in `triangulate_points`.
    """
    views = SeenViews.of(calibration, poses)
    measured, seen = views.checked_points(pixels, visible)
    uncertainty = CalibrationUncertainty.of(views, calibration, covariance, noise)
    whitening = np.broadcast_to(whitening_of(pixel_sigma, seen.shape), (*seen.shape, 2, 2))
    check = _Check(views, uncertainty, np.where(seen[..., None], measured, 0.0), whitening)
    per_test = false_alarm / max(int(seen.sum()), 1)
    left, found = seen.copy(), []
    # One at a time: a gross error inflates the statistics of all other views of its feature.
    candidates = np.flatnonzero(left.sum(axis=0) >= 2)
    while len(candidates):
        named = [_worst(one, int(k), per_test) for k, one in check.deletions(left, candidates)]
        worst = [one for one in named if one is not None]
        found += worst
        for one in worst:
            left[one.view, one.feature] = False
        # Two views that contradict each other leave nothing to compare with.
        candidates = np.array(
            [k.feature for k in worst if left[:, k.feature].sum() >= 2], dtype=int
        )
    return sorted(found, key=lambda one: one.p_value)


class _Deletions(NamedTuple):
    """The statistics of leaving out each view of one feature.

    Attributes:
        views: the views that see it.
        chi_square: loss of the feature's chi-square without each.
        degrees_of_freedom: degrees of freedom of each loss.
        rest: chi-square of what remains without each.
        rest_degrees_of_freedom: its degrees of freedom.
        distance: distance of each from where the others see the feature, px.
    """

    views: np.ndarray
    chi_square: Float[np.ndarray, "views"]
    degrees_of_freedom: np.ndarray
    rest: Float[np.ndarray, "views"]
    rest_degrees_of_freedom: np.ndarray
    distance: Float[np.ndarray, "views"]


class _Check(NamedTuple):
    """The fixed parts of the check."""

    views: SeenViews
    uncertainty: CalibrationUncertainty
    pixels: Float[np.ndarray, "views points 2"]
    whitening: Float[np.ndarray, "views points 2 2"]

    def deletions(
        self, seen: Bool[np.ndarray, "views points"], points: np.ndarray
    ) -> list[tuple[int, _Deletions]]:
        """Return the statistics of some points; each view's are taken at the point of the others.

        Exact to first order about the point without the view, and so for gross errors too.
        """
        # One row for every observation to leave out; with two views, for the pair as it is.
        cases = [(k, v) for k in points for v in np.flatnonzero(seen[:, k])]
        index = np.array([k for k, _ in cases])
        mask = seen[:, index].copy()
        for column, (k, v) in enumerate(cases):
            mask[v, column] = seen[:, k].sum() <= 2
        found, _, _, status = solve_points(
            self.views, self.pixels[:, index], self.whitening[:, index], mask
        )
        ok = status == PointStatus.OK
        # Where the others do not determine the point there is nothing to compare with.
        middle = np.zeros(3) if not ok.any() else found[ok].mean(axis=0)
        jacobians = pixel_jacobians(self.views, np.where(ok[:, None], found, middle))
        sensitivity = np.einsum("vpul,vln->vpun", jacobians.by_view, self.uncertainty.view_jacobian)
        results: dict[int, list] = {int(k): [] for k in points}
        for column, (k, v) in enumerate(cases):
            views = np.flatnonzero(seen[:, k])
            residual = (self.pixels[:, k] - jacobians.pixels[:, column])[views]
            usable = ok[column] and bool(jacobians.valid[views, column].all())
            entry = (v, np.nan, 0, np.nan, 0, np.nan)
            if usable:
                entry = (v, *self._deletion(
                    views, int(np.flatnonzero(views == v)[0]), residual,
                    jacobians.by_point[views, column], sensitivity[views, column],
                    self.whitening[views, k],
                ))  # fmt: skip
            results[int(k)].append(entry)
        return [
            (k, _Deletions(*map(np.array, zip(*entries, strict=True))))
            for k, entries in results.items()
        ]

    def _deletion(
        self,
        views: np.ndarray,
        place: int,
        residual: Float[np.ndarray, "seen 2"],
        by_point: Float[np.ndarray, "seen 2 3"],
        by_number: Float[np.ndarray, "seen 2 numbers"],
        whitening: Float[np.ndarray, "seen 2 2"],
    ) -> tuple[float, int, float, int, float]:
        """Return the statistics of leaving out one view of a feature."""
        # r = J dx + A t + e with covariance R = C + A S A^T. With
        #     Q = R^-1 - R^-1 J (J^T R^-1 J)^-1 J^T R^-1
        # the chi-square is r^T Q r, and without the rows i it is less by (Q r)_i^T Q_ii^-1 (Q r)_i.
        count = 2 * len(views)
        L = np.zeros((count, count))
        for k in range(len(views)):
            L[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = whitening[k]
        r = L @ residual.ravel()
        J = L @ by_point.reshape(count, 3)
        # Whitened, so that C is the identity.
        A = L @ by_number.reshape(count, by_number.shape[2])
        inverse = np.linalg.inv(np.eye(count) + A @ self.uncertainty.covariance @ A.T)
        RJ = inverse @ J
        Q = inverse - RJ @ np.linalg.pinv(J.T @ RJ, hermitian=True) @ RJ.T
        rows = slice(2 * place, 2 * place + 2)
        values, vectors = np.linalg.eigh(Q[rows, rows])
        used = values > RELATIVE_EIGENVALUE_FLOOR * max(np.trace(Q), 1e-300)
        parts = vectors.T @ (Q @ r)[rows]
        chi_square = float(np.sum(parts[used] ** 2 / values[used]))
        degrees_of_freedom = int(used.sum())
        rest = max(float(r @ Q @ r) - chi_square, 0.0)
        distance = float(np.linalg.norm(residual[place])) if len(views) > 2 else np.nan
        return chi_square, degrees_of_freedom, rest, count - 3 - degrees_of_freedom, distance


def _worst(one: _Deletions, feature: int, per_test: float) -> WrongCorrespondence | None:
    """Return the worst observation of a feature, if chance does not explain it."""
    p_values = np.ones(len(one.views))
    known = np.isfinite(one.chi_square) & (one.degrees_of_freedom > 0)
    p_values[known] = chdtrc(one.degrees_of_freedom[known], one.chi_square[known])
    if not p_values.min() < per_test:
        return None
    # The one whose absence leaves the least contradiction; ties of two views go to the first.
    # With the worst one gone the others must agree; where another's absence does as well, both
    # stay suspects.
    rest_p = np.ones(len(one.views))
    redundant = known & (one.rest_degrees_of_freedom > 0)
    rest_p[redundant] = chdtrc(one.rest_degrees_of_freedom[redundant], one.rest[redundant])
    order = np.where(known & (p_values < per_test), one.rest, np.inf)
    best = int(np.argmin(order))
    agrees = known & (rest_p >= per_test) & (np.arange(len(one.views)) != best)
    return WrongCorrespondence(
        int(one.views[best]),
        feature,
        float(one.distance[best]),
        float(one.chi_square[best]),
        float(p_values[best]),
        tuple(int(v) for v in one.views[agrees]),
    )
