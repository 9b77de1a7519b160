"""Fit again with held parameters freed, or without priors, and compare with the fit under test."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import fdtrc

from ..engine import AbstractProblem, Step, alpha_v_of, is_aspect, reduced_equations, solve
from ..runtime.array_namespace import to_device
from ..runtime.modules import with_fields
from .parameter_estimates import display_unit

MAX_P_VALUE = 1e-6
"""P-value of the decrease of the residuals below which a held value is contradicted.

It is far below the usual level because residuals of one view are not independent.
"""

MIN_DIFFERENCE_SIGMAS = 4.0
"""Smallest difference of a value from its free estimate that is reported, standard deviations."""


class HeldValueTest(NamedTuple):
    """The contradictions between the pictures and the values that a user stated.

    Attributes:
        warnings: a sentence for each contradiction.
        names: names of the fitted parameters.
        added_covariance: covariance of their errors that contradicted values cause; zero without.
        added_to_aspects: variances of the errors of ratios of focal lengths, by their names.
    """

    warnings: tuple[str, ...]
    names: tuple[str, ...]
    added_covariance: Float[np.ndarray, "free free"]
    added_to_aspects: dict[str, float]

    @classmethod
    def of_fitted(
        cls,
        warnings: Sequence[str],
        names: Sequence[str],
        added: Float[np.ndarray, "free free"],
        named_by_fitted: Float[np.ndarray, "free free"] | None,
    ) -> "HeldValueTest":
        """Return the test for the parameters as they are named.

        Args:
            warnings: a sentence for each contradiction.
            names: names of the fitted parameters, with ratios of focal lengths.
            added: covariance of their errors.
            named_by_fitted: as `AbstractProblem.host_named_by_fitted` returns it.
        """
        of_aspects = {name: float(added[k, k]) for k, name in enumerate(names) if is_aspect(name)}
        if named_by_fitted is not None:
            added = named_by_fitted @ added @ named_by_fitted.T
        return cls(tuple(warnings), tuple(map(alpha_v_of, names)), added, of_aspects)

    @classmethod
    def nothing(cls, names: Sequence[str]) -> "HeldValueTest":
        """Return the test without contradictions; `names` are of the fitted parameters."""
        return cls((), tuple(names), np.zeros((len(names),) * 2), {})

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
        variances = dict(zip(names, np.diagonal(added), strict=True)) | self.added_to_aspects
        wider = {name: float(np.hypot(std[name], np.sqrt(v))) for name, v in variances.items()}
        return covariance + added, {**std, **wider}


class Refit(NamedTuple):
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
    ) -> "Refit":
        """Return the fit that holds values which the pictures do not contradict.

        A wrong value then widens no interval that right values make narrow. It is this fit if the
        pictures contradict these values too, once the others are free.

        Args:
            right: names of these values.
            problem, names, z: as of `fitted_again`.
        """
        if not right:
            return self
        free = [k for k, name in enumerate(names) if name in self.difference and name not in right]
        narrow = fitted_again(problem, names, z, np.array(free))
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


def fitted_again(
    problem: AbstractProblem, names: Sequence[str], z: Step, free: Int[np.ndarray, "free"]
) -> Refit | None:
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
    return Refit(
        released,
        solution.chain,
        dict(zip(free_names, map(float, estimate - start[free]), strict=True)),
        dict(zip(free_names, map(float, np.sqrt(variance)), strict=True)),
        covariance,
        cost,
        freedom,
    )
