"""Solve the joint problem from the host: pad it, minimise it, and return the result.

`optimum` is the same inside `jit`, `vmap` and `grad`.
"""

from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Float

from ..runtime.compilation import compiled
from ..runtime.modules import with_fields
from ..runtime.padding import host_without_padding, padded_counts, repeat_last
from .abstract_problem import AbstractProblem, NormalEquations
from .losses import Cauchy
from .parameters import Step, host_step
from .problem import JointProblem
from .rig_problem import RigProblem
from .structured_lm import (
    StructuredLM,
    gauss_newton_matrix,
    is_converged,
    jacobi_scale,
    ordered_residuals,
    quadratic_model,
    rescale,
    undamped_decrease,
)

_Problem = TypeVar("_Problem", bound=AbstractProblem)

_Padded = TypeVar("_Padded", JointProblem, RigProblem)

MIN_UNPADDED_OBSERVATIONS = 40_000
"""Smallest number of observations, visible or not, for which a problem is solved without padding.

With more observations, the additional columns cost more than the compilation of a new program.
"""

MAXIMUM_STEPS = 200
"""Largest number of solver steps of a fit."""


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
        chain: the chain of every view at the result (`FittedChain`), or of every camera of a rig.
    """

    z: Step
    costs: tuple[float, ...]
    steps: int
    relative_decrease: float
    converged: bool
    chain: Any


def solve(
    problem: AbstractProblem,
    solver: optx.AbstractLeastSquaresSolver[Any, Any, Any, Any] | None = None,
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
    original = problem
    if solver is None:
        solver = StructuredLM()
    if isinstance(solver, StructuredLM):
        rtol, atol = (np.array(value) for value in (solver.rtol, solver.atol))
        solver = with_fields(solver, rtol=rtol, atol=atol)
        problem = padded(problem)
    else:
        # Padding would make the residuals' Jacobian singular, which not every solver allows.
        problem = _with_jacobi_scale(problem)
    initial = problem.zero_step() if start is None else padded_step(start, problem)
    z, steps, recorded_costs, equations, predicted_decrease, chain = _minimise_and_evaluate(
        problem, solver, maximum_steps, initial
    )
    cost, predicted_decrease = float(equations.cost), float(predicted_decrease)
    relative_decrease = predicted_decrease / max(cost, 1e-300)
    converged = bool(is_converged(predicted_decrease, cost))
    # Unused entries are NaN.
    recorded_costs = np.asarray(recorded_costs)
    costs = (*recorded_costs[np.isfinite(recorded_costs)].tolist(), cost)
    solution = Solution(
        step_without_padding(z, original),
        costs,
        int(steps),
        relative_decrease,
        converged,
        chain_without_padding(chain, original),
    )
    return solution, equations_without_padding(equations, original)


def padded(problem: _Problem) -> _Problem:
    """Pad a small problem with views or states, points and free parameters that have no effect.

    Small problems that differ in size, free parameters or loss, as within one calibration, then
    share a program, which takes far longer to compile than to run.
    """
    if problem.observation_count >= MIN_UNPADDED_OBSERVATIONS or problem.mesh is not None:
        return problem
    size, count = problem.parameter_count, len(problem.free)
    free = np.concatenate([problem.free, np.full(size - count, size)])
    scale = np.concatenate([problem.scale.shared, np.ones(size - count)])
    problem = with_fields(
        problem, free=free, scale=host_step(scale, np.asarray(problem.scale.per_view))
    )
    if isinstance(problem, RigProblem):
        return _with_more_states(problem)
    return _with_more_views(problem) if isinstance(problem, JointProblem) else problem


def _with_more_states(problem: RigProblem) -> RigProblem:
    """Pad a rig, whose views and points were padded when it was built, with unseen states."""
    states = padded_counts(len(problem.per_view_free))[0]
    roots = problem.correction_roots
    return with_fields(
        _with_more_corrections(problem, states),
        command=repeat_last(problem.command, states),
        correction_roots=None if roots is None else _padded_roots(problem, states),
    )


def _with_more_views(problem: JointProblem) -> JointProblem:
    """Pad the problem of one camera with views and points."""
    loss = problem.loss
    if loss is None or isinstance(loss, Cauchy):
        # Least squares is the Cauchy loss of infinite scale.
        loss = with_fields(Cauchy(), scale=np.array(np.inf if loss is None else loss.scale))
    observations = problem.observations.padded()
    views = len(observations.visible)
    return with_fields(
        _with_more_corrections(problem, views),
        parameters=problem.parameters.with_aspect_flag,
        observations=observations,
        prepared_poses=repeat_last(problem.prepared_poses, views),
        correction_roots=_padded_roots(problem, views),
        loss=loss,
    )


def _with_more_corrections(problem: _Padded, count: int) -> _Padded:
    """Pad a problem with corrections of views, or of states, that are held and without priors.

    All corrections of a robot that is trusted are added, so with and without a model of noise the
    program is the same.
    """
    added = count - len(problem.per_view_free)

    def padded_per_view(per_view: Any, value: float = 0.0) -> np.ndarray:
        """Append rows of a value for the added corrections."""
        per_view = np.asarray(per_view)
        return np.concatenate([per_view, np.full((added, 6), value, per_view.dtype)])

    def padded_step_of(step: Step, value: float = 0.0) -> Step:
        """Append them to a prior's mean or weight, or to a scale."""
        return host_step(np.asarray(step.shared), padded_per_view(step.per_view, value))

    return with_fields(
        problem,
        per_view_free=padded_per_view(problem.per_view_free),
        prior_mean=padded_step_of(problem.prior_mean),
        prior_weight=padded_step_of(problem.prior_weight),
        scale=padded_step_of(problem.scale, 1.0),
    )


