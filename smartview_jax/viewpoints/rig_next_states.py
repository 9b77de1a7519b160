"""Plan the next states of a rig's robot, with the benefit for all of its cameras.

Each candidate is a view of one of the cameras, near its calibrated views, in which this camera sees
the whole target; the others see what they see from there.
"""

import functools
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from ..argument_checks import errors_at
from ..geometry import host_matrices
from ..robots import JointsLike, SerialArm
from ..runtime.array_namespace import to_device
from .candidate_selection import StopRule, worth_of_views
from .commands import ViewpointCommands, viewpoint_commands
from .next_views import ViewPlan
from .optimality_criteria import a_optimal
from .rig_information import RigInformationModel
from .situations import ViewLimits, views_near_calibrated
from .view_planning import DEFAULT_CANDIDATE_COUNT, choose_views
from .view_range import ViewRange


class StatePlan(NamedTuple):
    """The states of a rig's robot to take next, best first.

    Attributes:
        plan: their benefit.
        commands: robot commands, each with the checks of the camera that it is a view of.
        view_of: name of that camera, for each state.
        seen: fraction of its target that each camera sees in each state, by the camera's name.
    """

    plan: ViewPlan
    commands: ViewpointCommands
    view_of: tuple[str, ...]
    seen: dict[str, Float[np.ndarray, "count"]]


def plan_states(
    model: RigInformationModel,
    limits: ViewLimits,
    stop: StopRule,
    *,
    arm: SerialArm | None = None,
    near: JointsLike | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> StatePlan:
    """Choose states of a rig's robot, up to where another one is no longer worth its time.

    They minimise the displacement of a point in front of each camera, by the uncertainty of the
    hand-eye transforms.

    Args:
        model: the current information, and the information of states.
        stop: when the plan ends; its goal is in m.
        arm: the arm, if its joints are known.
        near: joint readings near which to solve; also needed if an arm's errors are corrected.
        seed: seed of the random candidates.
        progress: called with a text for each stage.

    Raises:
        ValueError: fewer than `stop.count` candidates may be taken, a calibration states no region,
            or all hand-eye transforms are held.
    """
    ranges = {name: _range_of(model, name, limits) for name in model.calibrations}
    distance = float(np.mean([0.5 * sum(views.distance) for views in ranges.values()]))
    criterion = a_optimal(model, distance)
    say = progress or (lambda _: None)
    say("computing what each camera would see")
    commands, cameras = _candidates(model, ranges, arm, near, seed)
    rig = model.planned(commands.command)
    seen = {n: np.asarray(data.visible).mean(axis=1) for n, data in rig.cameras.items()}
    sees_all = np.max(list(seen.values()), axis=0) == 1.0
    may_be_taken = np.asarray(commands.checks.safe) & sees_all
    chosen = choose_views(
        model, criterion, stop.count, rig, allowed=lambda _: may_be_taken, progress=progress
    )
    worth = worth_of_views(criterion, model.prior_information, chosen.cumulative_criterion, stop)
    rows = np.asarray(chosen.states)[: worth.needed]
    taken = _combined(lambda array: array[rows], commands)
    poses = host_matrices(taken.predicted_views.camera_from_world)
    plan = ViewPlan(poses, worth.before, worth.values, criterion.unit, distance, tuple(ranges))
    return StatePlan(
        plan,
        taken,
        tuple(cameras[row] for row in rows),
        {name: fraction[rows] for name, fraction in seen.items()},
    )


def _range_of(model: RigInformationModel, name: str, limits: ViewLimits) -> ViewRange:
    points = np.asarray(model.rig.cameras[name].points[0])
    with errors_at(f"camera {name!r}"):
        return views_near_calibrated(model.calibrations[name], points, limits)


def _candidates(
    model: RigInformationModel,
    ranges: Mapping[str, ViewRange],
    arm: SerialArm | None,
    near: JointsLike | None,
    seed: int,
) -> tuple[ViewpointCommands, list[str]]:
    """Return random candidates, as many for each camera, and the camera of each."""
    rng, each = np.random.default_rng(seed), DEFAULT_CANDIDATE_COUNT // len(ranges)
    parts, cameras = [], []
    for name, views in ranges.items():
        poses = views.poses(views.sample(rng, each))
        points = np.asarray(model.rig.cameras[name].points[0])
        parts.append(viewpoint_commands(model.calibrations[name], poses, points, arm, near))
        cameras += [name] * each
    return _combined(lambda *arrays: np.concatenate(arrays), *parts), cameras


def _combined(combine: Callable[..., np.ndarray], *parts: ViewpointCommands) -> ViewpointCommands:
    """Return commands whose arrays are combined from the arrays of several commands.

    Their predicted views have the camera of the first part, but the poses of each part's camera.
    """

    def on_host(*arrays: Array) -> Array:
        return to_device(combine(*map(np.asarray, arrays)))

    return parts[0].with_arrays(functools.partial(jax.tree.map, on_host), *parts[1:])
