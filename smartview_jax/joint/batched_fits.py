"""Solve many problems of one shape in one program, in batches, on every device of a mesh.

On a CPU the fits run one after the other in one compiled loop, which is several times faster than
`vmap` over small matrices; other devices run a batch at once, by `vmap`. The program takes a batch
at a time, while the host prepares the next one, so that it serves any number of fits.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Float, Int

from ..calibration import Calibration
from ..dataset import Observations
from ..engine import (
    MAXIMUM_STEPS,
    RANK_TOLERANCE,
    JointProblem,
    NormalEquations,
    Step,
    StructuredLM,
    eliminate,
    is_converged,
    minimise,
    updated_sigma,
    variance_factor,
    variance_of_sum,
    with_pixel_sigma,
)
from ..runtime.array_namespace import AnyArray, AnyScalar
from ..runtime.compilation import compiled_optimised
from ..runtime.padding import power_of_two_from, repeat_last

PerFitInputs = tuple[Calibration, Observations, Any]
"""The parts of a problem that differ between fits: start, observations, free pose corrections."""

FITS_AT_A_TIME = 128
"""The largest batch of fits of the compiled program, on each device, if it runs them in turn."""

FITS_AT_ONCE = 2048
"""The largest batch that a graphics processor runs at once."""

FITS_AXIS = "fits"
"""The name of the mesh axis along which fits are distributed over devices."""


def in_batches(
    inputs: Callable[[int], Any], count: int, size: int, solve: Callable[[Any, np.ndarray], Any]
) -> Any:
    """Return the results of a program for many inputs, computed in batches.

    Args:
        inputs: function from the index of a fit to its inputs.
        count: number of fits.
        size: batch size of the program.
        solve: the program, a function of stacked inputs and of the number of valid ones.

    Returns:
        Stacked results of all fits, as NumPy arrays.
    """

    def stacked(first: int) -> tuple[Any, np.ndarray]:
        batch = [inputs(k) for k in range(first, min(first + size, count))]
        whole = jax.tree.map(lambda *x: np.stack([np.asarray(leaf) for leaf in x]), *batch)
        return repeat_last(whole, size), np.array(len(batch))

    results = []
    # The host prepares the next batch while the device works.
    with ThreadPoolExecutor(1) as executor:
        pending = executor.submit(stacked, 0)
        for first in range(size, count + size, size):
            arguments = pending.result()
            if first < count:
                pending = executor.submit(stacked, first)
            results.append(jax.tree.map(np.asarray, solve(*arguments)))
    return jax.tree.map(lambda *x: np.concatenate(x)[:count], *results)


def batch_size(count: int, devices: int) -> int:
    """Return the batch size of the program, rounded up so that many counts share a program."""
    on_each = power_of_two_from(-(-count // devices))
    return devices * min(on_each, FITS_AT_A_TIME if runs_in_turn() else FITS_AT_ONCE)


def runs_in_turn() -> bool:
    """Return whether this process's devices run fits one after the other, not a batch at once."""
    return jax.default_backend() == "cpu"


def per_fit_inputs(problem: JointProblem) -> PerFitInputs:
    """Return the parts of a problem that differ from one fit to the next."""
    return problem.parameters.start, problem.seen_points, problem.per_view_free


@compiled_optimised
def solve_all(
    problems: JointProblem,
    count: Int[AnyArray, ""],
    sigma_known: bool,
    sigma_iterations: int,
    mesh: Mesh | None,
    in_turn: bool,
) -> tuple:
    """Solve the first `count` fits, distributed over the devices of a mesh.

    Each device solves its fits in turn, or all at once.
    """
    inputs = per_fit_inputs(problems)

    def solve_inputs(fit_inputs: PerFitInputs) -> tuple:
        return _solve_one(
            eqx.tree_at(per_fit_inputs, problems, fit_inputs), sigma_known, sigma_iterations
        )

    def solve_batch(batch: PerFitInputs, count_here: Int[AnyArray, ""]) -> tuple:
        if in_turn:
            return _one_after_the_other(solve_inputs, batch, count_here)
        return jax.vmap(solve_inputs)(batch)

    if mesh is None:
        return solve_batch(inputs, count)

    def solve_on_device(batch: PerFitInputs) -> tuple:
        size = len(batch[1].visible)
        count_here = jnp.clip(count - size * jax.lax.axis_index(FITS_AXIS), 0, size)
        return solve_batch(batch, count_here)

    solve_sharded = jax.shard_map(
        solve_on_device,
        mesh=mesh,
        in_specs=P(FITS_AXIS),
        out_specs=P(FITS_AXIS),
        check_vma=False,
    )
    return solve_sharded(inputs)


