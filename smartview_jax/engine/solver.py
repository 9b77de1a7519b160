"""Levenberg-Marquardt on the structured normal equations, as an optimistix solver.

Optimistix provides everything but the linearisation: its damped Newton descent (with the Schur
complement as linear solver), its trust region, its loop and its implicit differentiation.
Convergence is tested by the decrease of the cost that one more undamped step predicts. Tests of
single parameters say little on ill-conditioned data, and tests of the cost alone stop too early on
data without noise.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Bool, Float, Int, Scalar

from ..array_namespace import to_device
from ..compilation import compiled
from .losses import Cauchy
from .parameters import Step
from .problem import FittedChain, JointProblem, NormalEquations
from .schur import BlockArrow, SchurCholesky

MAX_RECORDED_COSTS = 64
"""Largest number of costs recorded along the steps of a fit."""

SCALED_COLUMN_NORM = 1e4
"""Length to which the Jacobian's columns at the start are scaled.

The diagonal of the normal equations is then 1e8. Optimistix's damping starts at 1, which is a
hundred-millionth of that.
"""

MAX_CONSECUTIVE_REJECTIONS = 25
"""Largest number of rejected steps in a row before a fit is given up."""

MIN_UNPADDED_OBSERVATIONS = 40_000
"""Smallest number of observations, visible or not, of a problem that is solved without padding.

