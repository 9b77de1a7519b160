"""Hold what cameras of a rig see of their targets, and find the states that two of them saw."""

from collections.abc import Collection, Iterator, Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from ..dataset import Rig
from .closure import Poses
from .transform_fit import Matrix

MIN_COMMON_STATES = 6
"""Fewest states in common that tell a displaced target from noise."""

MAX_LEFT_OVER = 0.5
"""Largest share of the misfit that an explanation may leave over: it must explain most of it."""

MAX_CHANCE = 1e-6
"""Probability by chance below which a displaced target or exchanged pictures are said, as of arms
that disagree."""


class SeenTarget(NamedTuple):
    """The target as one camera of a rig sees it.

    Attributes:
        views: indices of the camera's views that are used.
        camera_from_world: pose of the target in the camera in each of these views, m.
        holder_from_world: place of the target as the camera and the robot tell it, m.
    """

    views: Int[np.ndarray, "used"]
    camera_from_world: Poses
    holder_from_world: Matrix


def pairs_with_one_target(rig: Rig, cameras: Collection[str]) -> Iterator[tuple[str, str]]:
    """Return the names of every two of some cameras that see one target and share an arm."""
    return (pair for pair in combinations(cameras, 2) if rig.see_one_target(*pair))


def states_in_common(
    rig: Rig, first: str, second: str, seen: Mapping[str, SeenTarget]
) -> tuple[Int[np.ndarray, "states"], Poses, Poses]:
    """Return the states that two cameras saw, and the target's poses in both cameras in them.

    Args:
        rig: data sets of the cameras.
        first, second: names of the cameras.
        seen: the target as each camera sees it.
    """
    first_states, second_states = (
        rig.state_index[name][seen[name].views] for name in (first, second)
    )
    states, in_first, in_second = np.intersect1d(first_states, second_states, return_indices=True)
    return (
        states,
        seen[first].camera_from_world[in_first],
        seen[second].camera_from_world[in_second],
    )
