"""Find clicks and matches that belong to another feature, and name them by view and feature.

A wrong correspondence pulls its point towards itself, so that its own residual is smaller than its
error and the other residuals are larger. So every observation is compared with the point that all
*other* observations give. If all are right, the squared difference over its covariance is
chi-square; it also equals the reduction of the point's chi-square without the observation.

Reference: Cook and Weisberg, Residuals and influence in regression, 1982, section 2.2.
"""

from typing import NamedTuple, Unpack

import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import chdtrc

from ..robots import CommandLike
from .calibration_uncertainty import CalibrationUncertainty, UncertaintyOptions
from .estimated_features import PointStatus
from .pixel_jacobians import pixel_jacobians
from .rig_views import AnyCalibration
from .triangulation import CLICK_SIGMA, solve_points
from .view_poses import SeenViews, whitening_of

FALSE_ALARM_PROBABILITY = 0.01
"""Probability that any observation is called wrong although all are right."""


RELATIVE_EIGENVALUE_FLOOR = 1e-8
"""Smallest eigenvalue, over the trace of the whole matrix, that is not treated as zero."""


class WrongCorrespondence(NamedTuple):
    """An observation that contradicts the others of its feature.

    Attributes:
        view: index of the view.
        feature: index of the feature.
        distance: distance from the feature as seen by the other views, px; NaN for two views.
        chi_square: squared distance over its covariance.
        p_value: probability of so large a value if the correspondence is right.
        instead: views that may be the wrong one instead: without any of them, too, the rest agrees.
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
            away = f", {self.distance:.1f} px from where the other views see it"
        doubt = f"; or the one in view {others} is" if self.instead else ""
        place = f"feature {self.feature} in view {self.view}"
        return f"{place} is wrong{away} (p = {self.p_value:.1g}){doubt}"


def wrong_correspondences(
    calibration: AnyCalibration,
    poses: CommandLike | None,
    pixels: np.ndarray | Array,
    visible: np.ndarray | Array | None = None,
    *,
    pixel_sigma: float | np.ndarray = CLICK_SIGMA,
    false_alarm: float = FALSE_ALARM_PROBABILITY,
    **uncertainty: Unpack[UncertaintyOptions],
) -> list[WrongCorrespondence]:
    """Return the observations that contradict the others of their feature, the worst first.

    The worst observation of each feature is left out and the rest is checked again, as long as two
    views remain. Deviations explained by the uncertainty of the calibration and the robot are not
    reported.

    Args:
        calibration, poses, pixels, visible, pixel_sigma: as in `triangulate_points`.
        false_alarm: probability that any observation is named although all are right, by the bound
            of Bonferroni.
        uncertainty: `covariance` and `noise`, as in `triangulate_points`.

    Raises:
        ValueError: as in `triangulate_points`.
    """
    views = SeenViews.of(calibration, poses)
    measured, visible = views.checked_points(pixels, visible)
    known = CalibrationUncertainty.of(views, calibration, **uncertainty)
    whitening = np.broadcast_to(whitening_of(pixel_sigma, visible.shape), (*visible.shape, 2, 2))
    check = _Check(views, known, np.where(visible[..., None], measured, 0.0), whitening)
    per_test = false_alarm / max(int(visible.sum()), 1)

    remaining, wrong = visible.copy(), []
    # One at a time: a gross error inflates the statistics of its feature's other views.
    candidates = np.flatnonzero(remaining.sum(axis=0) >= 2).tolist()
    while candidates:
        deletions = _deletions(check, remaining, candidates)
        tests = [_worst(deletions[k], k, per_test) for k in candidates]
        worst = [test for test in tests if test is not None]
        wrong += worst
        for test in worst:
            remaining[test.view, test.feature] = False
        # When two views contradict each other nothing is left to compare with.
        candidates = [k.feature for k in worst if remaining[:, k.feature].sum() >= 2]
    return sorted(wrong, key=lambda w: w.p_value)


class _Check(NamedTuple):
    """The fixed parts of the check."""

    views: SeenViews
    uncertainty: CalibrationUncertainty
    pixels: Float[np.ndarray, "views points 2"]
    whitening: Float[np.ndarray, "views points 2 2"]


class _Deletion(NamedTuple):
    """The statistics for leaving out one view of a feature; NaN where nothing is compared.

    Attributes:
        chi_square: reduction of the feature's chi-square without the view.
        degrees_of_freedom: degrees of freedom of the reduction.
        rest: remaining chi-square without the view.
        rest_degrees_of_freedom: its degrees of freedom.
        distance: distance of the observation from the feature as seen by the other views, px.
    """

    view: int
    chi_square: float = np.nan
    degrees_of_freedom: int = 0
    rest: float = np.nan
    rest_degrees_of_freedom: int = 0
    distance: float = np.nan


def _deletions(
    check: _Check, visible: Bool[np.ndarray, "views points"], points: list[int]
) -> dict[int, list[_Deletion]]:
    """Return the statistics of points, each view's at the point that the other views give.

    Exact to first order about the point without the view, and so for gross errors too.
    """
    # One row for every observation to leave out; with only two views, none is left out.
    cases = [(k, v) for k in points for v in np.flatnonzero(visible[:, k]).tolist()]
    index = np.array([k for k, _ in cases])
    mask = visible[:, index].copy()
    for column, (k, v) in enumerate(cases):
        mask[v, column] = visible[:, k].sum() <= 2
    estimated, _, _, status = solve_points(
        check.views, check.pixels[:, index], check.whitening[:, index], mask
    )
    ok = status == PointStatus.OK
    # Where the other views do not determine the point there is nothing to compare with.
    middle = np.zeros(3) if not ok.any() else estimated[ok].mean(axis=0)
    jacobians = pixel_jacobians(check.views, np.where(ok[:, None], estimated, middle))
    sensitivity = np.einsum("vpul,vln->vpun", jacobians.by_view, check.uncertainty.view_jacobian)
    results: dict[int, list[_Deletion]] = {k: [] for k in points}
    for column, (k, v) in enumerate(cases):
        views = np.flatnonzero(visible[:, k])
        if not (ok[column] and jacobians.valid[views, column].all()):
            results[k].append(_Deletion(v))
            continue
        # r = J dx + A t + e with covariance R = C + A S A^T; all are whitened, so that C is the
        # identity.
        count, whitening = 2 * len(views), check.whitening[views, k]
        residual = check.pixels[views, k] - jacobians.pixels[views, column]
        r = np.einsum("vij,vj->vi", whitening, residual).ravel()
        J = (whitening @ jacobians.by_point[views, column]).reshape(count, 3)
        A = (whitening @ sensitivity[views, column]).reshape(count, sensitivity.shape[3])
        Q = least_chi_square_matrix(np.eye(count) + A @ check.uncertainty.covariance @ A.T, J)
        place = int(np.flatnonzero(views == v)[0])
        without = deletion_of(Q, r, place)
        distance = float(np.linalg.norm(residual[place])) if len(views) > 2 else np.nan
        freedom = count - 3 - without.degrees_of_freedom
        results[k].append(_Deletion(v, *without, freedom, distance))
    return results


def _worst(deletions: list[_Deletion], feature: int, per_test: float) -> WrongCorrespondence | None:
    """Return the worst observation of a feature, if chance does not explain it."""
    views, chi_square, freedom, rest, rest_freedom, _ = map(np.array, zip(*deletions, strict=True))
    known = np.isfinite(chi_square) & (freedom > 0)
    p_values = np.where(known, chdtrc(np.maximum(freedom, 1), chi_square), 1.0)
    if not p_values.min() < per_test:
        return None
    # The observation whose removal leaves the smallest chi-square; ties of two views go to the
    # first. Without it the others must agree; if the removal of another one does as well, both are
    # suspects.
    redundant = known & (rest_freedom > 0)
    rest_p = np.where(redundant, chdtrc(np.maximum(rest_freedom, 1), rest), 1.0)
    best = int(np.argmin(np.where(known & (p_values < per_test), rest, np.inf)))
    agrees = known & (rest_p >= per_test) & (np.arange(len(deletions)) != best)
    return WrongCorrespondence(
        deletions[best].view,
        feature,
        deletions[best].distance,
        deletions[best].chi_square,
        float(p_values[best]),
        tuple(views[agrees].tolist()),
    )


class ClickDeletion(NamedTuple):
    """The squared residuals of a click and of the others, over their covariance.

    Attributes:
        chi_square: decrease without the click.
        degrees_of_freedom: numbers of the click that the others predict, up to two.
        rest: what remains.
    """

    chi_square: float
    degrees_of_freedom: int
    rest: float


def least_chi_square_matrix(
    R: Float[np.ndarray, "rows rows"], J: Float[np.ndarray, "rows unknowns"]
) -> Float[np.ndarray, "rows rows"]:
    """Return the matrix Q of the least chi-square over all unknowns, `r^T Q r`.

    R is the covariance of the residuals r, and J their derivatives by the unknowns.
    """
    # Q = R^-1 - R^-1 J (J^T R^-1 J)^-1 J^T R^-1
    inverse = np.linalg.inv(R)
    RJ = inverse @ J
    return inverse - RJ @ np.linalg.pinv(J.T @ RJ, hermitian=True) @ RJ.T


def deletion_of(
    Q: Float[np.ndarray, "rows rows"], r: Float[np.ndarray, "rows"], click: int
) -> ClickDeletion:
    """Return the effect of leaving out one click, two rows of the residuals r, to first order.

    Reference: Cook and Weisberg, Residuals and influence in regression, 1982, section 2.2.
    """
    # Without the rows i of a click r^T Q r is less by (Q r)_i^T Q_ii^-1 (Q r)_i.
    rows = slice(2 * click, 2 * click + 2)
    values, vectors = np.linalg.eigh(Q[rows, rows])
    used = values > RELATIVE_EIGENVALUE_FLOOR * max(np.trace(Q), 1e-300)
    parts = vectors.T @ (Q @ r)[rows]
    chi_square = float(np.sum(parts[used] ** 2 / values[used]))
    rest = max(float(r @ Q @ r) - chi_square, 0.0)
    return ClickDeletion(chi_square, int(used.sum()), rest)
