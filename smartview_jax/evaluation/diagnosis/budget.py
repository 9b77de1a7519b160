"""Divide the error of the chain without correction among its causes, and recommend what to do."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ...dataset import MINIMUM_RELIABLE_VIEWS, Dataset
from ...joint import JointFit
from ...robot_errors import AbstractField, CombinedField, GenericSixAxisArm
from ..held_out import expected_squared_errors, has_correction
from ..measures import reprojection_errors
from ..rejections import without_rejected_views
from .lens_misfit import lens_misfit
from .scale_hypotheses import (
    ScaleHypothesis,
    fit_scale_hypothesis,
    region_held_out_rms,
    rms_displacement,
    scale_hypotheses,
    target_scale_differs,
)

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

MIN_FIELD_FRACTION = 0.5
"""The fraction of a field's log-likelihood ratio that an accepted hypothesis must reach."""

MIN_LOG_LIKELIHOOD_RATIO = 10.0
"""The decrease of the deviance above which a scale hypothesis is accepted."""

MIN_SECOND_CAUSE_FRACTION = 0.5
"""The fraction of the dominant cause's RMS above which the next cause gets its own sentence."""

RECOMMENDED_VIEWS = 15
"""The number of views from which the variance components are known to 15 %."""

MIN_ADVICE_FRACTION = 0.1
"""The fraction of the largest cause's RMS below which no advice on a cause is given."""


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


def error_budget(
    data: Dataset,
    fit: JointFit,
    progress: Callable[[str], None] | None = None,
    held_out_by_region: bool = False,
) -> ErrorBudget:
    """Divide the error of the uncorrected chain among its causes.

    The errors of pixels, poses and parameters are the fit's standard deviations, propagated through
    the projection; the systematic error is the displacement by the correction, and the lens misfit
    is the smooth pattern of residuals when every view has a free pose. Views that the fit left out
    do not count. If the fit's field is a `GenericSixAxisArm`, a fit with a field linear in the pose
    gives the chain.

    Args:
        data: the data set that `fit` was fitted to.
        fit: a joint fit with `noise="estimated"`, such as the `.joint` of a `calibrate` result.
        progress: called with a line of text for each step.
        held_out_by_region: also cross-validate each hypothesis by region of the workspace: five
            further fits for each.

    Raises:
        ValueError: the fit's noise was not estimated, or its data leave a parameter undetermined.

    For example:

        >>> sv.error_budget(data, sv.calibrate(data).joint).dominant_cause  # doctest: +SKIP
        'robot noise'
    """
    if fit.noise_estimate is None:
        raise ValueError('an error budget needs a fit with noise="estimated"')
    data = without_rejected_views(data, fit)
    views, uses_fitted_chain = len(data.usable_views()), True
    hypotheses = scale_hypotheses(data, fit, progress) if views >= MINIMUM_RELIABLE_VIEWS else ()
    if held_out_by_region:
        # Held-out error by region tests whether a hypothesis extrapolates; likelihood does not.
        hypotheses = tuple(
            hypothesis._replace(region_rms=region_held_out_rms(data, fit, hypothesis.name))
            for hypothesis in hypotheses
        )
    accepted = _accepted_hypothesis(hypotheses, target_scale_differs(fit))
    chain = None
    if accepted is not None and not has_correction(fit):
        # The fit has no field, but a hypothesis is more probable, so the budget is for its fit.
        fit = accepted.fit
    elif accepted is not None and target_scale_differs(fit):
        # In this chain neither the target's size nor the robot's errors are corrected.
        chain = accepted.fit.calibration.uncorrected
    if _has_generic_arm(fit.calibration.field):
        # Link lengths of a generic arm are correlated with the mount: without the correction its
        # chain has no meaning.
        fit = fit_scale_hypothesis(data, fit, None, field_group_count=4)
        uses_fitted_chain = False
    visible = np.asarray(data.visible)
    # Mean squared errors, px^2, over the visible points.
    squares = expected_squared_errors(fit, data)
    parameters, pixels, poses = (float(np.mean(square[visible])) for square in squares)
    lens_rms = lens_misfit(fit.calibration, data, np.asarray(fit.inliers))
    systematic_rms = rms_displacement(fit.calibration, data)
    # Alone, the hypothesis may displace points farther than the chosen field does.
    scale_rms = 0.0 if accepted is None else accepted.rms_displacement
    if chain is None:
        scale_rms = min(scale_rms, systematic_rms)
        # The scale error is a part of the systematic error: total^2 = remaining^2 + scale_rms^2.
        systematic_rms = np.sqrt(systematic_rms**2 - scale_rms**2)
        chain = fit.calibration.uncorrected
    # The lens pattern is part of the pixel noise that the fit states, hence the subtraction.
    rms_by_cause = {
        PIXEL_NOISE: np.sqrt(max(pixels - lens_rms**2, 0.0)),
        LENS_MISFIT: lens_rms,
        ROBOT_NOISE: np.sqrt(poses),
        SCALE_ERROR: scale_rms,
        SYSTEMATIC_ROBOT_ERROR: systematic_rms,
        TOO_FEW_VIEWS: np.sqrt(parameters),
    }
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
            n, float(rms_by_cause[n]), _advice(n, fit, views, hypotheses) if n in advised else ""
        )
        for n in ranked
    )
    total = reprojection_errors(chain, data).rms
    summary = _summary(total, causes, dominant_cause, uses_fitted_chain)
    return ErrorBudget(total, causes, hypotheses, dominant_cause, summary, uses_fitted_chain)


def _accepted_hypothesis(
    hypotheses: tuple[ScaleHypothesis, ...], scale_differs: bool
) -> ScaleHypothesis | None:
    """Return the more probable hypothesis, if it explains most of the smooth error.

    Args:
        hypotheses: both hypotheses; empty if they were not compared.
        scale_differs: whether the fit estimated the target's size; this excludes a robot stretch.
    """
    if scale_differs:
        hypotheses = tuple(h for h in hypotheses if h.name == "target scale")
    if not hypotheses:
        return None
    best = max(hypotheses, key=lambda hypothesis: hypothesis.log_likelihood_ratio)
    minimum = max(MIN_LOG_LIKELIHOOD_RATIO, MIN_FIELD_FRACTION * best.field_log_likelihood_ratio)
    return best if best.log_likelihood_ratio >= minimum else None


def _has_generic_arm(field: AbstractField | None) -> bool:
    """Return whether the field is, or contains, a generic six-axis arm's."""
    fields = (field.first, field.second) if isinstance(field, CombinedField) else (field,)
    return any(isinstance(component, GenericSixAxisArm) for component in fields)


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


def _advice(name: str, fit: JointFit, views: int, hypotheses: tuple[ScaleHypothesis, ...]) -> str:
    """Return the recommended action for a cause."""
    if name == SCALE_ERROR and hypotheses:
        return _target_measurement_advice(hypotheses)
    assert fit.noise is not None
    millimetres, degrees = 1e3 * fit.noise.translation, np.rad2deg(fit.noise.rotation)
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
