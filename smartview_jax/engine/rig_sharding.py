"""Run the fit of a rig on several devices or processes; each linearises a part of the views.

Every camera's views are dealt out to the devices. The robot's states, never more than the views,
are on all of them: what cameras tell of one state is added up there.
"""

from collections.abc import Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import Array

from ..runtime.array_namespace import to_device
from ..runtime.modules import with_fields
from .abstract_problem import NormalEquations
from .arms_problem import ArmsProblem
from .parameters import Step
from .problem import VIEW_AXIS
from .rig_problem import CameraGroup, RigProblem
from .sharding import on_devices, view_arrays
from .solver import Solution, equations_without_padding, solve, step_without_padding

_Module = TypeVar("_Module", bound=eqx.Module)


def solve_rig_on(
    devices: Sequence[Any] | None,
    problem: RigProblem | ArmsProblem,
    start: Step | None = None,
) -> tuple[Solution, NormalEquations]:
    """Minimise the problem of a rig with its views distributed over devices, as `solve_on` does.

    Args:
        devices: the devices, such as `jax.devices()`; None for the default device alone.
        problem: the problem.
        start: step from which to begin; by default zero.
    """
    if devices is None:
        return solve(problem, start=start)
    solution, equations = solve(shard_rig(problem, devices), start=start)
    # The chains are moved to the default device.
    chain = jax.tree.map(lambda x: to_device(np.asarray(x)), solution.chain)
    solution = solution._replace(z=step_without_padding(solution.z, problem), chain=chain)
    return solution, equations_without_padding(equations, problem)


def shard_rig(
    problem: RigProblem | ArmsProblem, devices: Sequence[Any]
) -> RigProblem | ArmsProblem:
    """Distribute the views of a rig's cameras over several devices.

    Views without points are added to make their number divisible by the number of devices.
    """
    mesh = Mesh(np.array(devices), (VIEW_AXIS,))
    if isinstance(problem, RigProblem):
        return _sharded(problem, mesh)
    arms = [_replicated(arm, mesh, problem=_sharded(arm.problem, mesh)) for arm in problem.arms]
    return with_fields(_replicated(problem, mesh, arms=tuple(arms)), mesh=mesh)


def _sharded(problem: RigProblem, mesh: Mesh) -> RigProblem:
    """Distribute the views of one arm's cameras."""
    states = len(problem.per_view_free)
    groups = tuple(_sharded_group(group, states, mesh) for group in problem.groups)
    return with_fields(_replicated(problem, mesh, groups=groups), mesh=mesh)


def _sharded_group(group: CameraGroup, states: int, mesh: Mesh) -> CameraGroup:
    """Distribute the views of cameras of one kind, whose arrays have the cameras first."""
    extra = -group.state_index.shape[1] % mesh.size

    def padded(x: Array) -> np.ndarray:
        """Repeat the last view of each camera."""
        values = np.asarray(x)
        return np.concatenate([values, np.repeat(values[:, -1:], extra, axis=1)], axis=1)

    arrays, rest = eqx.partition(group, eqx.is_array)
    observations, *others, states_of_views = jax.tree.map(padded, _view_arrays(arrays))
    # In the copies no point is visible, and their state is after the last one.
    observations = with_fields(observations, visible=_last_set(observations.visible, extra, False))
    states_of_views = _last_set(states_of_views, extra, states)
    arrays = _with_view_arrays(arrays, (observations, *others, states_of_views))
    specs = _with_view_arrays(
        jax.tree.map(lambda _: P(), arrays),
        jax.tree.map(lambda _: P(None, VIEW_AXIS), _view_arrays(arrays)),
    )
    sharded = eqx.combine(on_devices(arrays, specs, mesh), rest)
    return with_fields(sharded, problems=with_fields(sharded.problems, mesh=mesh))


def _last_set(values: np.ndarray, extra: int, value: bool | int) -> np.ndarray:
    """Return `(cameras, views, ...)` numbers with a value in each camera's last `extra` views."""
    result = np.array(values)
    result[:, result.shape[1] - extra :] = value
    return result


def _view_arrays(group: CameraGroup) -> tuple[Any, ...]:
    """Return the arrays whose second axis is the views."""
    return *view_arrays(group.problems), group.state_index


def _with_view_arrays(group: CameraGroup, arrays: tuple[Any, ...]) -> CameraGroup:
    """Replace the arrays that `_view_arrays` returns."""
    return eqx.tree_at(_view_arrays, group, arrays, is_leaf=lambda x: x is None)


def _replicated(module: _Module, mesh: Mesh, **parts: Any) -> _Module:
    """Put a module whole on each device of a mesh, except for parts, which are there already."""
    arrays, rest = eqx.partition(with_fields(module, **dict.fromkeys(parts)), eqx.is_array)
    whole = on_devices(arrays, jax.tree.map(lambda _: P(), arrays), mesh)
    return with_fields(eqx.combine(whole, rest), **parts)
