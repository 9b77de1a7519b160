"""Run one fit on several devices or processes; each device linearises a part of the views.

Views are independent in the linearisation. In a step, devices exchange only the sum of one small
matrix. The result is the same as on a single device, up to rounding.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
import optimistix as optx
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Array

from ..runtime.array_namespace import to_device
from ..runtime.modules import with_fields
from ..runtime.padding import repeat_last
from .parameters import Step
from .problem import VIEW_AXIS, JointProblem, NormalEquations
from .solver import (
    Solution,
    chain_without_padding,
    equations_without_padding,
    padded_step,
    solve,
    step_without_padding,
)

_Tree = TypeVar("_Tree")


def solve_on(
    devices: Sequence[Any],
    problem: JointProblem,
    solver: optx.AbstractLeastSquaresSolver[Any, Any, Any, Any] | None = None,
    start: Step | None = None,
) -> tuple[Solution, NormalEquations]:
    """Minimise a problem with its views distributed over devices; otherwise like `solve`.

    The result is on the default device. With several processes (`jax.distributed.initialize`) every
    process calls this function with the same problem and with all devices (`jax.devices()`), and
    every process gets the whole result.
    """
    sharded = shard(problem, devices)
    if start is not None:
        start = padded_step(start, sharded)
    solution, equations = solve(sharded, solver, start=start)

    single = jax.tree.map(to_device, solution.chain.calibration)
    chain = with_fields(chain_without_padding(solution.chain, problem), calibration=single)
    z = step_without_padding(solution.z, problem)
    return solution._replace(z=z, chain=chain), equations_without_padding(equations, problem)


def shard(problem: JointProblem, devices: Sequence[Any]) -> JointProblem:
    """Distribute the views of a problem over several devices.

    Views without points are added to make the number of views divisible by the number of devices.
    """
    # JAX splits an axis only into equal parts, hence the padding.
    mesh = Mesh(np.array(devices), (VIEW_AXIS,))
    extra = -len(problem.observations.visible) % len(devices)
    # Arrays of the views are split along their first axis; all others are replicated, P().
    arrays, rest = eqx.partition(problem, eqx.is_array)
    arrays = _with_view_arrays(arrays, _pad_views(view_arrays(arrays), extra))
    specs = _with_view_arrays(
        jax.tree.map(lambda _: P(), arrays),
        jax.tree.map(lambda x: P(VIEW_AXIS) if len(x) else P(), view_arrays(arrays)),
    )

    return dataclasses.replace(eqx.combine(on_devices(arrays, specs, mesh), rest), mesh=mesh)


def on_devices(arrays: _Tree, specs: _Tree, mesh: Mesh) -> _Tree:
    """Put arrays on the devices of a mesh, each split as its `PartitionSpec` says."""

    def put(x: Array, spec: P) -> Array:
        """Put one array on the devices."""
        whole = np.asarray(x)
        # Every process holds the whole array, and hands over only the parts of its own devices.
        return jax.make_array_from_callback(
            whole.shape, NamedSharding(mesh, spec), lambda index: whole[index]
        )

    return jax.tree.map(put, arrays, specs)


def view_arrays(problem: JointProblem) -> tuple[Any, ...]:
    """Return the arrays whose first axis is the views."""
    return (
        problem.observations,
        problem.prepared_poses,
        problem.correction_roots,
        problem.per_view_free,
        problem.prior_mean.per_view,
        problem.prior_weight.per_view,
        problem.scale.per_view,
    )


def _with_view_arrays(problem: JointProblem, arrays: tuple[Any, ...]) -> JointProblem:
    """Replace the arrays that `view_arrays` returns."""
    # Without a robot error field, `prepared_poses` is None.
    return eqx.tree_at(view_arrays, problem, arrays, is_leaf=lambda x: x is None)


def _pad_views(arrays: tuple[Any, ...], extra: int) -> tuple[Any, ...]:
    """Repeat the last view; in the copies no point is visible and no parameter is free."""
    views = len(arrays[0].visible)
    padded = jax.tree.map(np.array, repeat_last(arrays, views + extra))
    observations, _, _, per_view_free, *_ = padded
    observations.visible[views:] = False
    per_view_free[views:] = False
    return padded
