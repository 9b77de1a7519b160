"""Name the causes of a chain's error, measure each of them, and recommend what to do."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ...calibration import Calibration
from ...dataset import MINIMUM_RELIABLE_VIEWS, Dataset
from ...engine import Noise
from ...joint import SavedEstimate
from ...robot_errors import AbstractField, CombinedField, GenericSixAxisArm
from ..free_poses import free_pose_predictions
from ..held_out import expected_squared_errors
from .scale_hypotheses import ScaleHypothesis, rms_displacement

PIXEL_NOISE = "pixel noise"
"""The name of the cause: noise of pixels."""
LENS_MISFIT = "lens"
"""The name of the cause: a lens that its model does not describe."""
ROBOT_NOISE = "robot noise"
"""The name of the cause: independent errors of reported poses."""
SYSTEMATIC_ROBOT_ERROR = "robot's systematic error"
"""The name of the cause: the smooth error of the robot."""
SCALE_ERROR = "target scale or robot stretch"
"""The name of the cause: a wrong size of the target, or a wrong scale of the robot's motion."""
TOO_FEW_VIEWS = "too few views"
"""The name of the cause: uncertainty of the parameters."""

MIN_SECOND_CAUSE_FRACTION = 0.5
"""The fraction of the dominant cause's RMS above which the next cause gets its own sentence."""

RECOMMENDED_VIEWS = 15
"""The number of views from which the variance components are known to 15 %."""

MIN_ADVICE_FRACTION = 0.1
"""The fraction of the largest cause's RMS below which no advice on a cause is given."""


POLYNOMIAL_DEGREE = 5
"""The degree of the polynomials in u and v of the pattern: one more than common lens models'."""


class ErrorCause(NamedTuple):
    """A cause of error, with its contribution and the advice against it.

    Attributes:
        name: name of the cause.
        rms: RMS error, px, due to it alone in the uncorrected chain; squares of causes add up.
        advice: recommended action; empty if it would gain little.
    """

    name: str
    rms: float
    advice: str


class ErrorBudget(NamedTuple):
    """The error of the chain without its correction, divided among its causes.

    Attributes:
        total_rms: RMS reprojection error of the uncorrected chain, px.
        causes: causes, the largest first.
        scale_hypotheses: hypotheses that explain the robot's smooth error by one number; empty
            if there is no such error or too few views.
        dominant_cause: name of the cause to address first.
        summary: recommended action, in a sentence or two.
        uses_fitted_chain: whether the uncorrected chain is the fit's own; if the fit's field is a
            `GenericSixAxisArm`, the chain of a fit with a field linear in the pose is used instead.
    """

    total_rms: float
    causes: tuple[ErrorCause, ...]
    scale_hypotheses: tuple[ScaleHypothesis, ...]
    dominant_cause: str
    summary: str
    uses_fitted_chain: bool = True


def rms_of_causes(
    estimate: SavedEstimate, data: Dataset, inliers: Bool[np.ndarray, "views points"]
) -> dict[str, float]:
    """Return the RMS error of the uncorrected chain, px, due to each cause alone.

    Args:
        estimate: a fit's calibration, with its covariance and noise.
        data: the views that were fitted.
        inliers: the points that count for the lens misfit.

    Raises:
        ValueError: the data leave a parameter undetermined.
    """
    visible = np.asarray(data.visible)
    # Mean squared errors, px^2, over the visible points.
    squares = expected_squared_errors(estimate, data)
    parameters, pixels, poses = (float(np.mean(square[visible])) for square in squares)
    lens_rms = lens_misfit(estimate.calibration, data, inliers)
    # The lens pattern is part of the pixel noise that the fit states, hence the subtraction.
    return {
        PIXEL_NOISE: float(np.sqrt(max(pixels - lens_rms**2, 0.0))),
        LENS_MISFIT: lens_rms,
        ROBOT_NOISE: float(np.sqrt(poses)),
        SYSTEMATIC_ROBOT_ERROR: rms_displacement(estimate.calibration, data),
        TOO_FEW_VIEWS: float(np.sqrt(parameters)),
    }


def ranked_budget(
    total_rms: float,
    rms_by_cause: dict[str, float],
    noise: Noise,
    views: int,
    hypotheses: tuple[ScaleHypothesis, ...] = (),
    uses_fitted_chain: bool = True,
) -> ErrorBudget:
    """Return the budget of some causes, the largest first, with advice.

    Args:
        total_rms: RMS reprojection error of the uncorrected chain, px.
        rms_by_cause: RMS error due to each cause, px.
        noise: the fit's noise.
        views: number of usable views.
        hypotheses: as in `ErrorBudget`; `uses_fitted_chain` too.
        uses_fitted_chain: see `hypotheses`.
    """
    ranked = sorted(rms_by_cause, key=lambda name: -rms_by_cause[name])
    # With few views no cause is determined reliably, so more views come first.
    dominant_cause = TOO_FEW_VIEWS if views < MINIMUM_RELIABLE_VIEWS else ranked[0]
    advised = [
        n
        for n in ranked
        if n == dominant_cause or rms_by_cause[n] >= MIN_ADVICE_FRACTION * rms_by_cause[ranked[0]]
    ]
    causes = tuple(
        ErrorCause(
            n, float(rms_by_cause[n]), _advice(n, noise, views, hypotheses) if n in advised else ""
        )
        for n in ranked
    )
    summary = _summary(total_rms, causes, dominant_cause, uses_fitted_chain)
    return ErrorBudget(total_rms, causes, hypotheses, dominant_cause, summary, uses_fitted_chain)


