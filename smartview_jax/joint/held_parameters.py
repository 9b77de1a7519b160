"""Test held parameters and priors against the pictures.

With a camera that was held without its distortion, or a wrong prior on the principal point, a fit
converges, but its mount may be wrong by many standard deviations. So after the fit held parameters
are freed, and priors removed. If the result contradicts the given values, a warning states the
estimate, and the covariance of all else is widened by what the given values change: intervals for
values that the pictures contradict would hold nothing true.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int
from scipy.special import fdtrc

from ..cameras import Pinhole
from ..engine import (
    DEPTH_BIAS,
    PIXEL_ASPECT,
    ROBOT_ERROR,
    AbstractProblem,
    FittedChain,
    JointProblem,
    Step,
    aspect_of,
    is_focal_length,
    is_size,
    parameter_names,
    reduced_equations,
    solve,
    squared_residuals,
    with_lens,
)
from ..runtime.array_namespace import to_device
from ..runtime.modules import with_fields
from .arm_fit import SolvedArm
from .joint_fit import JointFit
from .parameter_estimates import display_unit, displayed_values, pixel_aspect

_Problem = TypeVar("_Problem", bound=AbstractProblem)

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

MIN_VIEWS_FOR_LENS = 3
"""Fewest views that tell a lens, so that a held one can be tested."""

PINHOLE_COUNT = 4
"""Number of pinhole parameters of a camera, which come before the lens's."""


class HeldValueTest(NamedTuple):
    """The contradictions between the pictures and the values that a user stated.

    Attributes:
        warnings: a sentence for each contradiction.
        names: names of the fitted parameters.
        added_covariance: covariance of their errors that contradicted values cause; zero without.
    """

    warnings: tuple[str, ...]
    names: tuple[str, ...]
    added_covariance: Float[np.ndarray, "free free"]

    def widened(
        self,
        covariance: Float[np.ndarray, "free free"],
        std: Mapping[str, float],
        names: Sequence[str],
    ) -> tuple[Float[np.ndarray, "free free"], dict[str, float]]:
        """Return the covariance and the standard deviations of a fit, widened by what is added.

        Args:
            covariance: of the fit's parameters.
            std: their standard deviations, and others, by name.
            names: names of the parameters in their order.
        """
        place = {name: k for k, name in enumerate(names)}
        kept = [k for k, name in enumerate(self.names) if name in place]
        rows = [place[self.names[k]] for k in kept]
        added = np.zeros_like(covariance)
        added[np.ix_(rows, rows)] = self.added_covariance[np.ix_(kept, kept)]
        variances = np.diagonal(added)
        wider = {
            n: float(np.hypot(std[n], np.sqrt(v))) for n, v in zip(names, variances, strict=True)
        }
        return covariance + added, {**std, **wider}


