"""Fit many data sets of the same shape at once: simulations, bootstraps, a fleet of robots.

The fits run one after the other in one compiled loop, which on a CPU is several times faster than
`vmap` over small matrices, and in parallel on several devices. The program takes a batch at a time,
while the host prepares the next one, so that it serves any number of fits.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Bool, Float, Int

from ..calibration import Calibration
from ..cameras import AbstractLens
from ..dataset import Dataset, Observations, repetition_warnings, stale_poses
from ..engine import (
    MAXIMUM_STEPS,
    RANK_TOLERANCE,
    AbstractLoss,
    BuiltProblem,
    JointProblem,
    Noise,
    NormalEquations,
    Prior,
    Step,
    StructuredLM,
    build_problem,
    eliminate,
    is_converged,
    minimise,
    unprojectable_views_message,
    updated_sigma,
    variance_factor,
    variance_of_sum,
    with_field,
    with_lens,
    with_pixel_sigma,
)
from ..fit_result import Rejection
from ..robot_errors import FieldChoice, checked_field_choice
from ..runtime.array_namespace import AnyArray, AnyScalar, to_device
from ..runtime.compilation import compiled_optimised
from ..runtime.padding import power_of_two_from, repeat_last
from .gross_errors import without_views
from .undetermined import require_moving_robot, undetermined_motion

PerFitInputs = tuple[Calibration, Observations, Any]
"""The parts of a problem that differ between fits: start, observations, free pose corrections."""

SIGMA_ITERATIONS = 6
"""The number of refits with the pixel sigma re-estimated from the residuals.

The last refits change it very little; the number is fixed so that all fits share a compiled loop.
"""

FITS_AT_A_TIME = 128
"""The largest batch of fits of the compiled program, on each device."""

FITS_AXIS = "fits"
"""The name of the mesh axis along which fits are distributed over devices."""


class ManyFits(eqx.Module):
    """The results of many fits: every array has one entry per fit along its first axis.

    Attributes:
        calibrations: one `Calibration` whose arrays are stacked; `fits[k]` is the k-th.
        pose_corrections: as in `JointFit`.
        covariance: covariance of the free common parameters, in the order of `parameter_names`;
            infinite if the data do not determine all of them.
        cost: half the sum of squared residuals in pixel sigmas, at the end.
        steps: number of solver steps.
        converged: whether a further step would lower the cost by a negligible amount.
        parameter_names: names of the free parameters that all views have in common.
        warnings: the views that were left out, with their data set, a sentence each.
    """

    calibrations: Calibration
    pose_corrections: Float[Array, "fits corrected 6"]
    covariance: Float[Array, "fits free free"]
    cost: Float[Array, "fits"]
    steps: Int[Array, "fits"]
    converged: Bool[Array, "fits"]
    parameter_names: tuple[str, ...] = eqx.field(static=True)
    warnings: tuple[str, ...] = eqx.field(static=True, default=())

    def __len__(self) -> int:
        """Return the number of fits."""
        return len(self.cost)

    def __getitem__(self, index: int) -> Calibration:
        """Return one fit's calibration; raise an `IndexError` out of range."""
        # JAX arrays clamp an index out of range instead of raising; `range` raises.
        checked_index = range(len(self))[index]
        return jax.tree.map(lambda x: to_device(np.asarray(x)[checked_index]), self.calibrations)


def fit_many(
    data: Sequence[Dataset],
    start: Calibration | Sequence[Calibration],
    *,
    lens: str | AbstractLens | None = None,
    noise: str | Noise = "trusted",
    loss: str | AbstractLoss | None = None,
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    field: FieldChoice = "auto",
    devices: Sequence[Any] | None = None,
) -> ManyFits:
    """Fit many data sets, each as `fit_joint` does.

    Args:
        data: data sets with the same numbers of views and points, padded with invisible ones.
        start: one start for all, or one for each, with the same lens and mount.
        lens, noise, loss, fixed, free, priors, field: as in `fit_joint`, the same for all.
        devices: devices over which the fits are distributed, such as `jax.devices()`; by default
            they run on one.

    Raises:
        ValueError: as for `fit_joint`, also for robots that did not move or rotate, and if shapes,
            lenses, mounts or the directions that the motions leave undetermined differ.
    """
    starts = [start] * len(data) if isinstance(start, Calibration) else list(start)
    _require_same_structure(data, starts)
    if noise == "estimated":
        raise ValueError("fit_many takes the noise as given; fit_joint estimates it")
    field = checked_field_choice(field)
    starts = [with_field(with_lens(one, lens), field) for one in starts]
    data, held, warnings = _with_checked_poses(data, starts, fixed, priors)
    # The free pose corrections depend only on which views are usable, so problems with the same
    # usable views are built once.
    # Called as a function, because Equinox copies a module for each call of a method.
    usable = [tuple(Dataset.usable_views(item).tolist()) for item in data]
    built_by_views: dict[tuple[int, ...], BuiltProblem] = {}
    for k, views in enumerate(usable):
        if views not in built_by_views:
            try:
                built_by_views[views] = build_problem(
                    data[k],
                    starts[k],
                    noise=noise,
                    loss=loss,
                    fixed=(*fixed, *held),
                    free=free,
                    priors=priors,
                    field=field,
                )
            except ValueError as error:
                raise ValueError(f"data[{k}]: {error}") from error
    built = built_by_views[usable[0]]
    mesh = None if devices is None else Mesh(np.array(devices), (FITS_AXIS,))
    sigma_iterations = SIGMA_ITERATIONS if built.depends_on_sigma and not built.sigma_known else 0

    def inputs(k: int) -> PerFitInputs:
        return starts[k], data[k].observations, built_by_views[usable[k]].problem.per_view_free

    *results, unprojectable = _in_batches(
        inputs,
        len(data),
        _batch_size(len(data), 1 if mesh is None else mesh.size),
        lambda stacked, count: _solve_all(
            eqx.tree_at(_per_fit_inputs, built.problem, stacked),
            count,
            built.sigma_known,
            sigma_iterations,
            mesh,
        ),
    )
    for k, view in np.argwhere(unprojectable):
        raise ValueError(f"data[{k}]: {unprojectable_views_message([data[k].view_ids[view]])}")
    calibrations, corrections, covariance, cost, steps, converged = jax.tree.map(to_device, results)
    return ManyFits(
        calibrations,
        corrections,
        covariance,
        cost,
        steps,
        converged,
        built.shared_names,
        warnings,
    )


