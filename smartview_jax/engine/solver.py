"""Levenberg-Marquardt on the structured normal equations, as an optimistix solver.

Everything but the linearisation is optimistix's: its damped Newton descent (with the Schur
complement as its linear solver), its trust region, its loop and its implicit differentiation. What
is tested at the end is what one more step could still gain: tests of single parameters say little
on ill-conditioned data, and tests of the cost alone stop early on data without noise.
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
"""Costs kept of a fit's steps."""

UNIT = 1e4
"""Length of a column. Optimistix's damping begins at 1: next to this, a hundred-millionth."""

MOST_REJECTIONS = 25
"""Steps in a row that may raise the cost before a fit gives up."""

MAXIMUM_STEPS = 200

Info = optx.FunctionInfo.EvalGradHessian


class _State(eqx.Module):
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
    """Levenberg-Marquardt for a `JointProblem`, which is passed as `args`.

    The function to minimise must be that problem's `residuals`: it is linearised by
    `normal_equations`. Inside, parameters are measured in units in which the columns of the
    Jacobian at the start are `UNIT` long, so that one damping suits them all.

    Attributes:
        rtol: converged when an undamped step would lower the cost by no more than this share.
        atol: or by no more than this.
        norm: not used; part of optimistix's interface.
        descent, search: optimistix's.
    """

    rtol: float = 1e-10
    atol: float = 1e-14
    norm: Callable[[Any], Scalar] = optx.max_norm
    descent: optx.AbstractDescent = optx.DampedNewtonDescent(linear_solver=SchurCholesky())
    search: optx.AbstractSearch = optx.ClassicalTrustRegion(
        high_cutoff=0.75, high_constant=10.0, low_constant=0.05
    )

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
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
        del fn, options, tags
        found = _info(args, state.y_eval)
        scale = _where(state.first_step, unit_scale(_matrix(found)), state.scale)
        found = _in_units(found, scale)
        step_size, accept, _, search_state = self.search.step(
            state.first_step,
            jax.tree.map(jnp.divide, y, scale),
            jax.tree.map(jnp.divide, state.y_eval, scale),
            state.f_info,
            found,
            state.search_state,
        )
        y, f_info = _where(accept, (state.y_eval, found), (y, state.f_info))
        descent_state = self.descent.query(y, f_info, state.descent_state)
        move, result = self.descent.step(step_size, descent_state)
        # Only where the damped step promises nothing is it worth asking the undamped one.
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
        del fn, y, args, options, tags
        return state.terminate, state.result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        del fn, args, options, tags, result
        return y, aux, {"costs": state.costs}


def _info(problem: JointProblem, z: Step) -> Info:
    equations = problem.normal_equations(z)
    return Info(equations.cost, equations.gradient, equations.matrix)


