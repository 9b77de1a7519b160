"""Estimate the pixel sigma together with the fit, if the result depends on it.

A robust loss and priors weight residuals in units of sigma. If sigma is unknown, the fit and the
residuals' standard deviation are computed in turn until they agree:

    sigma <- sigma sqrt(f),  f = variance of the residuals at the fit / variance assumed in the fit
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from ..dataset import view_residuals
from ..runtime.array_namespace import AnyScalar, array_namespace, as_float_array
from ..runtime.modules import with_fields
from .parameters import Step
from .problem import FittedChain, JointProblem, NormalEquations
from .solver import Solution
from .view_normal_equations import INVALID_PROJECTION_RESIDUAL

SIGMA_FLOOR = 1e-4
"""Smallest pixel sigma, px; data with less noise count as noise-free."""


def with_pixel_sigma(problem: JointProblem, sigma: AnyScalar) -> JointProblem:
    """Return the problem with a new pixel sigma, px."""
    return with_fields(problem, pixel_sigma=as_float_array(sigma))


def updated_sigma(sigma: AnyScalar, factor: AnyScalar) -> AnyScalar:
    """Return the pixel sigma estimated from the residuals, at least `SIGMA_FLOOR`.

    Args:
        sigma: pixel sigma assumed in the fit, px.
        factor: variance of the residuals at the fit over the assumed variance.
    """
    xp = array_namespace(sigma, factor)
    return xp.maximum(sigma * xp.sqrt(factor), SIGMA_FLOOR)


def squared_residuals(
    problem: JointProblem, chain: FittedChain
) -> Float[np.ndarray, "views points"]:
    """Return the squared length of every whitened residual at a fit, on the host.

    Points that cannot be projected have `INVALID_PROJECTION_RESIDUAL` in u and in v, as in
    `JointProblem.squared_residuals`, which is the same inside `jit`.
    """
    residuals = view_residuals(
        chain.calibration.camera,
        chain.calibration.target_scale,
        chain.camera_from_world,
        problem.observations,
    )
    # NumPy's sum over an axis of two entries takes four times as long.
    squares = np.einsum("vpk,vpk->vp", residuals, residuals)
    squares = squares / float(problem.pixel_sigma) ** 2
    return np.where(np.isfinite(squares), squares, 2.0 * INVALID_PROJECTION_RESIDUAL**2)


def solve_with_estimated_sigma(
    problem: JointProblem,
    solve_problem: Callable[[JointProblem, Step], tuple[Solution, NormalEquations]],
    variance_factor: Callable[[JointProblem, Float[np.ndarray, "views points"]], AnyScalar],
    tolerance: float,
    maximum_fits: int,
) -> tuple[JointProblem, Solution, NormalEquations, float]:
    """Fit and estimate the pixel sigma in turn, until the two agree.

    Args:
        problem: the problem with the first pixel sigma.
        solve_problem: solves a problem from a step.
        variance_factor: function from a problem and the squared whitened residuals of its fit to
            the variance of the residuals over the assumed variance.
        tolerance: relative change of the pixel sigma at which to stop.
        maximum_fits: number of fits after which to stop.

    Returns:
        The problem with the pixel sigma of the last fit, the results of the last fit, and the pixel
        sigma estimated from its residuals.
    """
    step = problem.zero_step()
    for fits in range(1, maximum_fits + 1):
        solution, equations = solve_problem(problem, step)
        step, assumed_sigma = solution.z, float(problem.pixel_sigma)
        factor = variance_factor(problem, squared_residuals(problem, solution.chain))
        sigma = float(updated_sigma(assumed_sigma, factor))
        if abs(sigma - assumed_sigma) <= tolerance * assumed_sigma or fits == maximum_fits:
            return problem, solution, equations, sigma
        problem = with_pixel_sigma(problem, sigma)
    raise ValueError(f"maximum_fits: expected at least 1, found {maximum_fits}")
