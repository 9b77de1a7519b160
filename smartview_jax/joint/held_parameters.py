"""Test held parameters and priors against the pictures.

With a camera that was held without its distortion, or a wrong prior on the principal point, a fit
converges, but its mount may be wrong by many standard deviations. So after the fit held parameters
are freed, and priors removed. If the result contradicts the given values, a warning states the
estimate.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Int
from scipy.special import fdtrc

from ..calibration import Calibration
from ..cameras import Pinhole
from ..engine import (
    FittedChain,
    JointProblem,
    Step,
    parameter_names,
    reduced_equations,
    solve,
    squared_residuals,
    with_lens,
)
from ..runtime.array_namespace import to_device
from .joint_fit import JointFit
from .parameter_estimates import display_unit, displayed_values

MAX_P_VALUE = 1e-6
"""P-value of the decrease of the residuals below which a held value is contradicted.

It is far below the usual level because residuals of one view are not independent.
"""

MIN_DIFFERENCE_SIGMAS = 4.0
"""Smallest difference of a value from its free estimate that is reported, standard deviations."""

MAX_NAMED_VALUES = 3
"""Largest number of values in a warning."""

RICHER_LENS = "opencv4"
"""Lens that is tried if a camera without distortion was held."""

PINHOLE_COUNT = 4
"""Number of pinhole parameters of a camera, which come before the lens's."""


class _Refit(NamedTuple):
    """A fit with more free parameters than the fit under test.

    Attributes:
        calibration: its calibration.
        difference: difference of every free shared parameter from the fit under test, by name.
        std: standard deviations of these parameters.
        cost: half the sum of squared whitened residuals, with the residuals of the priors.
        rms: RMS residual, px.
        freedom: number of residuals minus number of parameters.
    """

    calibration: Calibration
    difference: dict[str, float]
    std: dict[str, float]
    cost: float
    rms: float
    freedom: int

    def text(self, name: str) -> str:
        """Return the value of a parameter with its standard deviation and unit."""
        value, unit = displayed_values(self.calibration)[name]
        std = display_unit(name)[0] * self.std[name]
        return f"{value:.6g} +- {std:.2g} {unit}".rstrip()


def held_value_warnings(fit: JointFit) -> tuple[str, ...]:
    """Return a warning for each held value or prior that the pictures contradict.

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
    names = parameter_names(problem.parameters.start)
    held = np.array([k for k in np.setdiff1d(stated, free) if names[k] not in fit.std], dtype=int)
    with_prior = np.intersect1d(stated[weight[stated] > 0.0], free)
    return (
        *(_contradicted_values(fit, held) if len(held) else ()),
        *(_contradicted_priors(fit, with_prior) if len(with_prior) else ()),
    )


def _contradicted_values(fit: JointFit, held: Int[np.ndarray, "held"]) -> list[str]:
    """Return a warning about held parameters that the pictures contradict, if there are any."""
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
    refits = (_refit(shaped, z, free) for shaped in (problem, _with_stated_shape(problem, fit)))
    determined = [refit for refit in refits if refit is not None]
    if not determined:
        return []
    refit = min(determined, key=lambda candidate: candidate.cost)
    gain = (before - refit.cost) / len(held) / (refit.cost / refit.freedom)
    if not (gain > 0.0 and fdtrc(len(held), refit.freedom, gain) < MAX_P_VALUE):
        return []
    names = [parameter_names(problem.parameters.start)[k] for k in held]
    sigmas = {name: abs(refit.difference[name]) / refit.std[name] for name in names}
    contradicted = sorted(sigmas, key=lambda name: -sigmas[name])[:MAX_NAMED_VALUES]
    contradicted = [name for name in contradicted if sigmas[name] > MIN_DIFFERENCE_SIGMAS]
    if not contradicted:
        return []
    values = displayed_values(problem.parameters.start)
    listed = ", ".join(
        f"{name} {refit.text(name)} (held at {values[name][0]:.6g})" for name in contradicted
    )
    return [
        f"the pictures contradict held parameters: estimated {listed}; freed, the residual falls "
        f"from {rms:.3g} to {refit.rms:.3g} px RMS: correct or free them"
    ]


def _contradicted_priors(fit: JointFit, with_prior: Int[np.ndarray, "priors"]) -> list[str]:
    """Return a warning for each prior that the pictures contradict."""
    problem, z = fit.problem, fit.solution.z
    weight = np.array(problem.prior_weight.shared)
    stds = 1.0 / weight[with_prior]
    free, step = np.asarray(problem.free), np.asarray(problem.scale.shared) * np.asarray(z.shared)
    offsets = problem.host_offset_at_start()
    offsets[free] += step
    offsets = offsets[with_prior]
    weight[with_prior] = 0.0
    without = dataclasses.replace(
        problem, prior_weight=problem.prior_weight._replace(shared=to_device(weight))
    )
    refit = _refit(without, z, free)
    if refit is None:
        return []
    names = parameter_names(problem.parameters.start)
    sentences = []
    for name, std, offset in zip((names[k] for k in with_prior), stds, offsets, strict=True):
        difference = refit.difference[name] + offset
        if not abs(difference) > MIN_DIFFERENCE_SIGMAS * np.hypot(std, refit.std[name]):
            continue
        factor, _ = display_unit(name)
        mean = displayed_values(refit.calibration)[name][0] - factor * difference
        sentences.append(
            f"the pictures contradict the prior on {name}, {mean:.6g} +- {factor * std:.2g}: "
            f"estimated {refit.text(name)} without it; correct or remove it"
        )
    return sentences


def _refit(problem: JointProblem, z: Step, free: Int[np.ndarray, "free"]) -> _Refit | None:
    """Fit again with other free parameters; None if a parameter is then undetermined.

    Args:
        problem: the problem, in the parameters' own units.
        z: final step of the fit under test.
        free: indices of the parameters to free.
    """
    start = np.zeros(problem.parameters.layout.size)
    start[np.asarray(problem.free)] = np.asarray(z.shared)
    released = dataclasses.replace(
        problem,
        free=to_device(free),
        scale=problem.scale._replace(shared=to_device(np.ones(len(free)))),
    )
    solution, equations = solve(released, start=Step(to_device(start[free]), z.per_view))
    matrix = np.asarray(reduced_equations(equations.matrix).schur_complement)
    estimate = np.asarray(solution.z.shared)
    if not (np.isfinite(estimate).all() and np.isfinite(matrix).all()):
        return None
    if not (np.diagonal(matrix) > 0.0).all():
        return None
    norms = np.sqrt(np.diagonal(matrix))
    correlation = matrix / np.outer(norms, norms)
    if np.linalg.matrix_rank(correlation, hermitian=True) < len(free):
        return None
    freedom = max(2 * _visible_count(problem) - len(free), 1)
    cost = solution.costs[-1]
    variance = 2.0 * cost / freedom * np.diagonal(np.linalg.inv(correlation)) / norms**2
    names = [parameter_names(problem.parameters.start)[k] for k in free]
    return _Refit(
        solution.chain.calibration,
        dict(zip(names, map(float, estimate - start[free]), strict=True)),
        dict(zip(names, map(float, np.sqrt(variance)), strict=True)),
        cost,
        _rms(released, solution.chain),
        freedom,
    )


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


def _visible_count(problem: JointProblem) -> int:
    """Return the number of visible points."""
    return int(np.asarray(problem.observations.visible).sum())
