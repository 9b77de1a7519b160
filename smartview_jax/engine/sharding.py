"""One fit on several devices, or several processes: every device linearises its own views.

A view's observations meet no other view's; what crosses between devices in a step is one sum of a
small matrix, so the answer is a single device's to rounding.
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
    """What `solve` does, with the views dealt out to devices; the answer is on the default one.

    With several processes (`jax.distributed.initialize`) every one of them calls this with the same
    problem and with all devices (`jax.devices()`), and every one gets the whole answer.
    """
    corrected = len(problem.own_free)
    solution, equations = solve(deal_out(problem, devices), solver)

    def here(x: Array) -> Array:
        return jnp.asarray(np.asarray(x))

    def own(x: Array) -> Array:
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
    """The same problem with its views on several devices, evened out by views that show nothing."""
    mesh = Mesh(np.array(devices), (VIEWS,))
    extra = -len(problem.observations.visible) % len(devices)
    arrays, rest = eqx.partition(problem, eqx.is_array)
    arrays = eqx.tree_at(_per_view, arrays, _stretched(_per_view(arrays), extra))
    specs = jax.tree.map(lambda _: P(), arrays)
    specs = eqx.tree_at(
        _per_view, specs, jax.tree.map(lambda x: P(VIEWS) if len(x) else P(), _per_view(arrays))
    )

    def place(x: Array, spec: P) -> Array:
        whole = np.asarray(x)
        return jax.make_array_from_callback(
            whole.shape, NamedSharding(mesh, spec), lambda index: whole[index]
        )

    placed = jax.tree.map(place, arrays, specs)
    return dataclasses.replace(eqx.combine(placed, rest), mesh=mesh)


def _per_view(problem: JointProblem) -> tuple[Any, ...]:
    return (
        problem.observations,
        problem.own_free,
        problem.prior_mean.corrections,
        problem.prior_weight.corrections,
        problem.scale.corrections,
    )


def last_repeated(parts: Any, extra: int) -> Any:
    """Arrays with copies of their last entry, so that they go evenly into devices."""
    return jax.tree.map(lambda x: jnp.concatenate([x, x[-1:].repeat(extra, axis=0)]), parts)


def _stretched(parts: tuple[Any, ...], extra: int) -> tuple[Any, ...]:
    """With copies of the last view, of which nothing is seen and nothing may move."""
    observations, own_free, *rest = last_repeated(parts, extra)
    views = len(observations.visible) - extra
    observations = eqx.tree_at(
        lambda o: o.visible, observations, observations.visible.at[views:].set(False)
    )
    return observations, own_free.at[views:].set(False), *rest
