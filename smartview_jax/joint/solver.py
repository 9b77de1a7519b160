"""Levenberg-Marquardt by optimistix, with a test of convergence that can be trusted.

Element-wise tests of the step say little on ill-conditioned data, and tests of the cost stop early
on noise-free ones. The fit counts as converged where one more Gauss-Newton step could lower the
cost by no more than a 1e-8th of it (or 1e-12 of a unit in all): cost, gradient and step at once.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from .problem import JointProblem

ROUNDS = 4
"""A solver that stopped early is started again from where it stood, with fresh damping."""


class Solution(NamedTuple):
    """Where a solver came to.

    Attributes:
        z: scaled step.
        costs: half the squared residual after every round, the start's first.
        steps: solver steps in all.
        decrease: what one more Gauss-Newton step would save, as a share of the cost.
        converged: whether that is next to nothing.
    """

    z: Float[Array, "free"]
    costs: tuple[float, ...]
    steps: int
    decrease: float
    converged: bool


def default_solver() -> optx.AbstractLeastSquaresSolver:
    """LM on the normal equations: the problem is scaled, and tall and narrow."""
    return optx.LevenbergMarquardt(rtol=1e-10, atol=1e-8, linear_solver=lx.Normal(lx.Cholesky()))


def solve(
    problem: JointProblem,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    maximum_steps: int = 200,
) -> Solution:
    """Minimise a problem from its start; never raises for a fit that failed."""
    solver = default_solver() if solver is None else solver
    z = jnp.zeros(len(problem.free))
    start_cost, _ = _cost_and_decrease(problem, z)
    costs, steps = [start_cost], 0
    share, converged = float("inf"), False
    for _ in range(ROUNDS):
        z, taken = _run(problem, solver, z, maximum_steps)
        cost, decrease = _cost_and_decrease(problem, z)
        steps, costs = steps + int(taken), [*costs, cost]
        share = decrease / max(cost, 1e-300)
        converged = bool(share < 1e-8 or decrease < 1e-12)
        if converged or not cost < float("inf"):
            break
    return Solution(z, tuple(costs), steps, share, converged)


@eqx.filter_jit
def optimum(
    problem: JointProblem,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    start: Float[Array, "free"] | None = None,
    maximum_steps: int = 200,
) -> Float[Array, "free"]:
    """The scaled step to the optimum, for use inside `jit`, `vmap` and `grad`.

    Derivatives are those of the optimum (implicit function theorem), with respect to every array
    in `problem`: pixels, poses, priors, the start's own numbers.
    """
    start = jnp.zeros(len(problem.free)) if start is None else start
    return optx.least_squares(
        lambda z, p: p.residuals(z),
        default_solver() if solver is None else solver,
        start,
        args=problem,
        max_steps=maximum_steps,
        throw=False,
    ).value


@eqx.filter_jit
def _run(
    problem: JointProblem,
    solver: optx.AbstractLeastSquaresSolver,
    z: Float[Array, "free"],
    maximum_steps: int,
) -> tuple[Float[Array, "free"], Array]:
    solution = optx.least_squares(
        lambda z, p: p.residuals(z), solver, z, args=problem, max_steps=maximum_steps, throw=False
    )
    return solution.value, solution.stats["num_steps"]


@eqx.filter_jit
def linearise(
    problem: JointProblem, z: Float[Array, "free"]
) -> tuple[Float[Array, "rows"], Float[Array, "rows free"]]:
    """Residuals and their Jacobian at a scaled step."""
    return problem.residuals(z), problem.jacobian(z)


def _cost_and_decrease(problem: JointProblem, z: Float[Array, "free"]) -> tuple[float, float]:
    r, J = (np.asarray(x) for x in linearise(problem, z))
    cost = 0.5 * float(r @ r)
    if not np.isfinite(cost) or not np.isfinite(J).all():
        return float("inf"), float("inf")
    values, vectors = np.linalg.eigh(J.T @ J)
    along = vectors.T @ (J.T @ r)
    # Directions that the data do not see are left out: no step there can lower the cost.
    seen = values > 1e-12 * values[-1]
    return cost, 0.5 * float(np.sum(along[seen] ** 2 / values[seen]))