def _where(condition: Bool[Array, ""], new: Any, old: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def _matrix(info: Info) -> BlockArrow:
    assert isinstance(info.hessian, BlockArrow)
    return info.hessian


def unit_scale(matrix: BlockArrow) -> Step:
    """The size of each parameter that makes the columns of the Jacobian `UNIT` long."""
    return jax.tree.map(lambda s: UNIT / jnp.sqrt(jnp.where(s > 0.0, s, 1.0)), matrix.diagonal())


def _in_units(info: Info, scale: Step) -> Info:
    gradient = jax.tree.map(jnp.multiply, info.grad, scale)
    return Info(info.f, gradient, _matrix(info).scaled(scale))


def _promise(info: Info, move: Step) -> Float[Array, ""]:
    """By how much the linearised problem's cost falls along a step."""
    curved = _matrix(info).mv(move)
    parts = jax.tree.map(lambda m, g, c: -jnp.sum(m * (g + 0.5 * c)), move, info.grad, curved)
    return parts.shared + parts.corrections


def _newton(info: Info) -> Step:
    """The step to the linearised problem's optimum, as good as undamped."""
    solver = SchurCholesky()
    damped = solver.init(_matrix(info).damped(jnp.asarray(1e-12 * UNIT**2)), {})
    return jax.tree.map(jnp.negative, solver.compute(damped, info.grad, {})[0])


class Solution(NamedTuple):
    """Where a solver came to.

    Attributes:
        z: the step.
        costs: half the squared residual at the start and after every step, as far as recorded.
        steps: solver steps in all.
        decrease: what one more Gauss-Newton step would save, as a share of the cost.
        converged: whether that is next to nothing.
    """

    z: Step
    costs: tuple[float, ...]
    steps: int
    decrease: float
    converged: bool


def next_to_nothing(gain: ScalarLike, cost: ScalarLike) -> Bool[Array, ""]:
    """Whether what a further step would gain is so little that a fit counts as converged."""
    return (jnp.abs(gain) < 1e-8 * cost) | (jnp.abs(gain) < 1e-12)


def solve(
    problem: JointProblem,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    maximum_steps: int = MAXIMUM_STEPS,
    start: Step | None = None,
) -> tuple[Solution, NormalEquations]:
    """Minimise a problem from its start; never raises for a fit that failed.

    Args:
        problem: in the parameters' own units.
        solver: any of optimistix's; None is `StructuredLM`.
        maximum_steps: after which it stops.
        start: a step from which to begin instead.

    Returns:
        The solution, and the normal equations there.
    """
    if solver is None:
        solver = StructuredLM()
    elif not isinstance(solver, StructuredLM):
        problem = _scaled(problem)
    first = problem.start() if start is None else jax.tree.map(jnp.divide, start, problem.scale)
    z, steps, record, equations, gain = _run_alone(problem, solver, maximum_steps, first)
    cost, gain, record = float(equations.cost), float(gain), np.asarray(record)
    share, converged = gain / max(cost, 1e-300), bool(next_to_nothing(gain, cost))
    costs = (*record[np.isfinite(record)].tolist(), cost)
    return Solution(z, costs, int(steps), share, converged), equations


@compiled
def _scaled(problem: JointProblem) -> JointProblem:
    """The same problem in other units, for solvers that treat all parameters alike."""
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
        The step, the number of solver steps, the costs on the way, the normal equations there, and
        what one more Gauss-Newton step would save.
    """
    found = optx.least_squares(
        _residuals, solver, start, args=problem, max_steps=maximum_steps, throw=False
    )
    z = jax.tree.map(jnp.multiply, found.value, problem.scale)
    if isinstance(solver, StructuredLM):
        info, scale = found.state.f_info, found.state.scale
    else:
        info, scale = _info(problem, found.value), jax.tree.map(jnp.ones_like, z)
    gain = _promise(info, _newton(info))
    back = jax.tree.map(lambda s, t: 1.0 / (s * t), scale, problem.scale)
    natural = _in_units(info, back)
    equations = NormalEquations(natural.f, natural.grad, _matrix(natural))
    answer = (z, found.stats["num_steps"], found.stats.get("costs", jnp.zeros(0)), equations, gain)
    if problem.mesh is not None:
        # Every process may then read all of it.
        answer = jax.lax.with_sharding_constraint(answer, NamedSharding(problem.mesh, P()))
    return answer


_run_alone = compiled(run)


def _residuals(z: Step, problem: JointProblem) -> tuple[Array, Array, Array]:
    return problem.residuals(z)


@compiled
def optimum(
    problem: JointProblem,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    start: Step | None = None,
    maximum_steps: int = MAXIMUM_STEPS,
) -> Step:
    """The step to the optimum, for use inside `jit`, `vmap` and `grad`.

    Derivatives are those of the optimum (implicit function theorem), with respect to every array
    in `problem`: pixels, poses, priors, the start's own numbers.
    """
    # In good units: the linear solve behind the derivatives is then well conditioned.
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