class _Refit(NamedTuple):
    """A fit with more free parameters than the fit under test.

    Attributes:
        problem: its problem.
        chain: the chain of every view, or of every camera of a rig.
        difference: difference of every free shared parameter from the fit under test, by name.
        std: standard deviations of these parameters.
        covariance: covariance of these parameters.
        cost: half the sum of squared whitened residuals, with the residuals of the priors.
        freedom: number of residuals minus number of parameters.
    """

    problem: AbstractProblem
    chain: Any
    difference: dict[str, float]
    std: dict[str, float]
    covariance: Float[np.ndarray, "free free"]
    cost: float
    freedom: int

    def contradicted(self, names: Sequence[str], cost: float) -> list[str]:
        """Return which parameters that the fit under test held differ from it, the farthest first.

        There are none if this fit is not better by more than chance, by an F test.

        Args:
            names: names of all of them.
            cost: of the fit under test.
        """
        if not self._is_better(cost, len(names)):
            return []
        sigmas = {name: abs(self.difference[name]) / self.std[name] for name in names}
        farthest = sorted(sigmas, key=lambda name: -sigmas[name])
        return [name for name in farthest if sigmas[name] > MIN_DIFFERENCE_SIGMAS]

    def _is_better(self, cost: float, more: int) -> bool:
        """Return whether this fit is better than another by more than chance, by an F test.

        Args:
            cost: of the other fit.
            more: number of parameters that are free here, and held in the other fit.
        """
        gain = (cost - self.cost) / more / (self.cost / self.freedom)
        return gain > 0.0 and float(fdtrc(more, self.freedom, gain)) < MAX_P_VALUE

    def believing(
        self, right: Sequence[str], problem: AbstractProblem, names: Sequence[str], z: Step
    ) -> "_Refit":
        """Return the fit that holds values which the pictures do not contradict.

        A wrong value then widens no interval that right values make narrow. It is this fit if the
        pictures contradict these values too, once the others are free.

        Args:
            right: names of these values.
            problem, names, z: as of `_refit`.
        """
        if not right:
            return self
        free = [k for k, name in enumerate(names) if name in self.difference and name not in right]
        narrow = _refit(problem, names, z, np.array(free))
        if narrow is None or self._is_better(narrow.cost, len(right)):
            return self
        return narrow

    def effect_of_held(self, names: Sequence[str]) -> Float[np.ndarray, "fitted fitted"]:
        """Return the covariance of the errors that wrong held values cause in the other parameters.

        With P the covariance of this fit, f the parameters that the fit under test has too and h
        those that it holds, its errors follow the held ones by B = P_fh P_hh^-1. What it does not
        know of them is B P_hh B^T, and what it has wrong d d^T, with d the difference of the fits.

        Args:
            names: names of the parameters of the fit under test.
        """
        whole = list(self.difference)
        fitted = [whole.index(name) for name in names]
        held = [k for k in range(len(whole)) if k not in fitted]
        d = np.array([self.difference[name] for name in names])
        of_both = self.covariance[np.ix_(fitted, held)]
        scale = np.sqrt(np.diagonal(self.covariance)[held])
        correlation = self.covariance[np.ix_(held, held)] / np.outer(scale, scale)
        scaled = of_both / scale
        unknown = scaled @ np.linalg.solve(correlation, scaled.T) if len(held) else 0.0
        return np.outer(d, d) + unknown

    def text(self, name: str, values: Mapping[str, tuple[float, str]]) -> str:
        """Return the value of a parameter with its standard deviation and unit.

        Args:
            name: its name.
            values: value and unit of each parameter in this fit.
        """
        value, unit = values[name]
        std = display_unit(name)[0] * self.std[name]
        return f"{value:.6g} +- {std:.2g} {unit}".rstrip()


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
        tests.append(_contradicted_priors(problem, names, z, with_prior, _displayed_estimates))
    for texts, refit in tests:
        if texts and refit is not None:
            added = added + refit.effect_of_held(fitted)
    by_fitted = problem.host_named_by_fitted(fit.solution.z)
    if by_fitted is not None:
        added = by_fitted @ added @ by_fitted.T
    warnings = tuple(text for texts, _ in tests for text in texts)
    return HeldValueTest(warnings, fit.parameter_names, added)


def _fitted_names(problem: JointProblem) -> tuple[str, ...]:
    """Return the names of the parameters, with the ratio of focal lengths where it is fitted."""
    names = parameter_names(problem.parameters.start)
    if problem.parameters.fits_aspect is None:
        return names
    return tuple(PIXEL_ASPECT if is_focal_length(name) else name for name in names)


def _displayed_estimates(refit: _Refit) -> dict[str, tuple[float, str]]:
    """Return the value and the unit of every parameter of a camera in a fit, by name."""
    calibration = refit.chain.calibration
    return displayed_values(calibration) | {PIXEL_ASPECT: (pixel_aspect(calibration), "")}


def _contradicted_values(
    fit: JointFit, held: Int[np.ndarray, "held"]
) -> tuple[list[str], _Refit | None]:
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
        if (refit := _refit(shaped, all_names, z, free)) is not None
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
    refit: _Refit,
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
    problem, z, fitted = arm.built.problem, arm.solution.z, arm.built.shared_names
    nothing = HeldValueTest((), fitted, np.zeros((len(fitted),) * 2))
    names = arm.built.parameter_names
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
    refit = _refit(problem, names, z, np.union1d(free, held))
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
    added, by_fitted = refit.effect_of_held(fitted), problem.host_named_by_fitted(z)
    return HeldValueTest(
        (f"{text}: correct them, or leave out these cameras (camera=, --camera)",),
        fitted,
        added if by_fitted is None else by_fitted @ added @ by_fitted.T,
    )


