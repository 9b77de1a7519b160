"""Fit many data sets of the same shape at once: simulations, bootstraps, a fleet of robots.

The fits run one after the other in one compiled loop, which on a CPU is several times faster than
`vmap` over small matrices, and in parallel on as many devices as there are.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

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
from ..compilation import optimised
from ..dataset import Dataset, Observations
from ..engine import (
    MAXIMUM_STEPS,
    NULL,
    AbstractLoss,
    JointProblem,
    Noise,
    Prior,
    Step,
    StructuredLM,
    build_problem,
    eliminate,
    last_repeated,
    next_to_nothing,
    nowhere,
    run,
    valid_at_start,
    variance_factor,
    with_field,
    with_lens,
)
from ..robot_errors import AbstractField
from ..variance import FINEST

OwnParts = tuple[Calibration, Observations, Any]
"""The parts of a problem that differ between fits: start, observations, free pose corrections."""

SIGMA_ROUNDS = 6
"""The number of refits with the pixel sigma re-estimated from the residuals.

The last ones change it very little; the number is fixed so that one compiled loop serves all fits.
"""

FITS = "fits"
"""The name of the mesh axis along which fits are distributed over devices."""


class ManyFits(eqx.Module):
    """The results of many fits: every array has one entry per fit along its first axis.

    Attributes:
        calibrations: one `Calibration` whose arrays are stacked; `fits[k]` is the k-th.
        pose_corrections: as in `JointFit`.
        covariance: covariance of the free common parameters, in the order of `parameter_names`;
            infinite where the data do not determine them all.
        cost: half the sum of squared residuals in pixel sigmas, at the end.
        steps: number of solver steps.
        converged: whether a further step would lower the cost by a negligible amount.
        parameter_names: names of the free parameters that all views have in common.
    """

    calibrations: Calibration
    pose_corrections: Float[Array, "fits corrected 6"]
    covariance: Float[Array, "fits free free"]
    cost: Float[Array, "fits"]
    steps: Int[Array, "fits"]
    converged: Bool[Array, "fits"]
    parameter_names: tuple[str, ...] = eqx.field(static=True)

    def __len__(self) -> int:
        """Return the number of fits."""
        return len(self.cost)

    def __getitem__(self, index: int) -> Calibration:
        """Return one fit's calibration; raise an `IndexError` out of range."""
        # JAX arrays clamp an index out of range instead of raising; `range` raises.
        place = range(len(self))[index]
        return jax.tree.map(lambda x: x[place], self.calibrations)


def fit_many(
    data: Sequence[Dataset],
    start: Calibration | Sequence[Calibration],
    lens: str | AbstractLens | None = None,
    noise: str | Noise = "trusted",
    loss: str | AbstractLoss | None = None,
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    field: AbstractField | Literal[False] | None = None,
    devices: Sequence[Any] | None = None,
) -> ManyFits:
    """Fit many data sets, each as `fit_joint` does.

    Args:
        data: data sets with the same numbers of views and points; what is not visible does not
            count.
        start: one for all, or one each, with the same lens and mount.
        lens, noise, loss, fixed, free, priors, field: as in `fit_joint`, the same for all.
        devices: devices over which the fits are distributed, such as `jax.devices()`; by default
            they run on one.

    Raises:
        ValueError: as `fit_joint` does, and where shapes, lenses or mounts differ.
    """
    starts = [start] * len(data) if isinstance(start, Calibration) else list(start)
    _require_alike(data, starts)
    if noise == "estimated":
        raise ValueError("fit_many takes the noise as given; fit_joint estimates it")
    if field is False:
        starts, field = [one.uncorrected for one in starts], None
    starts = [with_field(with_lens(one, lens), field) for one in starts]
    # The free pose corrections depend only on which views are usable, so problems with the same
    # usable views are built once.
    usable, alike = [tuple(map(int, one.usable_views())) for one in data], {}
    for k, views in enumerate(usable):
        if views not in alike:
            try:
                alike[views] = build_problem(
                    data[k], starts[k], None, noise, loss, fixed, free, priors, field
                )
            except ValueError as error:
                raise ValueError(f"data[{k}]: {error}") from error
    built = alike[usable[0]]
    own = [
        (begin, one.observations, alike[views].problem.own_free)
        for begin, one, views in zip(starts, data, usable, strict=True)
    ]
    problems = eqx.tree_at(_own_parts, built.problem, _stacked(own))
    mesh = None if devices is None else Mesh(np.array(devices), (FITS,))
    rounds = SIGMA_ROUNDS if built.sigma_matters and not built.sigma_known else 0
    solved = _solve_all(problems, built.sigma_known, rounds, mesh)
    *answers, blind = jax.tree.map(lambda x: x[: len(data)], solved)
    for k, view in np.argwhere(blind):
        raise ValueError(f"data[{k}]: {nowhere([data[k].view_ids[view]])}")
    calibrations, corrections, covariance, cost, steps, converged = answers
    return ManyFits(calibrations, corrections, covariance, cost, steps, converged, built.names)


def _own_parts(problem: JointProblem) -> OwnParts:
    """Return the parts of a problem that differ from one fit to the next."""
    return problem.parameters.start, problem.observations, problem.own_free


