"""Test held parameters and priors against the pictures.

With a camera that was held without its distortion, or a wrong prior on the principal point, a fit
converges, but its mount may be wrong by many standard deviations. So after the fit held parameters
are freed, and priors removed. If the result contradicts the given values, a warning states the
estimate, and the covariance of all else is widened by what the given values change: intervals for
values that the pictures contradict would hold nothing true.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Int

from ..cameras import Pinhole
from ..engine import (
    FittedChain,
    JointProblem,
    Step,
    parameter_names,
    squared_residuals,
    with_lens,
)
from ..runtime.array_namespace import to_device
from .arm_fit import SolvedArm
from .joint_fit import JointFit
from .parameter_estimates import display_unit, displayed_values, displayed_values_and_aspect
from .refit import HeldValueTest, Refit, fitted_again
from .stated_priors import contradicted_priors

MAX_NAMED_VALUES = 3
"""Largest number of values in a warning."""

RICHER_LENS = "opencv4"
"""Lens that is tried if a camera without distortion was held."""

MIN_VIEWS_FOR_LENS = 3
"""Fewest views that tell a lens, so that a held one can be tested."""

PINHOLE_COUNT = 4
"""Number of pinhole parameters of a camera, which come before the lens's."""


def held_value_test(fit: JointFit) -> HeldValueTest:
    """Return what the pictures say about each held value and prior.

    The target's size and shape and the robot's errors are not tested here but by the noise models.

    Args:
        fit: the fit.
    """
    problem, layout = fit.problem, fit.problem.parameters.layout
    # With a free pose for every view, the transforms are meaningless.
    weights = np.asarray(problem.prior_weight.per_view)
    poses_are_free = len(problem.per_view_free) and not weights.any()
    stated = np.arange(layout.camera.stop if poses_are_free else layout.target_scale.start)
    free, weight = np.asarray(problem.free), np.asarray(problem.prior_weight.shared)
    # Directions that the robot's motion leaves open are held too, but not by the user.
    names = _fitted_names(problem)
    held = np.array([k for k in np.setdiff1d(stated, free) if names[k] not in fit.std], dtype=int)
    with_prior = np.intersect1d(stated[weight[stated] > 0.0], free)
    fitted = tuple(names[k] for k in free)
    added = np.zeros((len(fitted),) * 2)
    tests = []
    if len(held):
        tests.append(_contradicted_values(fit, held))
    if len(with_prior):
        z = fit.solution.z
        tests.append(contradicted_priors(problem, names, z, with_prior, _displayed_estimates))
    for texts, refit in tests:
        if texts and refit is not None:
            added = added + refit.effect_of_held(fitted)
    warnings = [text for texts, _ in tests for text in texts]
    by_fitted = problem.host_named_by_fitted(fit.solution.z)
    return HeldValueTest.of_fitted(warnings, fitted, added, by_fitted)


def _fitted_names(problem: JointProblem) -> tuple[str, ...]:
    """Return the names of the parameters, with the ratio of focal lengths where it is fitted."""
    return problem.fitted_names(parameter_names(problem.parameters.start))


def _displayed_estimates(refit: Refit) -> dict[str, tuple[float, str]]:
    """Return the value and the unit of every parameter of a camera in a fit, by name."""
    return displayed_values_and_aspect(refit.chain.calibration)


def _contradicted_values(
    fit: JointFit, held: Int[np.ndarray, "held"]
) -> tuple[list[str], Refit | None]:
    """Return a warning about held parameters that the pictures contradict, and the fit without."""
    problem, z = fit.problem, fit.solution.z
    before, rms = fit.solution.costs[-1], _rms(problem, fit.solution.chain)
    if (
        set(range(PINHOLE_COUNT)) <= set(held)
        and problem.parameters.layout.camera.stop == PINHOLE_COUNT
        and isinstance(problem.parameters.start.camera.lens, Pinhole)
    ):
        problem, count = _with_richer_lens(problem)
        shifted = np.where(held >= PINHOLE_COUNT, held + count, held)
        held = np.union1d(shifted, PINHOLE_COUNT + np.arange(count))
    # The estimated target shape may compensate for wrong held values, so both shapes are tried.
    free = np.union1d(np.asarray(problem.free), held)
    all_names = _fitted_names(problem)
    determined = [
        (refit, shaped)
        for shaped in (problem, _with_stated_shape(problem, fit))
        if (refit := fitted_again(shaped, all_names, z, free)) is not None
    ]
    if not determined:
        return [], None
    refit, shaped = min(determined, key=lambda candidate: candidate[0].cost)
    held_names = [all_names[k] for k in held]
    contradicted = refit.contradicted(held_names, before)
    if not contradicted:
        return [], None
    assert isinstance(refit.problem, JointProblem)
    text = _contradiction_text(
        contradicted,
        refit,
        displayed_values(refit.chain.calibration),
        displayed_values(problem.parameters.start),
    )
    return [
        f"{text}; freed, the residual falls from {rms:.3g} to "
        f"{_rms(refit.problem, refit.chain):.3g} px RMS: correct or free them"
    ], refit.believing(_others(held_names, contradicted), shaped, all_names, z)


