"""Levenberg-Marquardt on the structured normal equations, as an optimistix solver.

Optimistix provides everything but the linearisation: its damped Newton descent (with the Schur
complement as linear solver), its trust region, its loop and its implicit differentiation.
Convergence is tested by the decrease of the cost that one more undamped step predicts. Tests of
single parameters say little on ill-conditioned data, and tests of the cost alone stop too early on
data without noise.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Bool, Float, Int, Scalar, ScalarLike

from ..compilation import compiled
from .parameters import Step
from .problem import JointProblem, NormalEquations
from .schur import BlockArrow, SchurCholesky

RECORD = 64
"""Largest number of costs recorded along the steps of a fit."""

UNIT = 1e4
"""Length to which the Jacobian's columns at the start are scaled.

The diagonal of the normal equations is then 1e8. Optimistix's damping starts at 1, which is a
hundred-millionth of that.
"""

MOST_REJECTIONS = 25
"""Largest number of rejected steps in a row before a fit is given up."""

MAXIMUM_STEPS = 200
"""Largest number of solver steps of a fit."""

Info = optx.FunctionInfo.EvalGradHessian
"""Cost, gradient and Gauss-Newton matrix in the form that optimistix expects."""


class _State(eqx.Module):
    """The state of the solver between steps: accepted linearisation, and next step to try."""

    first_step: Bool[Array, ""]
    y_eval: Step
    scale: Step
    search_state: Any
    f_info: Info
    descent_state: Any
    steps: Int[Array, ""]
    rejections: Int[Array, ""]
    costs: Float[Array, "record"]
    terminate: Bool[Array, ""]
    result: optx.RESULTS


class StructuredLM(optx.AbstractLeastSquaresSolver):
    """A Levenberg-Marquardt solver for a `JointProblem`, which is passed as `args`.

    The function to minimise must be that problem's `residuals`; it is linearised by
    `normal_equations`. Internally the parameters are in units in which the columns of the Jacobian
    at the start have length `UNIT`, so that one damping suits all of them.

    Attributes:
        rtol: relative tolerance: converged if an undamped step predicts a decrease of the cost by
            at most this fraction.
        atol: absolute tolerance of the same decrease, added to the relative one.
        norm: not used; required by optimistix's interface.
        descent: optimistix's damped Newton descent.
        search: optimistix's trust region.
    """

    rtol: float = 1e-10
    atol: float = 1e-14
    norm: Callable[[Any], Scalar] = optx.max_norm
    descent: optx.AbstractDescent = optx.DampedNewtonDescent(linear_solver=SchurCholesky())
    search: optx.AbstractSearch = optx.ClassicalTrustRegion(
        high_cutoff=0.75, high_constant=10.0, low_constant=0.05
    )

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        """Return the state before the first step."""
        del fn, options, f_struct, aux_struct, tags
        struct = jax.eval_shape(_info, args, y)
        return _State(
            first_step=jnp.array(True),
            y_eval=y,
            scale=jax.tree.map(jnp.ones_like, y),
            search_state=self.search.init(y, struct),
            f_info=jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), struct),
            descent_state=self.descent.init(y, struct),
            steps=jnp.array(0),
            rejections=jnp.array(0),
            costs=jnp.full(RECORD, jnp.nan),
            terminate=jnp.array(False),
            result=optx.RESULTS.successful,
        )

    def step(self, fn, y, args, options, state, tags) -> tuple[Step, _State, None]:
        """Evaluate the step proposed last, accept or reject it, and propose the next one."""
        del fn, options, tags
        # Once per step tried, accepted or not: cost, gradient g and matrix H at the new parameters.
        found = _info(args, state.y_eval)
        scale = _where(state.first_step, unit_scale(_matrix(found)), state.scale)
        found = _in_units(found, scale)
        # rho = actual decrease / predicted decrease. Accepted if rho > 0.01; the damping is divided
        # by 10 if rho > 0.75, and multiplied by 20 if the step is rejected.
        step_size, accept, _, search_state = self.search.step(
            state.first_step,
            jax.tree.map(jnp.divide, y, scale),
            jax.tree.map(jnp.divide, state.y_eval, scale),
            state.f_info,
            found,
            state.search_state,
        )
        # After a rejection the last accepted linearisation is used again, with more damping.
        y, f_info = _where(accept, (state.y_eval, found), (y, state.f_info))
        descent_state = self.descent.query(y, f_info, state.descent_state)
        # (H + lambda I) d = -g with lambda = 1 / step_size. Once per damping: one Schur
        # elimination, one solve.
        move, result = self.descent.step(step_size, descent_state)
        # Converged if -g.d - d.H d / 2 <= rtol cost + atol for the undamped step d. It is computed
        # only if the damped step predicts so little too, since it costs another elimination.
        enough = self.rtol * f_info.f + self.atol
        little = _promise(f_info, move) <= enough
        done = jax.lax.cond(
            little, lambda: _promise(f_info, _newton(f_info)) <= enough, lambda: jnp.array(False)
        )
        rejections = jnp.where(accept, 0, state.rejections + 1)
        stuck = (rejections > MOST_REJECTIONS) | ~jnp.isfinite(f_info.f)
        result = optx.RESULTS.where(stuck & ~done, optx.RESULTS.nonlinear_divergence, result)
        return (
            y,
            _State(
                first_step=jnp.array(False),
                y_eval=jax.tree.map(lambda y, m, s: y + m * s, y, move, scale),
                scale=scale,
                search_state=search_state,
                f_info=f_info,
                descent_state=descent_state,
                steps=state.steps + 1,
                rejections=rejections,
                costs=state.costs.at[jnp.minimum(state.steps, RECORD - 1)].set(f_info.f),
                terminate=done | stuck,
                result=result,
            ),
            None,
        )

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """Return whether the solver has converged or given up, and the result code."""
        del fn, y, args, options, tags
        return state.terminate, state.result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Return the result with the recorded costs as statistics."""
        del fn, args, options, tags, result
        return y, aux, {"costs": state.costs}