def _per_fit_inputs(problem: JointProblem) -> PerFitInputs:
    """Return the parts of a problem that differ from one fit to the next."""
    return problem.parameters.start, problem.seen_points, problem.per_view_free


def _require_same_structure(data: Sequence[Dataset], starts: Sequence[Calibration]) -> None:
    """Raise a `ValueError` unless data sets and starts agree in shape, mount and structure."""
    if not data:
        raise ValueError("fit_many: expected at least one data set, found none")
    if len(starts) != len(data):
        raise ValueError(f"start: expected one, or {len(data)}, found {len(starts)}")
    shape, mount = data[0].visible.shape, data[0].mount
    for k, item in enumerate(data):
        if item.visible.shape != shape:
            raise ValueError(
                f"data[{k}]: expected {shape[0]} views of {shape[1]} points as in data[0], found "
                f"{item.visible.shape}; pad with points that are not visible"
            )
        if item.mount != mount:
            raise ValueError(f"data[{k}]: expected {mount} as data[0], found {item.mount}")
    structure = jax.tree.structure(starts[0])
    for k, item in enumerate(starts):
        if jax.tree.structure(item) != structure:
            raise ValueError(f"start[{k}]: lens, picture size or mount differs from start[0]")


def _with_checked_poses(
    data: Sequence[Dataset],
    starts: Sequence[Calibration],
    fixed: Sequence[str],
    priors: Mapping[str, Prior] | None,
) -> tuple[list[Dataset], tuple[str, ...], tuple[str, ...]]:
    """Return the data without poses that were not read again, the parameters to hold, and warnings.

    To be held are the parameters that no motion of the robots determines, as in `fit_joint`. The
    warnings name the views that are left out.

    Raises:
        ValueError: a robot that did not move or rotate, or robots whose motions leave different
            parameters undetermined: one program solves for the same parameters.
    """
    checked: list[Dataset] = []
    held: tuple[str, ...] = ()
    warnings: list[str] = []
    for k, (item, start) in enumerate(zip(data, starts, strict=True)):
        try:
            require_moving_robot(item, start, fixed, priors)
        except ValueError as error:
            raise ValueError(f"data[{k}]: {error}") from error
        stale = stale_poses(item)
        used = without_views(item, stale)
        rejections = [Rejection(item.view_ids[view], None, text) for view, text in stale.items()]
        warnings += [f"data[{k}]: {text}" for text in repetition_warnings(rejections)]
        undetermined = undetermined_motion(used, start, fixed, priors).held
        if k > 0 and undetermined != held:
            described = [", ".join(names) or "nothing" for names in (held, undetermined)]
            raise ValueError(
                f"data[{k}]: its motion leaves {described[1]} undetermined, but data[0]'s leaves "
                f"{described[0]}; fit them separately, or hold these parameters by fixed="
            )
        held = undetermined
        checked.append(used)
    return checked, held, tuple(warnings)


def _batch_size(count: int, devices: int) -> int:
    """Return the batch size of the program, rounded up so that many counts share a program."""
    on_each = power_of_two_from(-(-count // devices))
    return devices * min(on_each, FITS_AT_A_TIME)


def _in_batches(
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


@compiled_optimised
def _solve_all(
    problems: JointProblem,
    count: Int[AnyArray, ""],
    sigma_known: bool,
    sigma_iterations: int,
    mesh: Mesh | None,
) -> tuple:
    """Solve the first `count` fits, distributed over the devices of a mesh."""
    inputs = _per_fit_inputs(problems)

    def solve_inputs(fit_inputs: PerFitInputs) -> tuple:
        return _solve_one(
            eqx.tree_at(_per_fit_inputs, problems, fit_inputs), sigma_known, sigma_iterations
        )

    if mesh is None:
        return _one_after_the_other(solve_inputs, inputs, count)

    def solve_on_device(batch: PerFitInputs) -> tuple:
        size = len(batch[1].visible)
        count_here = jnp.clip(count - size * jax.lax.axis_index(FITS_AXIS), 0, size)
        return _one_after_the_other(solve_inputs, batch, count_here)

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

    # `vmap` over small matrices was several times slower, and `lax.map` would solve all.
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
    return (
        calibration,
        corrections,
        factor * _inverse(eliminate(equations.matrix).schur_complement),
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