def _summary(
    total_rms: float, causes: tuple[ErrorCause, ...], dominant_cause: str, uses_fitted_chain: bool
) -> str:
    """Return the budget's summary and advice in one or two sentences."""
    cause_by_name = {cause.name: cause for cause in causes}
    dominant = cause_by_name[dominant_cause]
    text = f"Of {total_rms:.3g} px RMS of the chain without correction"
    text += ", " if uses_fitted_chain else " (with a field linear in the pose instead of the arm), "
    text += f"{dominant.name} is {dominant.rms:.3g} px: {dominant.advice}."
    runner_up = next(cause for cause in causes if cause.name != dominant_cause)
    if runner_up.rms > MIN_SECOND_CAUSE_FRACTION * dominant.rms:
        text += f" Then {runner_up.name}, {runner_up.rms:.3g} px: {runner_up.advice}."
    return text


def _advice(name: str, noise: Noise, views: int, hypotheses: tuple[ScaleHypothesis, ...]) -> str:
    """Return the recommended action for a cause."""
    if name == SCALE_ERROR and hypotheses:
        return _target_measurement_advice(hypotheses)
    millimetres, degrees = 1e3 * noise.translation, np.rad2deg(noise.rotation)
    more = "more" if views >= RECOMMENDED_VIEWS else f"{RECOMMENDED_VIEWS} at least"
    return {
        PIXEL_NOISE: "sharper pictures, steady light, a larger or better printed target",
        LENS_MISFIT: "the lens model does not describe all of the distortion: try a richer model",
        ROBOT_NOISE: f"independent pose errors of {millimetres:.3f} mm and {degrees:.4f} deg: wait "
        "until the arm stands still, approach from one side, check the clocks; more views help",
        SCALE_ERROR: "measure the board",
        SYSTEMATIC_ROBOT_ERROR: "keep the correction when predicting and commanding, or have the "
        "robot calibrated; without either, work near the views",
        TOO_FEW_VIEWS: f"the parameters are uncertain with {views} views: take {more}, with "
        "different directions, distances and rolls about the optical axis",
    }[name]


def _target_measurement_advice(hypotheses: tuple[ScaleHypothesis, ...]) -> str:
    """Return the advice to measure the target, with the scales that explain the error."""
    hypothesis_by_name = {hypothesis.name: hypothesis for hypothesis in hypotheses}
    target, robot = hypothesis_by_name["target scale"], hypothesis_by_name["robot stretch"]
    return (
        "measure the board: either the target is "
        f"{target.scale:.4f} +- {target.std:.4f} times its stated size, or the robot moves "
        f"{robot.scale:.4f} +- {robot.std:.4f} times as far as it reports; the likelihood cannot "
        f"tell (deviance decreases by {target.log_likelihood_ratio:.0f} or "
        f"{robot.log_likelihood_ratio:.0f}), but arms are usually right to half a percent"
    )


def has_generic_arm(field: AbstractField | None) -> bool:
    """Return whether the field is, or contains, a generic six-axis arm's."""
    fields = (field.first, field.second) if isinstance(field, CombinedField) else (field,)
    return any(isinstance(component, GenericSixAxisArm) for component in fields)


def lens_misfit(
    calibration: Calibration, data: Dataset, used: Bool[np.ndarray, "views points"]
) -> float:
    """Return the RMS over points of the smooth pattern of residuals over the image, px.

    With a free pose for every view, the errors of the chain vanish. Pixel noise has no pattern;
    similar residuals of neighbouring points in all views mean that the lens model is wrong. The
    expected contribution of noise is subtracted; zero if nothing remains, or if there are too few
    points to estimate the noise.

    Args:
        calibration: its camera and target scale are used, its chain only for initial poses.
        data: points and pixels.
        used: which of the visible points to use; rejected points are excluded.
    """
    data = data.with_visible(np.asarray(data.visible) & used)
    predicted, valid, _ = free_pose_predictions(calibration, data)
    used = np.asarray(data.visible) & np.asarray(valid)
    residual = np.asarray(data.pixels)[used] - np.asarray(predicted)[used]
    design = _legendre_basis(np.asarray(predicted)[used], calibration.camera.image_size)
    count, term_count = design.shape
    # Degrees of freedom: two per point, less two per polynomial and six per view's pose.
    degrees_of_freedom = 2 * (count - term_count) - 6 * int(used.any(axis=1).sum())
    if degrees_of_freedom < count:
        return 0.0
    # E|Q^T r|^2 = |pattern|^2 + 2 term_count noise_variance, with Q an orthonormal basis of the
    # polynomials and noise_variance = (|r|^2 - |Q^T r|^2) / degrees_of_freedom.
    orthonormal, _ = np.linalg.qr(design)
    explained_sum_of_squares = np.sum((orthonormal.T @ residual) ** 2)
    noise_variance = (np.sum(residual**2) - explained_sum_of_squares) / degrees_of_freedom
    return float(
        np.sqrt(max(explained_sum_of_squares - 2 * term_count * noise_variance, 0.0) / count)
    )


def _legendre_basis(
    pixels: Float[np.ndarray, "points 2"], image_size: tuple[int, int]
) -> Float[np.ndarray, "points terms"]:
    """Return products of Legendre polynomials of u and v up to total degree `POLYNOMIAL_DEGREE`.

    Both are scaled to -1..1 on the image.
    """
    normalised = 2.0 * pixels / np.array(image_size, dtype=float) - 1.0
    products = np.polynomial.legendre.legvander2d(
        normalised[:, 0], normalised[:, 1], [POLYNOMIAL_DEGREE, POLYNOMIAL_DEGREE]
    )
    # `legvander2d` limits the degree in u and in v each; products of a higher total are left out.
    degrees = range(POLYNOMIAL_DEGREE + 1)
    u_degree, v_degree = np.meshgrid(degrees, degrees, indexing="ij")
    return products[:, (u_degree + v_degree).ravel() <= POLYNOMIAL_DEGREE]
