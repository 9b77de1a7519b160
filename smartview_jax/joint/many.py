"""Many calibrations of the same shape at once: simulations, bootstraps, a fleet of robots.

They run one after the other in one compiled loop, which on a CPU is several times faster than
`vmap` over small matrices, and on as many devices side by side as there are.
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
"""Where a fit starts, what was seen, and which of each view's own six may move."""

SIGMA_ROUNDS = 6
"""Of fitting anew with the sigma that the residuals tell; the last ones change next to nothing."""

FITS = "fits"
"""Name of the mesh axis along which fits are dealt out to devices."""


class ManyFits(eqx.Module):
    """Fits side by side: every array has one entry a fit, first.

    Attributes:
        calibrations: one `Calibration` whose arrays are stacked; `fits[k]` is one of them.
        pose_corrections: as in `JointFit`.
        covariance: of the free shared parameters, in the order of `parameter_names`; infinite
            where the data do not determine them all.
        cost: half the sum of squared residuals in pixel sigmas, at the end.
        steps: solver steps.
        converged: whether one more step would gain next to nothing.
        parameter_names: of the free parameters that all views share.
    """

    calibrations: Calibration
    pose_corrections: Float[Array, "fits corrected 6"]
    covariance: Float[Array, "fits free free"]
    cost: Float[Array, "fits"]
    steps: Int[Array, "fits"]
    converged: Bool[Array, "fits"]
    parameter_names: tuple[str, ...] = eqx.field(static=True)

    def __len__(self) -> int:
        return len(self.cost)

    def __getitem__(self, index: int) -> Calibration:
        # Arrays of JAX take any index for the nearest there is.
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
    """Fit many data sets, as `fit_joint` fits one.

    Args:
        data: all with the same numbers of views and points; what is not visible does not count.
        start: one for all, or one each, with the same lens and mount.
        lens, noise, loss, fixed, free, priors, field: as in `fit_joint`, for all alike.
        devices: to deal the fits out to, such as `jax.devices()`; by default they run on one.

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
    # Which poses may move hangs on which views can be placed, and on nothing else.
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
    """What differs from one fit to the next."""
    return problem.parameters.start, problem.observations, problem.own_free


def _require_alike(data: Sequence[Dataset], starts: Sequence[Calibration]) -> None:
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
    return jax.tree.map(lambda *x: np.stack([np.asarray(one) for one in x]), *parts)


@optimised
def _solve_all(problems: JointProblem, sigma_known: bool, rounds: int, mesh: Mesh | None) -> tuple:
    """Every fit's answer; the fits are spread over a mesh's devices, evened out by copies."""
    parts = _own_parts(problems)

    def one(part: OwnParts) -> tuple:
        return _solve_one(eqx.tree_at(_own_parts, problems, part), sigma_known, rounds)

    if mesh is None:
        return jax.lax.map(one, parts)
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
    """Calibration, corrections, covariance, cost, steps, whether it converged; views lost."""
    valid, seen = valid_at_start(problem), problem.observations.visible
    problem = eqx.tree_at(lambda p: p.observations.visible, problem, seen & valid)
    blind = jnp.any(seen, axis=1) & ~jnp.any(seen & valid, axis=1)

    def weighed(sigma: Array) -> JointProblem:
        return eqx.tree_at(lambda p: p.pixel_sigma, problem, sigma)

    def closer(at: tuple[Array, Step], _: None) -> tuple[tuple[Array, Step], None]:
        there = weighed(at[0])
        z = run(there, StructuredLM(), MAXIMUM_STEPS, at[1])[0]
        told = at[0] * jnp.sqrt(variance_factor(there, there.squares(z)))
        return (jnp.maximum(told, FINEST), z), None

    sigma, ahead = problem.pixel_sigma, problem.start()
    # A loop of no rounds would be compiled all the same, with the whole solver in it.
    if rounds:
        (sigma, ahead), _ = jax.lax.scan(closer, (sigma, ahead), length=rounds)
    problem = weighed(sigma)
    z, steps, _, equations, gain = run(problem, StructuredLM(), MAXIMUM_STEPS, ahead)
    calibration, corrections = problem.calibration(z)
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
    """Of a positive definite matrix; infinite where a direction is not determined."""
    lengths = jnp.sqrt(jnp.maximum(jnp.diagonal(matrix), 0.0))
    unit = 1.0 / jnp.where(lengths > 0.0, lengths, 1.0)
    inverse = cho_solve(cho_factor(matrix * unit[:, None] * unit[None]), jnp.eye(len(matrix)))
    # The largest eigenvalue of the inverse is its trace, but for a factor of n.
    seen = jnp.trace(inverse) < NULL**-2
    return jnp.where(seen, inverse * unit[:, None] * unit[None], jnp.inf)
