"""Define the result of inverse kinematics: the joints, and if there are none, why."""

import enum

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .command import JointsLike
from .serial_arm import SerialArm

SLACK = 1e-9
"""Tolerance by which readings may exceed a limit, rad or m.

A robot at its limit reports it with rounding.
"""


class Status(enum.IntFlag):
    """The flags that describe an inverse-kinematics solution; several may be set at once."""

    OK = 0
    OUT_OF_REACH = enum.auto()
    OUT_OF_LIMITS = enum.auto()
    SHOULDER_SINGULAR = enum.auto()
    ELBOW_SINGULAR = enum.auto()
    WRIST_SINGULAR = enum.auto()
    SINGULAR = enum.auto()


NO_ANSWER = Status.OUT_OF_REACH | Status.OUT_OF_LIMITS
"""Flags that make a solution unusable.

A singular solution is still valid, but is not isolated: other solutions are arbitrarily close.
"""

_WORDS = {
    Status.OUT_OF_REACH: "out of reach",
    Status.SHOULDER_SINGULAR: "singular shoulder: the wrist is as near the first axis as it gets",
    Status.ELBOW_SINGULAR: "singular elbow: the arm is stretched out or folded",
    Status.WRIST_SINGULAR: "singular wrist: joints 4 and 6 turn about one axis",
    Status.SINGULAR: "singular: some direction no joint moves the tool in",
}


class JointSolution(eqx.Module):
    """Joint readings that solve the inverse kinematics of wanted poses, with their status.

    Attributes:
        joints: readings, rad or m; NaN where no joints reach the pose.
        status: flags of each pose, as `Status`.
        beyond: joints beyond their limit, or held back by it.
    """

    joints: Float[Array, "*views joints"]
    status: Int[Array, "*views"]
    beyond: Bool[Array, "*views joints"]

    @property
    def reached(self) -> Bool[Array, "*views"]:
        """Whether the joints put the tool at its pose and are within their limits."""
        return (self.status & int(NO_ANSWER)) == 0

    def reason(self, view: int | tuple[int, ...] = ()) -> str:
        """Return the status of one view in words; "ok" where no flag is set."""
        status = Status(int(self.status[view]))
        said = [words for kind, words in _WORDS.items() if status & kind]
        if status & Status.OUT_OF_LIMITS:
            joints = 1 + np.flatnonzero(np.asarray(self.beyond[view]))
            said.append(f"out of limits: joint {', '.join(map(str, joints))}")
        return "; ".join(said) or "ok"


def nearest_turn(
    arm: SerialArm, joints: Float[Array, "*views joints"], near: JointsLike | None = None
) -> Float[Array, "*views joints"]:
    """Return readings shifted by whole revolutions into their limits, close to `near`.

    Where no revolution is within the limits, the reading closest to their middle is returned.
    Prismatic joints do not change.

    Args:
        arm: arm whose limits apply.
        joints: readings, rad or m.
        near: readings to be close to; by default the middle of the limits, or zero for a joint
            without two limits.
    """
    turn, shape = 2.0 * jnp.pi, joints.shape
    lower, upper = (jnp.broadcast_to(bound, shape) for bound in arm.limits.T)
    bounded = jnp.isfinite(lower) & jnp.isfinite(upper)
    middle = jnp.where(bounded, 0.5 * (jnp.where(bounded, lower + upper, 0.0)), 0.0)
    wanted = middle if near is None else jnp.broadcast_to(jnp.asarray(near, dtype=float), shape)
    # Revolutions n with lower <= q + 2 pi n <= upper; of these the one closest to (wanted - q) / 2
    # pi.
    least = jnp.ceil((lower - SLACK - joints) / turn)
    most = jnp.floor((upper + SLACK - joints) / turn)
    inside = jnp.clip(jnp.round((wanted - joints) / turn), least, most)
    turns = jnp.where(least <= most, inside, jnp.round((middle - joints) / turn))
    return jnp.where(
        jnp.broadcast_to(np.array(arm.prismatic), shape), joints, joints + turn * turns
    )
