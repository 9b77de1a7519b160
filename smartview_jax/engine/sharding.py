"""Run one fit on several devices or processes; each device linearises its own views.

Views are independent in the linearisation. In a step, devices exchange only the sum of one small
matrix, so that the result equals that of a single device up to rounding.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Array

from .parameters import Step
from .problem import VIEWS, JointProblem, NormalEquations
from .schur import BlockArrow
from .solver import Solution, solve


def solve_on(
    devices: Sequence[Any],
    problem: JointProblem,
    solver: optx.AbstractLeastSquaresSolver | None = None,
) -> tuple[Solution, NormalEquations]:
    """Minimise a problem with its views distributed over devices; otherwise like `solve`.

    The result is on the default device. With several processes (`jax.distributed.initialize`) every
    process calls this function with the same problem and with all devices (`jax.devices()`), and
    every process gets the whole result.
    """
    corrected = len(problem.own_free)
    solution, equations = solve(deal_out(problem, devices), solver)

    def here(x: Array) -> Array:
        """Copy an array to the default device."""
        return jnp.asarray(np.asarray(x))

    def own(x: Array) -> Array:
        """Copy an array of the views without the padding."""
        return here(x)[:corrected]

    z, gradient, matrix = solution.z, equations.gradient, equations.matrix
    return (
        solution._replace(z=Step(here(z.shared), own(z.corrections))),
        NormalEquations(
            here(equations.cost),
            Step(here(gradient.shared), own(gradient.corrections)),
            BlockArrow(here(matrix.shared), own(matrix.border), own(matrix.own)),
        ),
    )


def deal_out(problem: JointProblem, devices: Sequence[Any]) -> JointProblem:
    """Distribute the views of a problem over several devices.

    The number of views is made divisible by that of the devices with views that show no points.
    """
    # JAX splits an axis only into equal parts, hence the padding.
    mesh = Mesh(np.array(devices), (VIEWS,))
    extra = -len(problem.observations.visible) % len(devices)
    arrays, rest = eqx.partition(problem, eqx.is_array)
    arrays = eqx.tree_at(_per_view, arrays, _stretched(_per_view(arrays), extra))
    specs = jax.tree.map(lambda _: P(), arrays)
    specs = eqx.tree_at(
        _per_view, specs, jax.tree.map(lambda x: P(VIEWS) if len(x) else P(), _per_view(arrays))
    )

    def place(x: Array, spec: P) -> Array:
        """Put an array on the devices."""
        whole = np.asarray(x)
        # Every process holds the whole array, and hands over only the parts of its own devices.
        return jax.make_array_from_callback(
            whole.shape, NamedSharding(mesh, spec), lambda index: whole[index]
        )

    placed = jax.tree.map(place, arrays, specs)
    return dataclasses.replace(eqx.combine(placed, rest), mesh=mesh)


def _per_view(problem: JointProblem) -> tuple[Any, ...]:
    """Return the arrays whose first axis is the views."""
    return (
        problem.observations,
        problem.own_free,
        problem.prior_mean.corrections,
        problem.prior_weight.corrections,
        problem.scale.corrections,
    )


def last_repeated(parts: Any, extra: int) -> Any:
    """Append copies of the last entry to arrays, to fill up the last device.

    Args:
        parts: pytree of arrays.
        extra: number of copies.
    """
    return jax.tree.map(lambda x: jnp.concatenate([x, x[-1:].repeat(extra, axis=0)]), parts)


def _stretched(parts: tuple[Any, ...], extra: int) -> tuple[Any, ...]:
    """Repeat the last view; in the copies no point is visible and no parameter is free."""
    observations, own_free, *rest = last_repeated(parts, extra)
    views = len(observations.visible) - extra
    observations = eqx.tree_at(
        lambda o: o.visible, observations, observations.visible.at[views:].set(False)
    )
    return observations, own_free.at[views:].set(False), *rest
