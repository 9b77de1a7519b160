"""Run one fit on several devices or processes; each device linearises a part of the views.

Views are independent in the linearisation. In a step, devices exchange only the sum of one small
matrix. The result is the same as on a single device, up to rounding.
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

from ..runtime.array_namespace import to_device
from .parameters import Step
from .problem import VIEW_AXIS, FittedChain, JointProblem, NormalEquations
from .schur import BlockArrow
from .solver import Solution, solve


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
    corrected_views = len(problem.per_view_free)
    sharded = shard(problem, devices)
    if start is not None:
        # The views that were added as padding have no free parameters: their step is zero.
        padding = len(sharded.per_view_free) - corrected_views
        start = Step(start.shared, jnp.pad(start.per_view, ((0, padding), (0, 0))))
    solution, equations = solve(sharded, solver, start=start)

    def without_padding(x: Array) -> Array:
        """Copy an array of the views without the padding."""
        return to_device(x)[:corrected_views]

    z, gradient, matrix, chain = solution.z, equations.gradient, equations.matrix, solution.chain
    view_count = len(problem.observations.visible)
    return (
        solution._replace(
            z=Step(to_device(z.shared), without_padding(z.per_view)),
            chain=FittedChain(
                jax.tree.map(to_device, chain.calibration),
                without_padding(chain.pose_corrections),
                to_device(chain.field_corrections)[:view_count],
                to_device(chain.camera_from_world)[:view_count],
            ),
        ),
        NormalEquations(
            to_device(equations.cost),
            Step(to_device(gradient.shared), without_padding(gradient.per_view)),
            BlockArrow(
                to_device(matrix.shared),
                without_padding(matrix.border),
                without_padding(matrix.per_view),
            ),
        ),
    )


def shard(problem: JointProblem, devices: Sequence[Any]) -> JointProblem:
    """Distribute the views of a problem over several devices.

    Views without points are added to make the number of views divisible by the number of devices.
    """
    # JAX splits an axis only into equal parts, hence the padding.
    mesh = Mesh(np.array(devices), (VIEW_AXIS,))
    extra = -len(problem.observations.visible) % len(devices)
    # Arrays of the views are split along their first axis; all others are replicated, P().
    arrays, rest = eqx.partition(problem, eqx.is_array)
    arrays = _with_view_arrays(arrays, _pad_views(_view_arrays(arrays), extra))
    specs = _with_view_arrays(
        jax.tree.map(lambda _: P(), arrays),
        jax.tree.map(lambda x: P(VIEW_AXIS) if len(x) else P(), _view_arrays(arrays)),
    )

    def to_devices(x: Array, spec: P) -> Array:
        """Put an array on the devices."""
        whole = np.asarray(x)
        # Every process holds the whole array, and hands over only the parts of its own devices.
        return jax.make_array_from_callback(
            whole.shape, NamedSharding(mesh, spec), lambda index: whole[index]
        )

    sharded = jax.tree.map(to_devices, arrays, specs)
    return dataclasses.replace(eqx.combine(sharded, rest), mesh=mesh)


def _view_arrays(problem: JointProblem) -> tuple[Any, ...]:
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
    """Replace the arrays that `_view_arrays` returns."""
    # Without a robot error field, `prepared_poses` is None.
    return eqx.tree_at(_view_arrays, problem, arrays, is_leaf=lambda x: x is None)


def pad_with_last(arrays: Any, copies: int) -> Any:
    """Append copies of the last entry to arrays, to fill up the last device.

    Args:
        arrays: pytree of arrays.
        copies: number of copies.
    """
    return jax.tree.map(lambda x: jnp.concatenate([x, x[-1:].repeat(copies, axis=0)]), arrays)


def _pad_views(arrays: tuple[Any, ...], extra: int) -> tuple[Any, ...]:
    """Repeat the last view; in the copies no point is visible and no parameter is free."""
    observations, prepared_poses, roots, per_view_free, *rest = pad_with_last(arrays, extra)
    views = len(observations.visible) - extra
    observations = eqx.tree_at(
        lambda o: o.visible, observations, observations.visible.at[views:].set(False)
    )
    return observations, prepared_poses, roots, per_view_free.at[views:].set(False), *rest