def _info(problem: JointProblem, z: Step) -> Info:
    """Linearise the problem at a scaled step."""
    equations = problem.normal_equations(z)
    return Info(equations.cost, equations.gradient, equations.matrix)


def _where(condition: Bool[Array, ""], new: Any, old: Any) -> Any:
    """Choose between two pytrees by a scalar condition."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def _matrix(info: Info) -> BlockArrow:
    """Return the Gauss-Newton matrix as a `BlockArrow`."""
    assert isinstance(info.hessian, BlockArrow)
    return info.hessian


def unit_scale(matrix: BlockArrow) -> Step:
    """Return the unit of each parameter in which the columns of the Jacobian have length `UNIT`."""
    return jax.tree.map(lambda s: UNIT / jnp.sqrt(jnp.where(s > 0.0, s, 1.0)), matrix.diagonal())


def _in_units(info: Info, scale: Step) -> Info:
    """Convert a linearisation to other units: `diag(scale) g`, `diag(scale) H diag(scale)`."""
    gradient = jax.tree.map(jnp.multiply, info.grad, scale)
    return Info(info.f, gradient, _matrix(info).scaled(scale))


def _promise(info: Info, move: Step) -> Float[Array, ""]:
    """Compute the decrease of the linearised problem's cost along a step."""
    # cost(0) - cost(d) = -g.d - d.H d / 2
    curved = _matrix(info).mv(move)
    parts = jax.tree.map(lambda m, g, c: -jnp.sum(m * (g + 0.5 * c)), move, info.grad, curved)
    return parts.shared + parts.corrections


def _newton(info: Info) -> Step:
    """Compute the Gauss-Newton step to the linearised optimum, with negligible damping."""
    solver = SchurCholesky()
    # Damping of 1e-12 of the diagonal: a singular matrix still has a Cholesky factor.
    damped = solver.init(_matrix(info).damped(jnp.asarray(1e-12 * UNIT**2)), {})
    return jax.tree.map(jnp.negative, solver.compute(damped, info.grad, {})[0])


class Solution(NamedTuple):
    """The result of a solver.

    Attributes:
        z: step from the start to the result.
        costs: half the sum of squared residuals at the start and after every step, as far as
            recorded.
        steps: number of solver steps.
        decrease: decrease of the cost that one more Gauss-Newton step predicts, as a fraction of
            it.
        converged: whether that decrease is negligible.
    """

    z: Step
    costs: tuple[float, ...]
    steps: int
    decrease: float
    converged: bool


