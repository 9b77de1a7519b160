"""Hold what cameras of a rig see of their targets, and find the states that two of them saw."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from ..dataset import Rig
from .closure import Poses
from .transform_fit import Matrix

MIN_COMMON_STATES = 6
"""Fewest states in common that tell a displaced target from noise."""


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
