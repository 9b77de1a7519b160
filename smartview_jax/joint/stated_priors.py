"""Test priors against the pictures.

A wrong prior, such as one of square pixels on a camera whose pixels are not, moves the mount by
many standard deviations. So after the fit priors are removed, and what the pictures contradict is
named with the estimate without it.
"""

from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np
from jaxtyping import Int

from ..engine import DEPTH_BIAS, ROBOT_ERROR, AbstractProblem, Step, is_size
from ..runtime.array_namespace import to_device
from ..runtime.modules import with_fields
from .arm_fit import SolvedArm
from .parameter_estimates import display_unit
from .refit import MIN_DIFFERENCE_SIGMAS, HeldValueTest, Refit, fitted_again

_Problem = TypeVar("_Problem", bound=AbstractProblem)


def stated_prior_test(arm: SolvedArm) -> HeldValueTest:
    """Return whether the pictures of a rig contradict priors on cameras and transforms.

    Args:
        arm: the fit of the cameras of one arm.
    """
    problem, z = arm.built.problem, arm.solution.z
    free, weight = np.asarray(problem.free), np.asarray(problem.prior_weight.shared)
    names = problem.fitted_names(arm.built.parameter_names)
    stated = [
        k
        for k in free.tolist()
        if weight[k] > 0.0
        and not is_size(names[k])
        and not {ROBOT_ERROR, DEPTH_BIAS} & set(names[k].split("."))
    ]
    nothing = HeldValueTest.nothing(arm.built.shared_names)
    if not stated:
        return nothing
    values = np.array(problem.host_start_values())
    values[free] += np.asarray(problem.scale.shared) * np.asarray(z.shared)

    def values_of(refit: Refit) -> dict[str, tuple[float, str]]:
        """Return value and unit of each parameter in a fit; rotations are turns from the start."""
        units = {names[k]: display_unit(names[k]) for k in free}
        estimates = {names[k]: values[k] + refit.difference[names[k]] for k in free}
        return {
            name: (float(factor * estimates[name]), unit) for name, (factor, unit) in units.items()
        }

    texts, refit = contradicted_priors(problem, names, z, np.array(stated), values_of)
    if not texts or refit is None:
        return nothing
    fitted = [names[k] for k in free]
    by_fitted = problem.host_named_by_fitted(z)
    return HeldValueTest.of_fitted(texts, fitted, refit.effect_of_held(fitted), by_fitted)


def contradicted_priors(
    problem: AbstractProblem,
    names: tuple[str, ...],
    z: Step,
    with_prior: Int[np.ndarray, "priors"],
    values_of: Callable[[Refit], Mapping[str, tuple[float, str]]],
) -> tuple[list[str], Refit | None]:
    """Return a warning for each prior that the pictures contradict, and the fit without these.

    Args:
        problem: the problem of the fit under test.
        names: names of its shared parameters.
        z: its solution.
        with_prior: indices of the parameters with priors.
        values_of: value and unit of each parameter in another fit.
    """
    stds = 1.0 / np.asarray(problem.prior_weight.shared)[with_prior]
    free, step = np.asarray(problem.free), np.asarray(problem.scale.shared) * np.asarray(z.shared)
    offsets = problem.host_offset_at_start()
    offsets[free] += step
    refit = fitted_again(_without_priors(problem, with_prior), names, z, free)
    if refit is None:
        return [], None
    estimated = values_of(refit)
    sentences, contradicted = [], []
    for k, std, offset in zip(with_prior.tolist(), stds, offsets[with_prior], strict=True):
        name = names[k]
        difference = refit.difference[name] + offset
        if not abs(difference) > MIN_DIFFERENCE_SIGMAS * np.hypot(std, refit.std[name]):
            continue
        factor, _ = display_unit(name)
        mean = estimated[name][0] - factor * difference
        contradicted.append(k)
        sentences.append(
            f"the pictures contradict the prior on {name}, {mean:.6g} +- {factor * std:.2g}: "
            f"estimated {refit.text(name, estimated)} without it; correct or remove it"
        )
    if 0 < len(contradicted) < len(with_prior):
        # The other priors are believed: without them intervals would be wide for no reason.
        without = _without_priors(problem, np.array(contradicted))
        refit = fitted_again(without, names, z, free) or refit
    return sentences, refit


def _without_priors(problem: _Problem, priors: Int[np.ndarray, "priors"]) -> _Problem:
    """Return the problem without the priors on some shared parameters, given by their indices."""
    weight = np.array(problem.prior_weight.shared)
    weight[priors] = 0.0
    return with_fields(
        problem, prior_weight=problem.prior_weight._replace(shared=to_device(weight))
    )