With more, the additional columns cost more than the compilation of a program that has none.
"""

MAXIMUM_STEPS = 200
"""Largest number of solver steps of a fit."""

QuadraticModel = optx.FunctionInfo.EvalGradHessian
"""Cost, gradient and Gauss-Newton matrix in the form that optimistix expects."""


class _State(eqx.Module):
    """The state of the solver between steps: accepted linearisation, and next step to try."""

    first_step: Bool[Array, ""]
    y_eval: Step
    scale: Step
    search_state: Any
    f_info: QuadraticModel
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
    at the start have length `SCALED_COLUMN_NORM`, so that one damping suits all of them.

    Attributes:
        rtol: relative tolerance: converged if an undamped step predicts a decrease of the cost by
            at most this fraction.
        atol: absolute tolerance of the same decrease, added to the relative one.
        norm: not used; required by optimistix's interface.
        descent: optimistix's damped Newton descent.
        search: optimistix's trust region.
    """

    # Optimistix expects numbers; arrays let one program serve all tolerances.
    rtol: float | Float[Array, ""] = 1e-10  # pyright: ignore[reportIncompatibleVariableOverride]
    atol: float | Float[Array, ""] = 1e-14  # pyright: ignore[reportIncompatibleVariableOverride]
    norm: Callable[[Any], Scalar] = optx.max_norm
    descent: optx.AbstractDescent = optx.DampedNewtonDescent(linear_solver=SchurCholesky())
    search: optx.AbstractSearch = optx.ClassicalTrustRegion(
        high_cutoff=0.75, high_constant=10.0, low_constant=0.05
    )

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        """Return the state before the first step.

        Raises:
            ValueError: the function to minimise is not the residuals of a `JointProblem`.
        """
        expected = jax.eval_shape(_residuals, y, args) if isinstance(args, JointProblem) else None
        if f_struct != expected:
            raise ValueError(
                "StructuredLM minimises the residuals of the JointProblem that is given as args, "
                "and no other function; for others take optimistix.LevenbergMarquardt"
            )
        del fn, options, aux_struct, tags
        struct = jax.eval_shape(_quadratic_model, args, y)
        return _State(
            first_step=jnp.array(True),
            y_eval=y,
            scale=jax.tree.map(jnp.ones_like, y),
            search_state=self.search.init(y, struct),
            f_info=jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), struct),
            descent_state=self.descent.init(y, struct),
            steps=jnp.array(0),
            rejections=jnp.array(0),
            costs=jnp.full(MAX_RECORDED_COSTS, jnp.nan),
            terminate=jnp.array(False),
            result=optx.RESULTS.successful,
        )

    def step(self, fn, y, args, options, state, tags) -> tuple[Step, _State, None]:
        """Evaluate the step proposed last, accept or reject it, and propose the next one."""
        del fn, options, tags
        # Once per step tried, accepted or not: cost, gradient g and matrix H at the new parameters.
        trial = _quadratic_model(args, state.y_eval)
        scale = _tree_where(
            state.first_step, jacobi_scale(_gauss_newton_matrix(trial)), state.scale
        )
        trial = _rescale(trial, scale)
        # rho = actual decrease / predicted decrease. Accepted if rho > 0.01; the damping is divided
        # by 10 if rho > 0.75, and multiplied by 20 if the step is rejected.
        step_size, accept, _, search_state = self.search.step(
            state.first_step,
            jax.tree.map(jnp.divide, y, scale),
            jax.tree.map(jnp.divide, state.y_eval, scale),
            state.f_info,
            trial,
            state.search_state,
        )
        # After a rejection the last accepted linearisation is used again, with more damping.
        y, f_info = _tree_where(accept, (state.y_eval, trial), (y, state.f_info))
        descent_state = self.descent.query(y, f_info, state.descent_state)
        # (H + lambda I) d = -g with lambda = 1 / step_size. Once per damping: one Schur
        # elimination, one solve.
        scaled_step, result = self.descent.step(step_size, descent_state)
        # Converged if -g.d - d.H d / 2 <= rtol cost + atol for the undamped step d. It is computed
        # only if the damped step predicts so little too, since it costs another elimination.
        tolerance = self.rtol * f_info.f + self.atol
        is_negligible = _predicted_decrease(f_info, scaled_step) <= tolerance
        converged = jax.lax.cond(
            is_negligible,
            lambda: _predicted_decrease(f_info, _gauss_newton_step(f_info)) <= tolerance,
            lambda: jnp.array(False),
        )
        rejections = jnp.where(accept, 0, state.rejections + 1)
        failed = (rejections > MAX_CONSECUTIVE_REJECTIONS) | ~jnp.isfinite(f_info.f)
        result = optx.RESULTS.where(failed & ~converged, optx.RESULTS.nonlinear_divergence, result)
        return (
            y,
            _State(
                first_step=jnp.array(False),
                y_eval=jax.tree.map(lambda y, d, s: y + d * s, y, scaled_step, scale),
                scale=scale,
                search_state=search_state,
                f_info=f_info,
                descent_state=descent_state,
                steps=state.steps + 1,
                rejections=rejections,
                costs=state.costs.at[jnp.minimum(state.steps, MAX_RECORDED_COSTS - 1)].set(
                    f_info.f
                ),
                terminate=converged | failed,
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


# Compiled by itself, it is traced once within a program, and not for each of its two uses.
@compiled
def _quadratic_model(problem: JointProblem, z: Step) -> QuadraticModel:
    """Linearise the problem at a scaled step."""
    equations = problem.normal_equations(z)
    return QuadraticModel(equations.cost, equations.gradient, equations.matrix)


def _tree_where(condition: Bool[Array, ""], new: Any, old: Any) -> Any:
    """Choose between two pytrees by a scalar condition."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def _gauss_newton_matrix(model: QuadraticModel) -> BlockArrow:
    """Return the Gauss-Newton matrix as a `BlockArrow`."""
    assert isinstance(model.hessian, BlockArrow)
    return model.hessian


def jacobi_scale(matrix: BlockArrow) -> Step:
    """Return the unit of each parameter in which all columns of the Jacobian have the same length.

    The length is `SCALED_COLUMN_NORM`; a zero column is left as it is.
    """
    # The diagonal of J^T J holds the squared lengths of the columns.
    return jax.tree.map(
        lambda s: SCALED_COLUMN_NORM / jnp.sqrt(jnp.where(s > 0.0, s, 1.0)), matrix.diagonal()
    )


def _rescale(model: QuadraticModel, scale: Step) -> QuadraticModel:
    """Convert a linearisation to other units: `diag(scale) g`, `diag(scale) H diag(scale)`."""
    gradient = jax.tree.map(jnp.multiply, model.grad, scale)
    return QuadraticModel(model.f, gradient, _gauss_newton_matrix(model).scaled(scale))


def _predicted_decrease(model: QuadraticModel, step: Step) -> Float[Array, ""]:
    """Compute the decrease of the linearised problem's cost along a step."""
    # cost(0) - cost(d) = -g.d - d.H d / 2, with d the step and h = H d
    hessian_step = _gauss_newton_matrix(model).mv(step)
    decreases = jax.tree.map(
        lambda d, g, h: -jnp.sum(d * (g + 0.5 * h)), step, model.grad, hessian_step
    )
    return decreases.shared + decreases.per_view


def _gauss_newton_step(model: QuadraticModel) -> Step:
    """Compute the Gauss-Newton step to the linearised optimum, with negligible damping."""
    solver = SchurCholesky()
    # Damping of 1e-12 of the diagonal: a singular matrix still has a Cholesky factor.
    factors = solver.init(
        _gauss_newton_matrix(model).damped(jnp.asarray(1e-12 * SCALED_COLUMN_NORM**2)), {}
    )
    return jax.tree.map(jnp.negative, solver.compute(factors, model.grad, {})[0])


class Solution(NamedTuple):
    """The result of a solver.

    Attributes:
        z: step from the start to the result.
        costs: half the sum of squared residuals at the start and after every step, as far as
            recorded.
        steps: number of solver steps.
        relative_decrease: decrease of the cost that one more Gauss-Newton step predicts, as a
            fraction of the cost.
        converged: whether that decrease is negligible.
        chain: the chain of every view at the result.
    """

    z: Step
    costs: tuple[float, ...]
    steps: int
    relative_decrease: float
    converged: bool
    chain: FittedChain


def is_converged(predicted_decrease: Any, cost: Any) -> Any:
    """Return whether a fit has converged: a further step predicts a negligible decrease.

    Both are numbers on the host, or scalar arrays inside `jit`; the result is of the same kind.
    """
    return (abs(predicted_decrease) < 1e-8 * cost) | (abs(predicted_decrease) < 1e-12)


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
    free_count = len(problem.free)
    if solver is None:
        solver = StructuredLM()
    if isinstance(solver, StructuredLM):
        rtol, atol = (to_device(np.array(value)) for value in (solver.rtol, solver.atol))
        solver = dataclasses.replace(solver, rtol=rtol, atol=atol)
        problem = padded(problem)
    else:
        # Padding would make the residuals' Jacobian singular, which not every solver allows for.
        problem = _with_jacobi_scale(problem)
    initial = problem.zero_step() if start is None else _padded_step(start, problem)
    z, steps, recorded_costs, equations, predicted_decrease, chain = _minimise_and_evaluate(
        problem, solver, maximum_steps, initial
    )
    cost, predicted_decrease = float(equations.cost), float(predicted_decrease)
    relative_decrease = predicted_decrease / max(cost, 1e-300)
    converged = bool(is_converged(predicted_decrease, cost))
    # Entries that were never reached are NaN.
    recorded_costs = np.asarray(recorded_costs)
    costs = (*recorded_costs[np.isfinite(recorded_costs)].tolist(), cost)
    if len(problem.free) > free_count:
        z = Step(to_device(np.asarray(z.shared)[:free_count]), z.per_view)
        equations = _without_padding(equations, free_count)
    return Solution(z, costs, int(steps), relative_decrease, converged, chain), equations


def padded(problem: JointProblem) -> JointProblem:
    """Return a small problem with as many free parameters as there are, the others without effect.

    Small problems that differ in what is free or in their loss, as they do within one calibration,
    are then solved by the same program, which takes far longer to compile than to run.
    """
    size, count = problem.parameters.layout.size, len(problem.free)
    if problem.observations.visible.size >= MIN_UNPADDED_OBSERVATIONS or problem.mesh is not None:
        return problem
    free = np.concatenate([problem.free, np.full(size - count, size)])
    scale = np.concatenate([problem.scale.shared, np.ones(size - count)])
    loss = problem.loss
    if loss is None or isinstance(loss, Cauchy):
        # Least squares is the Cauchy loss of infinite scale.
        loss = Cauchy(to_device(np.array(np.inf if loss is None else loss.scale)))
    return dataclasses.replace(
        problem,
        free=to_device(free),
        scale=Step(to_device(scale), problem.scale.per_view),
        loss=loss,
    )


def _padded_step(step: Step, problem: JointProblem) -> Step:
    """Return a step with zeros for the padding of a problem."""
    padding = len(problem.free) - len(step.shared)
    return Step(to_device(np.pad(np.asarray(step.shared), (0, padding))), step.per_view)


def _without_padding(equations: NormalEquations, count: int) -> NormalEquations:
    """Return normal equations with the first free shared parameters only, copied by NumPy."""
    gradient, matrix = equations.gradient, equations.matrix
    return NormalEquations(
        equations.cost,
        Step(to_device(np.asarray(gradient.shared)[:count]), gradient.per_view),
        BlockArrow(
            to_device(np.asarray(matrix.shared)[:count, :count]),
            to_device(np.asarray(matrix.border)[:, :, :count]),
            matrix.per_view,
        ),
    )


@compiled
def _with_jacobi_scale(problem: JointProblem) -> JointProblem:
    """Return the problem in units that suit solvers that treat all parameters alike."""
    matrix = jax.lax.stop_gradient(problem).normal_equations(problem.zero_step()).matrix
    return eqx.tree_at(lambda p: p.scale, problem, jacobi_scale(matrix))


def minimise(
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
    solution = optx.least_squares(
        _residuals, solver, start, args=problem, max_steps=maximum_steps, throw=False
    )
    z = jax.tree.map(jnp.multiply, solution.value, problem.scale)
    if isinstance(solver, StructuredLM):
        model, scale = solution.state.f_info, solution.state.scale
    else:
        model, scale = _quadratic_model(problem, solution.value), jax.tree.map(jnp.ones_like, z)
    predicted_decrease = _predicted_decrease(model, _gauss_newton_step(model))
    # `unscale` converts the normal equations from scaled units to the parameters' own.
    unscale = jax.tree.map(lambda s, t: 1.0 / (s * t), scale, problem.scale)
    unscaled = _rescale(model, unscale)
    equations = NormalEquations(unscaled.f, unscaled.grad, _gauss_newton_matrix(unscaled))
    outputs = (
        z,
        solution.stats["num_steps"],
        solution.stats.get("costs", jnp.zeros(0)),
        equations,
        predicted_decrease,
    )
    if problem.mesh is not None:
        # Replicated over the mesh, so that every process can read the whole result.
        outputs = jax.lax.with_sharding_constraint(outputs, NamedSharding(problem.mesh, P()))
    return outputs


@compiled
def _minimise_and_evaluate(
    problem: JointProblem,
    solver: optx.AbstractLeastSquaresSolver,
    maximum_steps: int,
    start: Step,
) -> tuple[Step, Array, Array, NormalEquations, Array, FittedChain]:
    """Minimise from a step in the parameters' own units, and return the chain at the end too."""
    outputs = minimise(
        problem, solver, maximum_steps, jax.tree.map(jnp.divide, start, problem.scale)
    )
    # `minimise` returns a step in the parameters' own units.
    chain = problem.chain(jax.tree.map(jnp.divide, outputs[0], problem.scale))
    if problem.mesh is not None:
        chain = jax.lax.with_sharding_constraint(chain, NamedSharding(problem.mesh, P()))
    return *outputs, chain


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
    array in `problem`: pixels, poses, priors, and the start's own values. For instance, where the
    camera sits on the hand as a function of the measured pixels, and its derivative:

        problem = sv.build_problem(data, start).problem

        def hand_eye_translation(pixels):
            changed = eqx.tree_at(lambda p: p.observations.pixels, problem, pixels)
            calibration, _ = changed.calibration(sv.optimum(changed))
            return calibration.camera_from_tool.translation()

        metres_per_pixel = jax.jacrev(hand_eye_translation)(data.pixels)

    Args:
        problem: from `build_problem`, with any of its arrays changed.
        solver: optimistix least-squares solver; by default the engine's own.
        start: step to begin at; by default none.
        maximum_steps: number of steps after which the last one is returned as it is.
    """
    # The derivatives need a linear solve at the optimum, which these units keep well conditioned.
    scaled = _with_jacobi_scale(problem)
    jacobi_units = scaled.scale
    initial = (
        problem.zero_step() if start is None else jax.tree.map(jnp.divide, start, jacobi_units)
    )
    result = optx.least_squares(
        _residuals,
        StructuredLM() if solver is None else solver,
        initial,
        args=scaled,
        max_steps=maximum_steps,
        throw=False,
    )
    return jax.tree.map(jnp.multiply, result.value, jacobi_units)
