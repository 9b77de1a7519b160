"""Ask the pictures about what they were not asked: parameters that were held, or had a prior.

A camera that was given without its distortion, or a prior on the wrong principal point, leaves a
fit that converges, and a mount that is wrong by many of its standard deviations. So what was held
is made free once the fit is done, and what had a prior loses it. Where the pictures then contradict
what was said, a sentence names the value that they want.
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
"""Probability of so much smaller residuals by chance, below which a held value is contradicted.

It is far below the usual level because residuals of one view are not independent.
"""

MIN_DIFFERENCE_SIGMAS = 4.0
"""Difference of a value from what the pictures want, in standard deviations, that is named."""

MAX_NAMED_VALUES = 3
"""Largest number of values in a sentence."""

RICHER_LENS = "opencv4"
"""Lens that is tried where a camera without any distortion was held."""

PINHOLE_COUNT = 4
"""Number of a camera's parameters without its lens, which come first."""


class _Refit(NamedTuple):
    """A fit with more freedom than the one in question.

    Attributes:
        calibration: its calibration.
        difference: difference of every free shared parameter from the fit in question, by name.
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
    """Return a sentence for each statement on camera and transforms that the pictures contradict.

    The target's size and shape and the robot's errors are not asked about: the models of the noise
    do that.

    Args:
        fit: the fit.
    """
    problem, layout = fit.problem, fit.problem.parameters.layout
    # Where every view has a free pose, nothing is known of the transforms.
    weights = np.asarray(problem.prior_weight.per_view)
    poses_are_free = len(problem.per_view_free) and not weights.any()
    stated = np.arange(layout.camera.stop if poses_are_free else layout.target_scale.start)
    free, weight = np.asarray(problem.free), np.asarray(problem.prior_weight.shared)
    # What the robot's motion leaves open is held as well, but by nobody's word.
    names = parameter_names(problem.parameters.start)
    held = np.array([k for k in np.setdiff1d(stated, free) if names[k] not in fit.std], dtype=int)
    with_prior = np.intersect1d(stated[weight[stated] > 0.0], free)
    return (
        *(_contradicted_values(fit, held) if len(held) else ()),
        *(_contradicted_priors(fit, with_prior) if len(with_prior) else ()),
    )


def _contradicted_values(fit: JointFit, held: Int[np.ndarray, "held"]) -> list[str]:
    """Return a sentence on held parameters that the pictures want elsewhere, if there are any."""
    problem, z = fit.problem, fit.solution.z
    before, rms = fit.solution.costs[-1], _rms(problem, fit.solution.chain)
    if (
        set(range(PINHOLE_COUNT)) <= set(held)
        and problem.parameters.layout.camera.stop == PINHOLE_COUNT
        and isinstance(problem.parameters.start.camera.lens, Pinhole)
    ):
        problem, count = _with_richer_lens(problem)
        behind = np.where(held >= PINHOLE_COUNT, held + count, held)
        held = np.union1d(behind, PINHOLE_COUNT + np.arange(count))
    # The target's shape may have been bent to make up for what was held.
    free = np.union1d(np.asarray(problem.free), held)
    refits = (_refit(one, z, free) for one in (problem, _with_stated_shape(problem, fit)))
    determined = [refit for refit in refits if refit is not None]
    if not determined:
        return []
    refit = min(determined, key=lambda one: one.cost)
    gain = (before - refit.cost) / len(held) / (refit.cost / refit.freedom)
    if not (gain > 0.0 and fdtrc(len(held), refit.freedom, gain) < MAX_P_VALUE):
        return []
    names = [parameter_names(problem.parameters.start)[k] for k in held]
    sigmas = {name: abs(refit.difference[name]) / refit.std[name] for name in names}
    wanted = sorted(sigmas, key=lambda name: -sigmas[name])[:MAX_NAMED_VALUES]
    wanted = [name for name in wanted if sigmas[name] > MIN_DIFFERENCE_SIGMAS]
    if not wanted:
        return []
    at = displayed_values(problem.parameters.start)
    listed = ", ".join(f"{name} {refit.text(name)} (held at {at[name][0]:.6g})" for name in wanted)
    return [
        f"the pictures contradict what is held: they want {listed}; the residual falls from "
        f"{rms:.3g} to {refit.rms:.3g} px RMS with it free: correct or free it"
    ]


def _contradicted_priors(fit: JointFit, with_prior: Int[np.ndarray, "priors"]) -> list[str]:
    """Return a sentence for each prior that the pictures contradict."""
    problem, z = fit.problem, fit.solution.z
    weight = np.array(problem.prior_weight.shared)
    stds = 1.0 / weight[with_prior]
    offsets = np.asarray(problem.offset_from_prior(problem.unscaled_step(z)).shared)[with_prior]
    weight[with_prior] = 0.0
    without = dataclasses.replace(
        problem, prior_weight=problem.prior_weight._replace(shared=to_device(weight))
    )
    refit = _refit(without, z, np.asarray(problem.free))
    if refit is None:
        return []
    names = parameter_names(problem.parameters.start)
    sentences = []
    for name, std, offset in zip((names[k] for k in with_prior), stds, offsets, strict=True):
        off = refit.difference[name] + offset
        if not abs(off) > MIN_DIFFERENCE_SIGMAS * np.hypot(std, refit.std[name]):
            continue
        factor, _ = display_unit(name)
        mean = displayed_values(refit.calibration)[name][0] - factor * off
        sentences.append(
            f"the pictures contradict the prior on {name}, {mean:.6g} +- {factor * std:.2g}: they "
            f"want {refit.text(name)}; correct it or leave it out"
        )
    return sentences


def _refit(problem: JointProblem, z: Step, free: Int[np.ndarray, "free"]) -> _Refit | None:
    """Fit again with other free parameters; None where that leaves some undetermined.

    Args:
        problem: the problem, in the parameters' own units.
        z: step at which the fit in question ended.
        free: indices of the parameters that are free now.
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
    found = np.asarray(solution.z.shared)
    if not (np.isfinite(found).all() and np.isfinite(matrix).all()):
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
        dict(zip(names, map(float, found - start[free]), strict=True)),
        dict(zip(names, map(float, np.sqrt(variance)), strict=True)),
        cost,
        _rms(released, solution.chain),
        freedom,
    )


def _with_stated_shape(problem: JointProblem, fit: JointFit) -> JointProblem:
    """Return the problem with the points of the target where they are stated."""
    shape = fit.calibration.target_shape
    if shape is None:
        return problem
    opposite = shape.with_coefficients(-np.asarray(shape.coefficients))
    return dataclasses.replace(problem, observations=problem.observations.of_shape(opposite))


def _with_richer_lens(problem: JointProblem) -> tuple[JointProblem, int]:
    """Return the problem with a lens that can distort, held at none, and its parameter count."""
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
    """Return the number of points that are seen."""
    return int(np.asarray(problem.observations.visible).sum())
