"""Levenberg-Marquardt on the structured normal equations, as an optimistix solver.

Optimistix provides everything but the linearisation: its damped Newton descent (with the Schur
complement as linear solver), its trust region, its loop and its implicit differentiation.
Convergence is tested by the decrease of the cost that one more undamped step predicts. Tests of
single parameters are unreliable on ill-conditioned data, and tests of the cost alone stop too early
on data without noise.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, Scalar

from ..runtime.array_namespace import where_tree
from ..runtime.compilation import compiled
from .abstract_problem import AbstractProblem
from .parameters import Step
from .schur import BlockArrow, SchurCholesky

MAX_RECORDED_COSTS = 64
"""Largest number of costs recorded along the steps of a fit."""

SCALED_COLUMN_NORM = 1e4
"""Length to which the Jacobian's columns at the start are scaled.

The diagonal of the normal equations is then 1e8, and Optimistix's initial damping of 1 is a
hundred-millionth of it.
"""

MAX_CONSECUTIVE_REJECTIONS = 25
"""Largest number of rejected steps in a row before a fit is given up."""

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
    """A Levenberg-Marquardt solver for an `AbstractProblem`, which is passed as `args`.

    The function to minimise must be the problem's `residuals`; it is linearised by
    `normal_equations`. Internally the parameters are in units in which the columns of the Jacobian
    at the start have length `SCALED_COLUMN_NORM`, so that one damping suits all parameters.

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
            ValueError: the function to minimise is not the residuals of an `AbstractProblem`.
        """
        expected = (
            jax.eval_shape(ordered_residuals, y, args)
            if isinstance(args, AbstractProblem)
            else None
        )
        if f_struct != expected:
            raise ValueError(
                "StructuredLM minimises only the residuals of a JointProblem, given as args; for "
                "other functions use optimistix.LevenbergMarquardt"
            )
        del fn, options, aux_struct, tags
        struct = jax.eval_shape(quadratic_model, args, y)
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
        trial = quadratic_model(args, state.y_eval)
        scale = where_tree(state.first_step, jacobi_scale(gauss_newton_matrix(trial)), state.scale)
        trial = rescale(trial, scale)
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
        y, f_info = where_tree(accept, (state.y_eval, trial), (y, state.f_info))
        descent_state = self.descent.query(y, f_info, state.descent_state)
        # (H + lambda I) d = -g with lambda = 1 / step_size. Once per damping: one Schur
        # elimination, one solve.
        scaled_step, result = self.descent.step(step_size, descent_state)
        # Converged if -g.d - d.H d / 2 <= rtol cost + atol for the undamped step d, which costs
        # another elimination and so is computed only if the damped step meets the test.
        tolerance = self.rtol * f_info.f + self.atol
        is_negligible = decrease_along(f_info, scaled_step) <= tolerance
        converged = jax.lax.cond(
            is_negligible,
            lambda: undamped_decrease(f_info) <= tolerance,
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


# Compiled separately, so that a program traces it once, not for each of its two uses.
@compiled
def quadratic_model(problem: AbstractProblem, z: Step) -> QuadraticModel:
    """Linearise the problem at a scaled step."""
    equations = problem.normal_equations(z)
    return QuadraticModel(equations.cost, equations.gradient, equations.matrix)


def gauss_newton_matrix(model: QuadraticModel) -> BlockArrow:
    """Return the Gauss-Newton matrix as a `BlockArrow`."""
    assert isinstance(model.hessian, BlockArrow)
    return model.hessian


def jacobi_scale(matrix: BlockArrow) -> Step:
    """Return units of the parameters in which all columns of the Jacobian have the same length.

    The length is `SCALED_COLUMN_NORM`; zero columns are not scaled.
    """
    # The diagonal of J^T J holds the squared lengths of the columns.
    return jax.tree.map(
        lambda s: SCALED_COLUMN_NORM / jnp.sqrt(jnp.where(s > 0.0, s, 1.0)), matrix.diagonal()
    )


def rescale(model: QuadraticModel, scale: Step) -> QuadraticModel:
    """Convert a linearisation to other units: `diag(scale) g`, `diag(scale) H diag(scale)`."""
    gradient = jax.tree.map(jnp.multiply, model.grad, scale)
    return QuadraticModel(model.f, gradient, gauss_newton_matrix(model).scaled(scale))


def decrease_along(model: QuadraticModel, step: Step) -> Float[Array, ""]:
    """Compute the decrease of the linearised problem's cost along a step."""
    # cost(0) - cost(d) = -g.d - d.H d / 2, with d the step and h = H d
    hessian_step = gauss_newton_matrix(model).mv(step)
    decreases = jax.tree.map(
        lambda d, g, h: -jnp.sum(d * (g + 0.5 * h)), step, model.grad, hessian_step
    )
    return decreases.shared + decreases.per_view


def gauss_newton_step(model: QuadraticModel) -> Step:
    """Compute the Gauss-Newton step to the linearised optimum, with negligible damping."""
    solver = SchurCholesky()
    # Damping of 1e-12 of the diagonal: a singular matrix still has a Cholesky factor.
    factors = solver.init(
        gauss_newton_matrix(model).damped(jnp.asarray(1e-12 * SCALED_COLUMN_NORM**2)), {}
    )
    return jax.tree.map(jnp.negative, solver.compute(factors, model.grad, {})[0])


# Compiled separately like the linearisation, for its two uses in a program.
@compiled
def undamped_decrease(model: QuadraticModel) -> Float[Array, ""]:
    """Compute the decrease of the linearised problem's cost by the Gauss-Newton step."""
    return decrease_along(model, gauss_newton_step(model))


def is_converged(predicted_decrease: Any, cost: Any) -> Any:
    """Return whether a fit has converged: a further step predicts a negligible decrease.

    The arguments, and the result, are numbers on the host or scalar arrays inside `jit`.
    """
    return (abs(predicted_decrease) < 1e-8 * cost) | (abs(predicted_decrease) < 1e-12)


# Compiled separately: optimistix traces the function, and the solver asks for its shapes.
@compiled
def ordered_residuals(z: Step, problem: AbstractProblem) -> tuple[Array, Array, Array]:
    """Return the residuals with the arguments in the order that optimistix expects."""
    return problem.residuals(z)
