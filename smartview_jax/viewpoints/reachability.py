"""Determine whether an arm reaches a command, and with which joint readings."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from ..robots import (
    FAILURE_FLAGS,
    LIMIT_TOLERANCE,
    Command,
    JointsLike,
    JointSolution,
    SerialArm,
    SolutionStatus,
    joints_for_pose,
)


def solve_joints(arm: SerialArm, command: Command, near: JointsLike) -> JointSolution:
    """Return joint readings for commands, with their status.

    Args:
        arm: the nominal arm.
        command: poses `(*views)`; joints in the command are kept, NaN where there are none.
        near: joint readings near which to solve.
    """
    joints = command.joints
    if joints is None:
        return joints_for_pose(arm, command.base_from_tool, near)
    # The command has joints already, for example because arm errors were compensated. They are only
    # checked, since another solution would undo the compensation.
    out_of_limits = arm.violated_limits(joints, LIMIT_TOLERANCE)
    has_joints = jnp.all(jnp.isfinite(joints), axis=-1)
    status = jnp.where(has_joints, 0, int(SolutionStatus.OUT_OF_REACH))
    status = status | jnp.where(out_of_limits.any(axis=-1), int(SolutionStatus.OUT_OF_LIMITS), 0)
    return JointSolution(joints, status, out_of_limits)


def is_singular(solution: JointSolution) -> Bool[Array, "*views"]:
    """Return whether a solution is valid but at a singularity.

    The motion of the tool is restricted there.
    """
    return solution.is_solved & ((solution.status & ~int(FAILURE_FLAGS)) != 0)


def status_message(solution: JointSolution, view: int) -> str:
    """Return the status of one view in words; `view` counts in flat order."""
    return solution.status_text(tuple(map(int, np.unravel_index(view, solution.status.shape))))
