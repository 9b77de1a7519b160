"""Divide the error of the chain without correction among its causes, and recommend what to do."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ...dataset import Dataset
from ...joint import JointFit
from ...robot_errors import AbstractField, CombinedField, ImpliedArm
from ...variance import MINIMUM_RELIABLE_VIEWS
from ..held_out import expected_squares, has_correction
from ..measures import deviations
from ..rejections import without_rejected_views
from .explanations import Explanation, explanations, fit_candidate, moved, region_error, scale_found
from .lens_misfit import lens_misfit

PIXELS = "pixel noise"
"""The name of the cause: noise of pixels."""
LENS = "lens"
"""The name of the cause: a lens that its model does not describe."""
NOISE = "robot noise"
"""The name of the cause: independent errors of reported poses."""
SYSTEMATIC = "robot's systematic error"
"""The name of the cause: the smooth error of the robot."""
SCALE = "target scale or robot stretch"
"""The name of the cause: a wrong target size, or a stretch of the robot's motion."""
VIEWS = "too few views"
"""The name of the cause: uncertainty of the parameters."""

MOST = 0.5
"""The fraction of a field's gain above which one number explains the robot's smooth error."""

GAINED = 10.0
"""The smallest gain in deviance for which that number is accepted."""

ALSO = 0.5
"""The fraction of the largest part above which the second gets a sentence of its own."""

ENOUGH = 15
"""The number of views from which the variance components are known to 15 %."""

LITTLE = 0.1
"""The fraction of the largest part below which no advice on a cause is given."""


class Part(NamedTuple):
    """One cause of error.

    Attributes:
        name: name of the cause.
        px: RMS that it alone has in the uncorrected chain; the parts add up in squares.
        advice: recommended action; empty where that would gain little.
    """

    name: str
    px: float
    advice: str


class ErrorBudget(NamedTuple):
    """The error of the chain without its correction, divided among its causes.

    Attributes:
        total: RMS reprojection error of the uncorrected chain, px.
        parts: causes, the largest first.
        explanations: alternatives that explain the robot's smooth error by one number; empty where
            there is no such error or too few views.
        culprit: name of the cause to address first.
        words: recommended action, in a sentence or two.
        own_chain: whether the uncorrected chain is the fit's own; otherwise it is that of a field
            linear in the pose, used where the fit has the field of an arm that was not described.
    """

    total: float
    parts: tuple[Part, ...]
    explanations: tuple[Explanation, ...]
    culprit: str
    words: str
    own_chain: bool = True


def error_budget(
    data: Dataset,
    fit: JointFit,
    progress: Callable[[str], None] | None = None,
    regions: bool = False,
) -> ErrorBudget:
    """Divide the error of the uncorrected chain among its causes.

    Pixels, poses and parameters have the sizes that the fit states, propagated through the
    projection; the systematic error is what the correction changes, and the lens part is the smooth
    pattern left in the image when every view has its own pose. Views that the fit left out do not
    count. With the field of an arm that was not described, the chain is that of a field linear in
    the pose.

    Args:
        data: the data set that `fit` was fitted to.
        fit: with `noise="estimated"`; what `calibrate` returns has it as `.joint`.
        progress: called with a line of text for each step.
        regions: also find how well each explanation predicts regions of the workspace that it never
            used: five further fits for each.

    Raises:
        ValueError: the fit's noise was not estimated, or its data leave a parameter undetermined.
    """
    if fit.estimate is None:
        raise ValueError('an error budget needs a fit with noise="estimated"')
    data = without_rejected_views(data, fit)
    views, own_chain = len(data.usable_views()), True
    rivals = explanations(data, fit, progress) if views >= MINIMUM_RELIABLE_VIEWS else ()
    if regions:
        # Held-out error by region tests whether an explanation extrapolates, which likelihood does
        # not.
        rivals = tuple(
            rival._replace(region_px=region_error(data, fit, rival.name)) for rival in rivals
        )
    scale, chain = _one_number(rivals, scale_found(fit)), None
    if scale is not None and not has_correction(fit):
        # A plausible alternative to a fit without a field: the budget is of the more probable one.
        fit = scale.fit
    elif scale is not None and scale_found(fit):
        # The chain has neither the target's size nor the robot's errors corrected.
        chain = scale.fit.calibration.uncorrected
    if _has_undescribed_arm(fit.calibration.field):
        # Link lengths of an undescribed arm are correlated with the mount: without the correction
        # its chain has no meaning.
        fit, own_chain = fit_candidate(data, fit, None, field_groups=4), False
    seen = np.asarray(data.visible)
    squares = expected_squares(fit, data)
    parameters, pixels, poses = (float(np.mean(square[seen])) for square in squares)
    lens = lens_misfit(fit.calibration, data, np.asarray(fit.inliers))
    systematic = moved(fit.calibration, data)
    # As the only systematic error, it may displace points farther than the chosen field does.
    by_scale = 0.0 if scale is None else scale.px
    if chain is None:
        by_scale = min(by_scale, systematic)
        # The parts are quadratic: systematic^2 = remaining^2 + by_scale^2.
        systematic, chain = np.sqrt(systematic**2 - by_scale**2), fit.calibration.uncorrected
    # The lens pattern is part of the pixel noise that the fit states, hence the subtraction.
    sizes = {
        PIXELS: np.sqrt(max(pixels - lens**2, 0.0)),
        LENS: lens,
        NOISE: np.sqrt(poses),
        SCALE: by_scale,
        SYSTEMATIC: systematic,
        VIEWS: np.sqrt(parameters),
    }
    order = sorted(sizes, key=lambda name: -sizes[name])
    # With few views no part is reliable, so more views come first.
    culprit = VIEWS if views < MINIMUM_RELIABLE_VIEWS else order[0]
    worth = [n for n in order if n == culprit or sizes[n] >= LITTLE * sizes[order[0]]]
    parts = tuple(
        Part(n, float(sizes[n]), _advice(n, fit, views, rivals) if n in worth else "")
        for n in order
    )
    total = deviations(chain, data).rms
    words = _words(total, parts, culprit, own_chain)
    return ErrorBudget(total, parts, rivals, culprit, words, own_chain)