def _one_after_the_other(
    solve: Callable[[PerFitInputs], tuple], inputs: PerFitInputs, count: Int[AnyArray, ""]
) -> tuple:
    """Solve the first `count` fits; the results of the others are zero."""

    # On a CPU `vmap` was several times slower, and `lax.map` would solve all.
    def with_result(k: Int[Array, ""], results: tuple) -> tuple:
        result = solve(jax.tree.map(lambda x: x[k], inputs))
        return jax.tree.map(lambda stacked, leaf: stacked.at[k].set(leaf), results, result)

    shapes = jax.eval_shape(solve, jax.tree.map(lambda x: x[0], inputs))
    size = len(inputs[1].visible)
    zeros = jax.tree.map(lambda x: jnp.zeros((size, *x.shape), x.dtype), shapes)
    return jax.lax.fori_loop(0, count, with_result, zeros)


def _solve_one(problem: JointProblem, sigma_known: bool, sigma_iterations: int) -> tuple:
    """Solve one fit, re-estimating the pixel sigma in between.

    Returns:
        Calibration, corrections, covariance, cost, steps, whether it converged, and which views
        have points but none that can be projected.
    """
    # The prepared poses belong to the fit for which the problem was built.
    problem = problem.with_observations(problem.observations)
    visible = problem.observations.visible
    # All views at once, because a loop over views is slower for small fits.
    start, observations = problem.parameters.start, problem.seen_points
    _, valid = start.project(observations.command, observations.points)
    problem = eqx.tree_at(lambda p: p.observations.visible, problem, visible & valid)
    unprojectable = jnp.any(visible, axis=1) & ~jnp.any(visible & valid, axis=1)

    def refine_sigma(state: tuple[Array, Step], _: None) -> tuple[tuple[Array, Step], None]:
        reweighted = with_pixel_sigma(problem, state[0])
        # Each fit starts at the solution of the fit before.
        outputs = minimise(reweighted, StructuredLM(), MAXIMUM_STEPS, state[1])
        z, equations = outputs[0], outputs[3]
        factor = _variance_factor(reweighted, z, equations)
        return (jnp.asarray(updated_sigma(reweighted.pixel_sigma, factor)), z), None

    sigma, initial_step = problem.pixel_sigma, problem.zero_step()
    # A scan of length zero would still be compiled, with the whole solver in it.
    if sigma_iterations:
        (sigma, initial_step), _ = jax.lax.scan(
            refine_sigma, (sigma, initial_step), length=sigma_iterations
        )
    problem = with_pixel_sigma(problem, sigma)
    z, steps, _, equations, predicted_decrease = minimise(
        problem, StructuredLM(), MAXIMUM_STEPS, initial_step
    )
    calibration, corrections = problem.calibration(z)
    # Covariance f R^-1, with the reduced matrix R = A - sum_v B_v^T C_v^-1 B_v of the arrow-shaped
    # normal equations [[A, B^T], [B, C]]: pose corrections eliminated view by view.
    factor = 1.0 if sigma_known else _variance_factor(problem, z, equations)
    covariance = factor * _inverse(eliminate(equations.matrix).schur_complement)
    return (
        calibration,
        corrections,
        problem.covariance_by_names(z, covariance),
        equations.cost,
        steps,
        is_converged(predicted_decrease, equations.cost),
        unprojectable,
    )


def _variance_factor(problem: JointProblem, z: Step, equations: NormalEquations) -> AnyScalar:
    """Return the `variance_factor` of a fit from its normal equations."""
    if problem.loss is not None:
        return variance_factor(problem, problem.squared_residuals(z))
    # Twice the cost is the sum of squared residuals, priors included.
    return variance_of_sum(problem, 2.0 * (equations.cost - problem.prior_cost(z)))


def _inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the inverse of a positive definite matrix; infinite if it is close to singular."""
    # Scale to a unit diagonal first: px, m and rad differ by orders of magnitude.
    column_norms = jnp.sqrt(jnp.maximum(jnp.diagonal(matrix), 0.0))
    inverse_norms = 1.0 / jnp.where(column_norms > 0.0, column_norms, 1.0)
    inverse = cho_solve(
        cho_factor(matrix * inverse_norms[:, None] * inverse_norms[None]), jnp.eye(len(matrix))
    )
    # The largest eigenvalue of the inverse lies between trace / n and trace, so the trace bounds
    # the smallest singular value of the Jacobian without an eigendecomposition.
    well_conditioned = jnp.trace(inverse) < RANK_TOLERANCE**-2
    return jnp.where(
        well_conditioned, inverse * inverse_norms[:, None] * inverse_norms[None], jnp.inf
    )
