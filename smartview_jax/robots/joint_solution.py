"""Define the result of inverse kinematics: the joints, and if there are none, why."""

import enum

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .command import JointsLike
from .serial_arm import SerialArm

LIMIT_TOLERANCE = 1e-9
"""Tolerance by which readings may exceed a limit, rad or m.

A robot at its limit reports it with rounding.
"""


class SolutionStatus(enum.IntFlag):
    """The flags that describe an inverse-kinematics solution; several may be set at once."""

    OK = 0
    OUT_OF_REACH = enum.auto()
    OUT_OF_LIMITS = enum.auto()
    SHOULDER_SINGULAR = enum.auto()
    ELBOW_SINGULAR = enum.auto()
    WRIST_SINGULAR = enum.auto()
    SINGULAR = enum.auto()


FAILURE_FLAGS = SolutionStatus.OUT_OF_REACH | SolutionStatus.OUT_OF_LIMITS
"""Flags that make a solution unusable.

A singular solution is still valid, but is not isolated: other solutions are arbitrarily close.
"""

_STATUS_TEXTS = {
    SolutionStatus.OUT_OF_REACH: "out of reach",
    SolutionStatus.SHOULDER_SINGULAR: (
        "singular shoulder: the wrist is as near the first axis as it gets"
    ),
    SolutionStatus.ELBOW_SINGULAR: "singular elbow: the arm is stretched out or folded",
    SolutionStatus.WRIST_SINGULAR: "singular wrist: joints 4 and 6 turn about one axis",
    SolutionStatus.SINGULAR: "singular: in some direction no joint moves the tool",
}


class JointSolution(eqx.Module):
    """Joint readings that solve the inverse kinematics of wanted poses, with their status.

    Attributes:
        joints: readings, rad or m; NaN where no joints reach the pose.
        status: flags of each pose, as `SolutionStatus`.
        violated_limits: joints beyond their limit, or held back by it.
    """

    joints: Float[Array, "*views joints"]
    status: Int[Array, "*views"]
    violated_limits: Bool[Array, "*views joints"]

    @property
    def is_solved(self) -> Bool[Array, "*views"]:
        """Whether the joints put the tool at its pose and are within their limits."""
        return (self.status & int(FAILURE_FLAGS)) == 0

    @property
    def is_singular(self) -> Bool[Array, "*views"]:
        """Whether the joints are valid but singular: the motion of the tool is restricted there."""
        return self.is_solved & ((self.status & ~int(FAILURE_FLAGS)) != 0)

    def status_text(self, view: int | tuple[int, ...] = ()) -> str:
        """Return the status of one view in words; "ok" where no flag is set."""
        status = SolutionStatus(int(np.asarray(self.status)[view]))
        texts = [text for flag, text in _STATUS_TEXTS.items() if status & flag]
        if status & SolutionStatus.OUT_OF_LIMITS:
            joints = 1 + np.flatnonzero(np.asarray(self.violated_limits)[view])
            texts.append(f"out of limits: joint {', '.join(map(str, joints))}")
        return "; ".join(texts) or "ok"


def wrap_to_limits(
    arm: SerialArm, joints: Float[Array, "*views joints"], near: JointsLike | None = None
) -> Float[Array, "*views joints"]:
    """Return readings (rad, m) shifted by whole revolutions into their limits, close to `near`.

    Where no revolution is within the limits, the reading closest to their middle is returned.
    Prismatic joints do not change. Without `near` the middle of two limits is taken, else zero.
    """
    revolution, shape = 2.0 * jnp.pi, joints.shape
    lower, upper = (jnp.broadcast_to(bound, shape) for bound in arm.limits.T)
    bounded = jnp.isfinite(lower) & jnp.isfinite(upper)
    middle = jnp.where(bounded, 0.5 * (jnp.where(bounded, lower + upper, 0.0)), 0.0)
    reference = middle if near is None else jnp.broadcast_to(jnp.asarray(near, dtype=float), shape)
    # Revolutions n with lower <= q + 2 pi n <= upper; of these the one closest to
    # (reference - q) / (2 pi).
    min_revolutions = jnp.ceil((lower - LIMIT_TOLERANCE - joints) / revolution)
    max_revolutions = jnp.floor((upper + LIMIT_TOLERANCE - joints) / revolution)
    clipped = jnp.clip(
        jnp.round((reference - joints) / revolution), min_revolutions, max_revolutions
    )
    revolutions = jnp.where(
        min_revolutions <= max_revolutions, clipped, jnp.round((middle - joints) / revolution)
    )
    return jnp.where(
        jnp.broadcast_to(np.array(arm.prismatic), shape), joints, joints + revolution * revolutions
    )