def next_to_nothing(gain: ScalarLike, cost: ScalarLike) -> Bool[Array, ""]:
    """Return whether the predicted gain of a further step is so small that a fit has converged."""
    return (jnp.abs(gain) < 1e-8 * cost) | (jnp.abs(gain) < 1e-12)


def solve(
    problem: JointProblem,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    maximum_steps: int = MAXIMUM_STEPS,
    start: Step | None = None,
) -> tuple[Solution, NormalEquations]:
    """Minimise a problem from its start; a fit that fails does not raise.

    Args:
        problem: the problem, in the parameters' own units.
        solver: any least-squares solver of optimistix; None is `StructuredLM`.
        maximum_steps: number of steps after which the solver stops.
        start: step from which to begin instead of zero.

    Returns:
        The solution, and the normal equations at the solution.
    """
    if solver is None:
        solver = StructuredLM()
    elif not isinstance(solver, StructuredLM):
        problem = _scaled(problem)
    # z is in units of `problem.scale`, a start that is passed in is in the parameters' own units.
    first = problem.start() if start is None else jax.tree.map(jnp.divide, start, problem.scale)
    z, steps, record, equations, gain = _run_alone(problem, solver, maximum_steps, first)
    cost, gain, record = float(equations.cost), float(gain), np.asarray(record)
    share, converged = gain / max(cost, 1e-300), bool(next_to_nothing(gain, cost))
    costs = (*record[np.isfinite(record)].tolist(), cost)
    return Solution(z, costs, int(steps), share, converged), equations


@compiled
def _scaled(problem: JointProblem) -> JointProblem:
    """Return the problem in units that suit solvers that treat all parameters alike."""
    matrix = jax.lax.stop_gradient(problem).normal_equations(problem.start()).matrix
    return eqx.tree_at(lambda p: p.scale, problem, unit_scale(matrix))


def run(
    problem: JointProblem,
    solver: optx.AbstractLeastSquaresSolver,
    maximum_steps: int,
    start: Step,
) -> tuple[Step, Array, Array, NormalEquations, Array]:
    """Minimise a problem from a step in its units, inside `jit`.

    Returns:
        The step, the number of solver steps, the recorded costs, the normal equations at the
        result, and the decrease of the cost that one more Gauss-Newton step predicts.
    """
    found = optx.least_squares(
        _residuals, solver, start, args=problem, max_steps=maximum_steps, throw=False
    )
    z = jax.tree.map(jnp.multiply, found.value, problem.scale)
    if isinstance(solver, StructuredLM):
        info, scale = found.state.f_info, found.state.scale
    else:
        info, scale = _info(problem, found.value), jax.tree.map(jnp.ones_like, z)
    # `back` converts the normal equations from scaled units to the parameters' own.
    gain = _promise(info, _newton(info))
    back = jax.tree.map(lambda s, t: 1.0 / (s * t), scale, problem.scale)
    natural = _in_units(info, back)
    equations = NormalEquations(natural.f, natural.grad, _matrix(natural))
    answer = (z, found.stats["num_steps"], found.stats.get("costs", jnp.zeros(0)), equations, gain)
    if problem.mesh is not None:
        # Replicated over the mesh, so that every process can read the whole result.
        answer = jax.lax.with_sharding_constraint(answer, NamedSharding(problem.mesh, P()))
    return answer


_run_alone = compiled(run)


def _residuals(z: Step, problem: JointProblem) -> tuple[Array, Array, Array]:
    """Return the residuals with the arguments in the order that optimistix expects."""
    return problem.residuals(z)


@compiled
def optimum(
    problem: JointProblem,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    start: Step | None = None,
    maximum_steps: int = MAXIMUM_STEPS,
) -> Step:
    """Return the step to the optimum, for use inside `jit`, `vmap` and `grad`.

    Derivatives are those of the optimum by the implicit function theorem, with respect to every
    array in `problem`: pixels, poses, priors, and the start's own values.
    """
    # The derivatives need a linear solve at the optimum, which these units keep well conditioned.
    scaled = _scaled(problem)
    units = scaled.scale
    first = problem.start() if start is None else jax.tree.map(jnp.divide, start, units)
    found = optx.least_squares(
        _residuals,
        StructuredLM() if solver is None else solver,
        first,
        args=scaled,
        max_steps=maximum_steps,
        throw=False,
    )
    return jax.tree.map(jnp.multiply, found.value, units)