def _others(names: Sequence[str], without: Sequence[str]) -> list[str]:
    """Return the names that are not among some."""
    return [name for name in names if name not in without]


def _contradiction_text(
    names: Sequence[str],
    refit: Refit,
    estimated: Mapping[str, tuple[float, str]],
    held: Mapping[str, tuple[float, str]],
) -> str:
    """Return in words which held values the pictures contradict.

    Args:
        refit: the fit in which they are free.
        estimated, held: value and unit of each parameter in that fit and as held.
    """
    listed = ", ".join(
        f"{name} {refit.text(name, estimated)} (held at {held[name][0]:.6g})"
        for name in names[:MAX_NAMED_VALUES]
    )
    return f"the pictures contradict held parameters: estimated {listed}"


def held_camera_test(arm: SolvedArm) -> HeldValueTest:
    """Return whether the pictures of a rig contradict cameras that are known and held.

    Args:
        arm: the fit of the cameras of one arm.
    """
    problem, z = arm.built.problem, arm.solution.z
    nothing = HeldValueTest.nothing(arm.built.shared_names)
    names = problem.fitted_names(arm.built.parameter_names)
    free = np.asarray(problem.free)
    # One or two views do not tell a lens.
    told = tuple(
        f"{name}.camera."
        for name, data in arm.rig.cameras.items()
        if len(data.usable_views()) >= MIN_VIEWS_FOR_LENS
    )
    is_held = ~np.isin(np.arange(len(names)), free)
    held = [k for k in np.flatnonzero(is_held).tolist() if names[k].startswith(told)]
    if not held:
        return nothing
    refit = fitted_again(problem, names, z, np.union1d(free, held))
    if refit is None:
        return nothing
    held_names = [names[k] for k in held]
    contradicted = refit.contradicted(held_names, arm.solution.costs[-1])
    if not contradicted:
        return nothing
    start = problem.host_start_values()
    # Rounding errors of a coefficient that is zero would look like a value.
    stated = {names[k]: (round(float(start[k]), 12), display_unit(names[k])[1]) for k in held}
    estimated = {
        name: (value + refit.difference[name], unit) for name, (value, unit) in stated.items()
    }
    text = _contradiction_text(contradicted, refit, estimated, stated)
    refit = refit.believing(_others(held_names, contradicted), problem, names, z)
    fitted = [names[k] for k in free]
    warning = f"{text}: correct them, or leave out these cameras (camera=, --camera)"
    by_fitted = problem.host_named_by_fitted(z)
    return HeldValueTest.of_fitted([warning], fitted, refit.effect_of_held(fitted), by_fitted)


def _with_stated_shape(problem: JointProblem, fit: JointFit) -> JointProblem:
    """Return the problem with the target's points as stated, without its estimated shape."""
    shape = fit.calibration.target_shape
    if shape is None:
        return problem
    opposite = shape.with_coefficients(-np.asarray(shape.coefficients))
    return dataclasses.replace(problem, observations=problem.observations.of_shape(opposite))


def _with_richer_lens(problem: JointProblem) -> tuple[JointProblem, int]:
    """Return the problem with a lens that can distort, held at zero, and its parameter count."""
    start = with_lens(problem.parameters.start, RICHER_LENS)
    parameters = dataclasses.replace(problem.parameters, start=start)
    count = parameters.layout.camera.stop - PINHOLE_COUNT

    def with_lens_entries(step: Step, value: float) -> Step:
        """Return a vector of all parameters with entries for the lens."""
        shared = np.insert(np.asarray(step.shared), [PINHOLE_COUNT] * count, value)
        return step._replace(shared=to_device(shared))

    free = np.asarray(problem.free)
    return dataclasses.replace(
        problem,
        parameters=parameters,
        free=to_device(np.where(free >= PINHOLE_COUNT, free + count, free)),
        prior_mean=with_lens_entries(problem.prior_mean, np.nan),
        prior_weight=with_lens_entries(problem.prior_weight, 0.0),
    ), count


def _rms(problem: JointProblem, chain: FittedChain) -> float:
    """Return the RMS residual of a fit, px."""
    visible = np.asarray(problem.observations.visible)
    square = float(squared_residuals(problem, chain)[visible].mean())
    return float(np.sqrt(square)) * float(problem.pixel_sigma)
