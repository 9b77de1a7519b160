"""Divide the error of the chain without correction among its causes, and recommend what to do."""

from collections.abc import Callable
from typing import overload

import numpy as np

from ...dataset import MINIMUM_RELIABLE_VIEWS, Dataset, Rig
from ...joint import JointFit, RigFit, SavedEstimate
from ..held_out import has_correction
from ..measures import reprojection_errors
from ..rejections import without_rejected_views
from .causes import (
    SCALE_ERROR,
    SYSTEMATIC_ROBOT_ERROR,
    ErrorBudget,
    has_generic_arm,
    ranked_budget,
    rms_of_causes,
)
from .rig_budget import RigErrorBudget, rig_error_budget
from .scale_hypotheses import (
    ScaleHypothesis,
    fit_scale_hypothesis,
    region_held_out_rms,
    scale_hypotheses,
    target_scale_differs,
)

MIN_FIELD_FRACTION = 0.5
"""The fraction of a field's log-likelihood ratio that an accepted hypothesis must reach."""

MIN_LOG_LIKELIHOOD_RATIO = 10.0
"""The decrease of the deviance above which a scale hypothesis is accepted."""


@overload
def error_budget(
    data: Dataset,
    fit: JointFit,
    progress: Callable[[str], None] | None = None,
    held_out_by_region: bool = False,
) -> ErrorBudget: ...


@overload
def error_budget(
    data: Rig,
    fit: RigFit,
    progress: Callable[[str], None] | None = None,
) -> RigErrorBudget: ...


def error_budget(
    data: Dataset | Rig,
    fit: JointFit | RigFit,
    progress: Callable[[str], None] | None = None,
    held_out_by_region: bool = False,
) -> ErrorBudget | RigErrorBudget:
    """Divide the error of the uncorrected chain among its causes.

    The errors of pixels, poses and parameters are the fit's standard deviations, propagated through
    the projection; the systematic error is the displacement by the correction, and the lens misfit
    is the smooth pattern of residuals when every view has a free pose. Views that the fit left out
    do not count. If the fit's field is a `GenericSixAxisArm`, a fit with a field linear in the pose
    gives the chain.

    Of a rig, the error of each camera is divided, and the variance of each camera's hand-eye
    transform and of relative poses too. Scale hypotheses are not compared for a rig.

    Args:
        data: the data set or the rig that `fit` was fitted to.
        fit: a joint fit with `noise="estimated"`, such as the `.joint` of a `calibrate` result; of
            a rig, the result of `calibrate` or `fit_rig` with any noise.
        progress: called with a line of text for each step.
        held_out_by_region: also cross-validate each hypothesis by region of the workspace: five
            further fits for each.

    Raises:
        TypeError: the fit of a rig for a data set, or the reverse.
        ValueError: the fit's noise was not estimated, or its data leave a parameter undetermined.

    For example:

        >>> sv.error_budget(data, sv.calibrate(data).joint).dominant_cause  # doctest: +SKIP
        'robot noise'

    Of a rig, `sv.error_budget(rig, sv.calibrate(rig)).poses[-1].causes[0].name` is what limits most
    how well the pose of its last camera in the frame of another is known.
    """
    if isinstance(data, Rig) and isinstance(fit, RigFit):
        return rig_error_budget(data, fit, progress)
    if not isinstance(data, Dataset) or not isinstance(fit, JointFit):
        raise TypeError("error_budget: expected a data set with its JointFit, or a rig with RigFit")
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
    if has_generic_arm(fit.calibration.field):
        # Link lengths of a generic arm are correlated with the mount: without the correction its
        # chain has no meaning.
        fit = fit_scale_hypothesis(data, fit, None, field_group_count=4)
        uses_fitted_chain = False
    rms_by_cause = rms_of_causes(SavedEstimate.of(fit), data, np.asarray(fit.inliers))
    systematic_rms = rms_by_cause[SYSTEMATIC_ROBOT_ERROR]
    # Alone, the hypothesis may displace points farther than the chosen field does.
    scale_rms = 0.0 if accepted is None else accepted.rms_displacement
    if chain is None:
        scale_rms = min(scale_rms, systematic_rms)
        # The scale error is a part of the systematic error: total^2 = remaining^2 + scale_rms^2.
        systematic_rms = np.sqrt(systematic_rms**2 - scale_rms**2)
        chain = fit.calibration.uncorrected
    rms_by_cause |= {SCALE_ERROR: scale_rms, SYSTEMATIC_ROBOT_ERROR: systematic_rms}
    total = reprojection_errors(chain, data).rms
    assert fit.noise is not None
    return ranked_budget(total, rms_by_cause, fit.noise, views, hypotheses, uses_fitted_chain)


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