def _padded_roots(
    problem: JointProblem | RigProblem, count: int
) -> Float[np.ndarray, "corrections 6 6"]:
    """Return each correction's twist by its own parameters, for added corrections too.

    Where these are the twist itself they become the identity, so that fits with and without errors
    along directions share a program.
    """
    roots = np.tile(np.eye(6), (count, 1, 1))
    if problem.correction_roots is not None:
        roots[: len(problem.correction_roots)] = problem.correction_roots
    return roots


def padded_step(step: Step, problem: AbstractProblem) -> Step:
    """Return a step with zeros for the parameters that were added to a padded problem."""
    shared, per_view = np.zeros(len(problem.free)), np.zeros(problem.per_view_free.shape)
    shared[: len(step.shared)], per_view[: len(step.per_view)] = step.shared, step.per_view
    return host_step(shared, per_view)


def step_without_padding(step: Step, original: AbstractProblem) -> Step:
    """Return a step of a padded problem without the padding, on the host."""
    shared, per_view = np.asarray(step.shared), np.asarray(step.per_view)
    return host_step(shared[: len(original.free)], per_view[: len(original.per_view_free)])


def equations_without_padding(
    equations: NormalEquations, original: AbstractProblem
) -> NormalEquations:
    """Return the normal equations of a padded problem without the padding, on the host."""
    free, corrected = len(original.free), len(original.per_view_free)
    matrix = jax.tree.map(np.asarray, equations.matrix)
    return with_fields(
        equations,
        gradient=step_without_padding(equations.gradient, original),
        matrix=with_fields(
            matrix,
            shared=matrix.shared[:free, :free],
            border=matrix.border[:corrected, :, :free],
            per_view=matrix.per_view[:corrected],
        ),
    )


def chain_without_padding(chain: Any, original: AbstractProblem) -> Any:
    """Return the chain of a padded problem without the padding, on the host.

    A rig's chains are unchanged.
    """
    if not isinstance(original, JointProblem):
        return chain
    views = len(original.observations.visible)
    return with_fields(
        chain,
        pose_corrections=host_without_padding(chain.pose_corrections, len(original.per_view_free)),
        field_errors=host_without_padding(chain.field_errors, views),
        camera_from_world=host_without_padding(chain.camera_from_world, views),
    )


