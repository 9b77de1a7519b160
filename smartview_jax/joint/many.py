"""Many calibrations of the same shape at once: simulations, bootstraps, a fleet of robots.

They run one after the other in one compiled loop, which on a CPU is several times faster than
`vmap` over small matrices, and on as many devices side by side as there are.
"""

from collections.abc import Mapping, Sequence
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
from ..compilation import optimised
from ..dataset import Dataset, Observations
from ..robots import AbstractField
from .build import build_problem, with_field, with_lens
from .covariance import NULL, variance_factor
from .losses import AbstractLoss
from .noise import Noise
from .priors import Prior
from .problem import JointProblem, valid_at_start
from .schur import eliminate
from .sharding import last_repeated
from .solver import MAXIMUM_STEPS, StructuredLM, next_to_nothing, run

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
        return jax.tree.map(lambda x: x[index], self.calibrations)


def fit_many(
    data: Sequence[Dataset],
    start: Calibration | Sequence[Calibration],
    lens: str | AbstractLens | None = None,
    noise: str | Noise = "trusted",
    loss: str | AbstractLoss | None = None,
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    field: AbstractField | None = None,
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
    starts = [with_field(with_lens(one, lens), field) for one in starts]
    if noise == "estimated":
        raise ValueError("fit_many takes the noise as given; fit_joint estimates it")
    built = build_problem(data[0], starts[0], None, noise, loss, fixed, free, priors, field)
    problems = eqx.tree_at(
        _own_parts, built.problem, (_stacked(starts), _stacked([d.observations for d in data]))
    )
    mesh = None if devices is None else Mesh(np.array(devices), (FITS,))
    answers = jax.tree.map(lambda x: x[: len(data)], _solve_all(problems, built.sigma_known, mesh))
    calibrations, corrections, covariance, cost, steps, converged = answers
    return ManyFits(calibrations, corrections, covariance, cost, steps, converged, built.names)


def _own_parts(problem: JointProblem) -> tuple[Calibration, Observations]:
    """What differs from one fit to the next."""
    return problem.parameters.start, problem.observations


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
def _solve_all(problems: JointProblem, sigma_known: bool, mesh: Mesh | None) -> tuple:
    """Every fit's answer; the fits are spread over a mesh's devices, evened out by copies."""
    parts = _own_parts(problems)

    def one(part: tuple[Calibration, Observations]) -> tuple:
        return _solve_one(eqx.tree_at(_own_parts, problems, part), sigma_known)

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


def _solve_one(problem: JointProblem, sigma_known: bool) -> tuple:
    """Calibration, corrections, covariance, cost, steps, and whether it converged."""
    visible = problem.observations.visible & valid_at_start(problem)
    problem = eqx.tree_at(lambda p: p.observations.visible, problem, visible)
    z, steps, _, equations, gain = run(problem, StructuredLM(), MAXIMUM_STEPS, problem.start())
    calibration, corrections = problem.calibration(z)
    factor = 1.0 if sigma_known else variance_factor(problem, problem.squares(z))
    return (
        calibration,
        corrections,
        factor * _inverse(eliminate(equations.matrix).reduced),
        equations.cost,
        steps,
        next_to_nothing(gain, equations.cost),
    )


def _inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Of a positive definite matrix; infinite where a direction is not determined."""
    lengths = jnp.sqrt(jnp.maximum(jnp.diagonal(matrix), 0.0))
    unit = 1.0 / jnp.where(lengths > 0.0, lengths, 1.0)
    inverse = cho_solve(cho_factor(matrix * unit[:, None] * unit[None]), jnp.eye(len(matrix)))
    # The largest eigenvalue of the inverse is its trace, but for a factor of n.
    seen = jnp.trace(inverse) < NULL**-2
    return jnp.where(seen, inverse * unit[:, None] * unit[None], jnp.inf)
