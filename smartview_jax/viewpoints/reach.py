"""Whether an arm gets somewhere, and with which joints."""

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
    """Joint readings for commands, and what is to be said of them.

    Args:
        arm: as its controller believes it to be.
        command: poses `(*views)`; joints that it has already are kept, NaN where there are none.
        near: readings in whose neighbourhood to look.
    """
    joints = command.joints
    if joints is None:
        return joints_for_pose(arm, command.base_from_tool, near)
    beyond = arm.out_of_limits(joints, SLACK)
    there = jnp.all(jnp.isfinite(joints), axis=-1)
    status = jnp.where(there, 0, int(Status.OUT_OF_REACH))
    status = status | jnp.where(beyond.any(axis=-1), int(Status.OUT_OF_LIMITS), 0)
    return JointSolution(joints, status, beyond)


def singular(solution: JointSolution) -> Bool[Array, "*views"]:
    """Where an answer holds, but at a singularity: the robot cannot move on from it as it likes."""
    return solution.reached & ((solution.status & ~int(NO_ANSWER)) != 0)


def words(solution: JointSolution, view: int) -> str:
    """What is to be said of one view, counted in flat order."""
    return solution.reason(tuple(map(int, np.unravel_index(view, solution.status.shape))))