@compiled
def _with_jacobi_scale(problem: _Problem) -> _Problem:
    """Return the problem in units for solvers that treat all parameters alike."""
    matrix = jax.lax.stop_gradient(problem).normal_equations(problem.zero_step()).matrix
    return eqx.tree_at(lambda p: p.scale, problem, jacobi_scale(matrix))


def minimise(
    problem: AbstractProblem,
    solver: optx.AbstractLeastSquaresSolver[Any, Any, Any, Any],
    maximum_steps: int,
    start: Step,
) -> tuple[Step, Array, Array, NormalEquations, Array]:
    """Minimise a problem from a step in its units, inside `jit`.

    Returns:
        The step, the number of solver steps, the recorded costs, the normal equations at the
        result, and the decrease of the cost that one more Gauss-Newton step predicts.
    """
    solution = optx.least_squares(
        ordered_residuals, solver, start, args=problem, max_steps=maximum_steps, throw=False
    )
    z = jax.tree.map(jnp.multiply, solution.value, problem.scale)
    if isinstance(solver, StructuredLM):
        model, scale = solution.state.f_info, solution.state.scale
    else:
        model, scale = quadratic_model(problem, solution.value), jax.tree.map(jnp.ones_like, z)
    predicted_decrease = undamped_decrease(model)
    # `unscale` converts the normal equations from scaled units to the parameters' own.
    unscale = jax.tree.map(lambda s, t: 1.0 / (s * t), scale, problem.scale)
    unscaled = rescale(model, unscale)
    equations = NormalEquations(unscaled.f, unscaled.grad, gauss_newton_matrix(unscaled))
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
    problem: AbstractProblem,
    solver: optx.AbstractLeastSquaresSolver[Any, Any, Any, Any],
    maximum_steps: int,
    start: Step,
) -> tuple[Step, Array, Array, NormalEquations, Array, Any]:
    """Minimise from a step in the parameters' own units, and return the chain at the end too."""
    outputs = minimise(
        problem, solver, maximum_steps, jax.tree.map(jnp.divide, start, problem.scale)
    )
    # `minimise` returns a step in the parameters' own units.
    chain = problem.chain(jax.tree.map(jnp.divide, outputs[0], problem.scale))
    if problem.mesh is not None:
        chain = jax.lax.with_sharding_constraint(chain, NamedSharding(problem.mesh, P()))
    return *outputs, chain


@compiled
def optimum(
    problem: AbstractProblem,
    solver: optx.AbstractLeastSquaresSolver[Any, Any, Any, Any] | None = None,
    start: Step | None = None,
    maximum_steps: int = MAXIMUM_STEPS,
) -> Step:
    """Return the step to the optimum, for use inside `jit`, `vmap` and `grad`.

    The optimum is differentiable, by the implicit function theorem, with respect to every array in
    `problem`: pixels, poses, priors, and the start's values.

    Args:
        problem: from `build_problem`, with any of its arrays changed.
        solver: optimistix least-squares solver; by default the engine's own.
        start: step at which to begin; by default zero.
        maximum_steps: number of steps after which the present step is returned.

    For example:

        >>> import equinox as eqx
        >>> import jax
        >>> problem = sv.build_problem(data, truth).problem
        >>> def hand_eye_translation(pixels):
        ...     changed = eqx.tree_at(lambda p: p.observations.pixels, problem, pixels)
        ...     calibration, _ = changed.calibration(sv.optimum(changed))
        ...     return calibration.camera_from_tool.translation()
        >>> jax.jacrev(hand_eye_translation)(data.pixels).shape  # m per px  # doctest: +SKIP
        (3, 8, 14, 2)
    """
    # These units keep the linear solve for the derivatives well conditioned.
    scaled = _with_jacobi_scale(problem)
    jacobi_units = scaled.scale
    initial = (
        problem.zero_step() if start is None else jax.tree.map(jnp.divide, start, jacobi_units)
    )
    result = optx.least_squares(
        ordered_residuals,
        StructuredLM() if solver is None else solver,
        initial,
        args=scaled,
        max_steps=maximum_steps,
        throw=False,
    )
    return jax.tree.map(jnp.multiply, result.value, jacobi_units)
