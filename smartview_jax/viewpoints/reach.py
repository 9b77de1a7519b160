"""Determine whether an arm reaches a command, and with which joint readings."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from ..robots import (
    NO_ANSWER,
    SLACK,
    Command,
    JointsLike,
    JointSolution,
    SerialArm,
    Status,
    joints_for_pose,
)


def reach(arm: SerialArm, command: Command, near: JointsLike) -> JointSolution:
    """Return joint readings for commands, with their status.

    Args:
        arm: the nominal arm.
        command: poses `(*views)`; joints that a command has already are kept, NaN where there are
            none.
        near: joint readings near which to solve.
    """
    joints = command.joints
    if joints is None:
        return joints_for_pose(arm, command.base_from_tool, near)
    # The command has joints already, for example because arm errors were compensated. They are only
    # checked: another solution would undo the compensation.
    beyond = arm.out_of_limits(joints, SLACK)
    there = jnp.all(jnp.isfinite(joints), axis=-1)
    status = jnp.where(there, 0, int(Status.OUT_OF_REACH))
    status = status | jnp.where(beyond.any(axis=-1), int(Status.OUT_OF_LIMITS), 0)
    return JointSolution(joints, status, beyond)


def singular(solution: JointSolution) -> Bool[Array, "*views"]:
    """Return whether a solution is valid but at a singularity.

    The motion of the tool is restricted there.
    """
    return solution.reached & ((solution.status & ~int(NO_ANSWER)) != 0)


def words(solution: JointSolution, view: int) -> str:
    """Return the status of one view in words; `view` counts in flat order."""
    return solution.reason(tuple(map(int, np.unravel_index(view, solution.status.shape))))