def stated_prior_test(arm: SolvedArm) -> HeldValueTest:
    """Return whether the pictures of a rig contradict priors on cameras and transforms.

    Args:
        arm: the fit of the cameras of one arm.
    """
    problem, z, fitted = arm.built.problem, arm.solution.z, arm.built.shared_names
    by_fitted = problem.host_named_by_fitted(z)
    free, weight = np.asarray(problem.free), np.asarray(problem.prior_weight.shared)
    names = list(arm.built.parameter_names)
    aspects = problem.fitted_aspects
    if aspects is not None:
        for k in aspects.places[aspects.fits_aspect, 1]:
            names[k] = aspect_of(names[k])
    stated = [
        k
        for k in free.tolist()
        if weight[k] > 0.0
        and not is_size(names[k])
        and not {ROBOT_ERROR, DEPTH_BIAS} & set(names[k].split("."))
    ]
    nothing = HeldValueTest((), fitted, np.zeros((len(fitted),) * 2))
    if not stated:
        return nothing
    values = np.array(problem.host_start_values())
    values[free] += np.asarray(problem.scale.shared) * np.asarray(z.shared)

    def values_of(refit: _Refit) -> dict[str, tuple[float, str]]:
        """Return value and unit of each parameter in a fit; rotations are turns from the start."""
        units = {names[k]: display_unit(names[k]) for k in free}
        estimates = {names[k]: values[k] + refit.difference[names[k]] for k in free}
        return {name: (factor * estimates[name], unit) for name, (factor, unit) in units.items()}

    texts, refit = _contradicted_priors(problem, names, z, np.array(stated), values_of)
    if not texts or refit is None:
        return nothing
    added = refit.effect_of_held([names[k] for k in free])
    return HeldValueTest(
        tuple(texts), fitted, added if by_fitted is None else by_fitted @ added @ by_fitted.T
    )


def _contradicted_priors(
    problem: AbstractProblem,
    names: Sequence[str],
    z: Step,
    with_prior: Int[np.ndarray, "priors"],
    values_of: Callable[[_Refit], Mapping[str, tuple[float, str]]],
) -> tuple[list[str], _Refit | None]:
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
    refit = _refit(_without_priors(problem, with_prior), names, z, free)
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
        refit = _refit(without, names, z, free) or refit
    return sentences, refit


def _without_priors(problem: _Problem, priors: Int[np.ndarray, "priors"]) -> _Problem:
    """Return the problem without the priors on some shared parameters, given by their indices."""
    weight = np.array(problem.prior_weight.shared)
    weight[priors] = 0.0
    return with_fields(
        problem, prior_weight=problem.prior_weight._replace(shared=to_device(weight))
    )


def _refit(
    problem: AbstractProblem, names: Sequence[str], z: Step, free: Int[np.ndarray, "free"]
) -> _Refit | None:
    """Fit again with other free parameters; None if a parameter is then undetermined.

    Args:
        problem: the problem, in the parameters' own units.
        names: names of its shared parameters.
        z: final step of the fit under test.
        free: indices of the parameters to free.
    """
    start = np.zeros(problem.parameter_count)
    start[np.asarray(problem.free)] = np.asarray(z.shared)
    released = with_fields(
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
    freedom = max(2 * problem.visible_count - len(free), 1)
    cost = solution.costs[-1]
    covariance = 2.0 * cost / freedom * np.linalg.inv(correlation) / np.outer(norms, norms)
    variance = np.diagonal(covariance)
    if not (variance > 0.0).all():
        return None
    free_names = np.array(names)[free].tolist()
    return _Refit(
        released,
        solution.chain,
        dict(zip(free_names, map(float, estimate - start[free]), strict=True)),
        dict(zip(free_names, map(float, np.sqrt(variance)), strict=True)),
        covariance,
        cost,
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