def _require_alike(data: Sequence[Dataset], starts: Sequence[Calibration]) -> None:
    """Raise a `ValueError` unless data sets and starts agree in shape, mount and structure."""
    if not data:
        raise ValueError("fit_many: expected at least one data set, found none")
    if len(starts) != len(data):
        raise ValueError(f"start: expected one, or {len(data)}, found {len(starts)}")
    shape, mount = data[0].visible.shape, data[0].mount
    for k, one in enumerate(data):
        if one.visible.shape != shape:
            raise ValueError(
                f"data[{k}]: expected {shape[0]} views of {shape[1]} points as in data[0], found "
                f"{one.visible.shape}; pad with points that are not visible"
            )
        if one.mount != mount:
            raise ValueError(f"data[{k}]: expected {mount} as data[0], found {one.mount}")
    structure = jax.tree.structure(starts[0])
    for k, one in enumerate(starts):
        if jax.tree.structure(one) != structure:
            raise ValueError(f"start[{k}]: its lens, picture size or mount is not start[0]'s")


def _stacked(parts: Sequence[Any]) -> Any:
    """Return pytrees of equal structure as one, arrays stacked along a new first axis."""
    return jax.tree.map(lambda *x: np.stack([np.asarray(one) for one in x]), *parts)


@optimised
def _solve_all(problems: JointProblem, sigma_known: bool, rounds: int, mesh: Mesh | None) -> tuple:
    """Return every fit's answer, with the fits distributed over the devices of a mesh."""
    parts = _own_parts(problems)

    def one(part: OwnParts) -> tuple:
        return _solve_one(eqx.tree_at(_own_parts, problems, part), sigma_known, rounds)

    if mesh is None:
        # One after the other on each device: `vmap` over small matrices was several times slower.
        return jax.lax.map(one, parts)
    # Copies of the last fit make the fits divide evenly over the devices.
    extra = -len(parts[1].visible) % mesh.size
    spread = jax.shard_map(
        lambda some: jax.lax.map(one, some),
        mesh=mesh,
        in_specs=P(FITS),
        out_specs=P(FITS),
        check_vma=False,
    )
    return spread(last_repeated(parts, extra))


def _solve_one(problem: JointProblem, sigma_known: bool, rounds: int) -> tuple:
    """Solve one fit, re-estimating the pixel sigma in between.

    Returns:
        Calibration, corrections, covariance, cost, steps, whether it converged, and which views
        have points of which none can be projected.
    """
    valid, seen = valid_at_start(problem), problem.observations.visible
    problem = eqx.tree_at(lambda p: p.observations.visible, problem, seen & valid)
    blind = jnp.any(seen, axis=1) & ~jnp.any(seen & valid, axis=1)

    def weighed(sigma: Array) -> JointProblem:
        return eqx.tree_at(lambda p: p.pixel_sigma, problem, sigma)

    def closer(at: tuple[Array, Step], _: None) -> tuple[tuple[Array, Step], None]:
        there = weighed(at[0])
        z = run(there, StructuredLM(), MAXIMUM_STEPS, at[1])[0]
        # sigma <- sigma sqrt(f), f the residual variance over the assumed one, starting the next
        # fit at the last solution.
        told = at[0] * jnp.sqrt(variance_factor(there, there.squares(z)))
        return (jnp.maximum(told, FINEST), z), None

    sigma, ahead = problem.pixel_sigma, problem.start()
    # A scan of length zero would still be compiled, with the whole solver in it.
    if rounds:
        (sigma, ahead), _ = jax.lax.scan(closer, (sigma, ahead), length=rounds)
    problem = weighed(sigma)
    z, steps, _, equations, gain = run(problem, StructuredLM(), MAXIMUM_STEPS, ahead)
    calibration, corrections = problem.calibration(z)
    # Covariance f R^-1, with the reduced matrix R = A - sum_v B_v^T C_v^-1 B_v of the arrow-shaped
    # normal equations [[A, B^T], [B, C]]: pose corrections eliminated view by view.
    factor = 1.0 if sigma_known else variance_factor(problem, problem.squares(z))
    return (
        calibration,
        corrections,
        factor * _inverse(eliminate(equations.matrix).reduced),
        equations.cost,
        steps,
        next_to_nothing(gain, equations.cost),
        blind,
    )


def _inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the inverse of a positive definite matrix; infinite where it is close to singular."""
    # Scale to a unit diagonal first: px, m and rad differ by orders of magnitude.
    lengths = jnp.sqrt(jnp.maximum(jnp.diagonal(matrix), 0.0))
    unit = 1.0 / jnp.where(lengths > 0.0, lengths, 1.0)
    inverse = cho_solve(cho_factor(matrix * unit[:, None] * unit[None]), jnp.eye(len(matrix)))
    # The largest eigenvalue of the inverse lies between trace / n and trace, so the trace bounds
    # the smallest singular value of the Jacobian without an eigendecomposition.
    seen = jnp.trace(inverse) < NULL**-2
    return jnp.where(seen, inverse * unit[:, None] * unit[None], jnp.inf)
