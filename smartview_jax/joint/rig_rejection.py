"""Find the state of a rig's robot that contradicts the others, and tell whose fault it is.

If the robot was not where it reported, all cameras contradict the report; if a picture belongs to
another state, its camera alone does.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float
from scipy.special import chdtrc

from ..dataset import MINIMUM_RELIABLE_VIEWS, Rig
from ..engine import BlockArrow, BuiltRig, RigProblem, Step, padded, padded_step, solve
from ..runtime.compilation import compiled
from .consistent_views import FALSE_ALARM_PROBABILITY
from .influence import pose_outlier_test


class Contradiction(NamedTuple):
    """A state that contradicts the others.

    Attributes:
        view_id: name of the state.
        cameras: names of the cameras whose views of this state are left out.
        reason: the reason, a sentence.
    """

    view_id: str
    cameras: tuple[str, ...]
    reason: str


def contradiction(rig: Rig, built: BuiltRig, z: Step, matrix: BlockArrow) -> Contradiction | None:
    """Return the state, or a camera's view of it, that contradicts the others most.

    None if that is not significant, or with too few states to decide which is wrong.

    Args:
        rig: data sets of the cameras.
        built: the problem with priors on the corrections of the states.
        z: its optimum.
        matrix: matrix of the normal equations there.
    """
    placed = sum(len(cameras) > 0 for cameras in rig.seeing)
    if placed <= MINIMUM_RELIABLE_VIEWS:
        return None
    if (wrong := _wrong_view(rig, built, z)) is not None:
        return wrong
    worst, p_value = _worst_state(rig, built, z, matrix)
    # Bonferroni: the smallest of n p-values is tested at the level FALSE_ALARM_PROBABILITY / n.
    return worst if p_value * placed < FALSE_ALARM_PROBABILITY else None


def suspect_state(rig: Rig, built: BuiltRig, z: Step, matrix: BlockArrow) -> Contradiction | None:
    """Return the state that contradicts the others most, significantly or not; None with few."""
    if sum(len(cameras) > 0 for cameras in rig.seeing) <= MINIMUM_RELIABLE_VIEWS:
        return None
    return _worst_state(rig, built, z, matrix)[0]._replace(reason="")


def _wrong_view(rig: Rig, built: BuiltRig, z: Step) -> Contradiction | None:
    """Return the view of one camera that contradicts the other cameras in the same state."""
    distances, seeing = _distances_by_view(built, z), rig.seeing
    # A state that one camera saw has the pose that this camera tells.
    shared = {
        (camera, state): distances[camera][view]
        for camera in rig.cameras
        for view, state in enumerate(rig.state_index[camera])
        if camera in seeing[state] and len(seeing[state]) > 1
    }
    if not shared:
        return None
    (_, state), distance = max(shared.items(), key=lambda item: item[1])
    if not chdtrc(6, distance) * len(shared) < FALSE_ALARM_PROBABILITY:
        return None
    # Cameras that contradict each other do so mutually: the view without which the others agree
    # best is the wrong one.
    costs = {name: _cost_without(rig, built, z, name, state) for name in seeing[state]}
    wrong = min(costs, key=lambda name: costs[name])
    others = ", ".join(name for name in seeing[state] if name != wrong)
    return Contradiction(
        rig.view_ids[state],
        (wrong,),
        f"its picture contradicts the robot and {others}, by {np.sqrt(distance):.0f} standard "
        "deviations: mispaired, or was the camera touched?",
    )


def _worst_state(
    rig: Rig, built: BuiltRig, z: Step, matrix: BlockArrow
) -> tuple[Contradiction, float]:
    """Return the state whose reported pose contradicts most what all cameras saw, and p-value."""
    scores = pose_outlier_test(built.problem, z, matrix, sigmas_known=False)
    state = int(np.argmin(scores.p_value))
    worst = Contradiction(
        rig.view_ids[state],
        rig.seeing[state],
        f"the robot's pose lies {float(scores.distance[state]):.0f} standard deviations from where "
        "the other states put it: mispaired or moved?",
    )
    return worst, float(scores.p_value[state])


def _distances_by_view(built: BuiltRig, z: Step) -> dict[str, Float[np.ndarray, "views"]]:
    """Return the distance of each camera's views from what all others say (`view_distances`)."""
    problem = padded(built.problem)
    by_group = _view_distances(problem, padded_step(z, problem))
    return {
        name: np.nan_to_num(np.asarray(distances)[row])
        for cameras, distances in zip(built.cameras, by_group, strict=True)
        for row, name in enumerate(cameras)
    }


@compiled
def _view_distances(problem: RigProblem, z: Step) -> tuple[Float[Array, "cameras views"], ...]:
    """Return the distances of all views, compiled for the given shapes."""
    return problem.view_distances(z)


def _cost_without(rig: Rig, built: BuiltRig, z: Step, camera: str, state: int) -> float:
    """Return the cost of the fit without one camera's view of a state."""
    view = int(np.flatnonzero(rig.state_index[camera] == state)[0])
    solution, _ = solve(built.without_view(camera, view), start=z)
    return solution.costs[-1]