def _one_number(rivals: tuple[Explanation, ...], found: bool) -> Explanation | None:
    """Return the more probable alternative, if it explains most of what a field would.

    Args:
        rivals: alternatives with what each gains.
        found: whether the fit found the target to be of another size, which decides.
    """
    if not rivals:
        return None
    if found:
        return next(rival for rival in rivals if rival.name == "target scale")
    best = max(rivals, key=lambda rival: rival.gain)
    return best if best.gain >= max(GAINED, MOST * best.field_gain) else None


def _has_undescribed_arm(field: AbstractField | None) -> bool:
    """Return whether the field contains the errors of an arm that was not described."""
    parts = (field.first, field.second) if isinstance(field, CombinedField) else (field,)
    return any(isinstance(part, ImpliedArm) for part in parts)


def _words(total: float, parts: tuple[Part, ...], culprit: str, own_chain: bool) -> str:
    """Return the budget's summary and advice in one or two sentences."""
    named = {part.name: part for part in parts}
    first = named[culprit]
    text = f"Of {total:.3g} px RMS of the chain without correction"
    text += ", " if own_chain else " (of a field linear in the pose, in the arm's place), "
    text += f"{first.name} is {first.px:.3g} px: {first.advice}."
    second = next(part for part in parts if part.name != culprit)
    if second.px > ALSO * first.px:
        text += f" Then {second.name}, {second.px:.3g} px: {second.advice}."
    return text


def _advice(name: str, fit: JointFit, views: int, rivals: tuple[Explanation, ...]) -> str:
    """Return the recommended action for a cause."""
    if name == SCALE and rivals:
        return _measure_the_board(rivals)
    assert fit.noise is not None
    millimetres, degrees = 1e3 * fit.noise.translation, np.rad2deg(fit.noise.rotation)
    return {
        PIXELS: "sharper pictures, steady light, a larger or better printed target",
        LENS: "the lens bends in a way that its model does not know: try a richer model",
        NOISE: f"poses are off by {millimetres:.3f} mm and {degrees:.4f} deg, each by itself: wait "
        "until the arm stands still, approach from one side, check the clocks; more views help",
        SCALE: "measure the board",
        SYSTEMATIC: "keep the correction when predicting and commanding, or have the robot "
        "calibrated; without either, work near the views",
        VIEWS: f"{views} views leave the parameters open by so much: take "
        f"{'more' if views >= ENOUGH else f'{ENOUGH} at least'}, that differ in direction, "
        "distance and roll about the optical axis",
    }[name]


def _measure_the_board(rivals: tuple[Explanation, ...]) -> str:
    """Return the advice to measure the target, with both sizes that explain the error."""
    size = {rival.name: rival for rival in rivals}
    target, robot = size["target scale"], size["robot stretch"]
    return (
        "measure the board: either the target is "
        f"{target.size:.4f} +- {target.std:.4f} of its stated size, or the robot goes "
        f"{robot.size:.4f} +- {robot.std:.4f} of the way that it reports; the likelihood cannot "
        f"tell ({target.gain:.0f} and {robot.gain:.0f} better than neither, twice its logarithm), "
        "but arms go their way to half a percent"
    )
