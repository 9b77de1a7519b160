"""Estimate the pixel sigma together with the fit, where the answer depends on it.

A robust loss and priors weigh residuals in units of sigma. Where sigma is not known, the fit and
the residuals' standard deviation are computed in turn until they agree:

    sigma <- sigma sqrt(f),  f = variance of the residuals at the fit / variance assumed in the fit
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .parameters import Step
from .problem import JointProblem, NormalEquations
from .solver import Solution

SIGMA_FLOOR = 1e-4
"""Smallest pixel sigma, px; data with a smaller one count as free of noise."""


def with_pixel_sigma(problem: JointProblem, sigma: Float[Array, ""] | float) -> JointProblem:
    """Return the problem with another pixel sigma, px."""
    return eqx.tree_at(lambda p: p.pixel_sigma, problem, jnp.asarray(sigma))


def updated_sigma(problem: JointProblem, factor: Float[Array, ""]) -> Float[Array, ""]:
    """Return the pixel sigma that the residuals have, not less than `SIGMA_FLOOR`.

    Args:
        problem: the problem with the pixel sigma assumed in the fit.
        factor: variance of the residuals at the fit over the assumed one.
    """
    return jnp.maximum(problem.pixel_sigma * jnp.sqrt(factor), SIGMA_FLOOR)


def solve_with_estimated_sigma(
    problem: JointProblem,
    solve_problem: Callable[[JointProblem, Step], tuple[Solution, NormalEquations]],
    estimate_sigma: Callable[[JointProblem, Step], Float[Array, ""]],
    tolerance: float,
    maximum_fits: int,
) -> tuple[JointProblem, Solution, NormalEquations, float]:
    """Fit and estimate the pixel sigma in turn, until the two agree.

    Args:
        problem: the problem with the first pixel sigma.
        solve_problem: solves a problem from a step.
        estimate_sigma: pixel sigma from the residuals of a problem at a step, px.
        tolerance: relative change of the pixel sigma at which to stop.
        maximum_fits: number of fits after which to stop.

    Returns:
        The problem with the pixel sigma of the last fit, what the last fit returned, and the pixel
        sigma that its residuals have.
    """
    solution, equations = solve_problem(problem, problem.zero_step())
    sigma = float(estimate_sigma(problem, solution.z))
    for _ in range(maximum_fits - 1):
        assumed_sigma = float(problem.pixel_sigma)
        if abs(sigma - assumed_sigma) <= tolerance * assumed_sigma:
            break
        problem = with_pixel_sigma(problem, sigma)
        solution, equations = solve_problem(problem, solution.z)
        sigma = float(estimate_sigma(problem, solution.z))
    return problem, solution, equations, sigma
