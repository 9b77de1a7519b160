"""Joints that answer a wanted pose: which, whether they can be gone to, and if not, why."""

import enum

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .command import JointsLike
from .serial_arm import SerialArm

SLACK = 1e-9
"""By which readings may pass a limit, rad or m: a limit that was commanded comes back rounded."""


class Status(enum.IntFlag):
    """What is to be said of an answer; several may hold at once."""

    OK = 0
    OUT_OF_REACH = enum.auto()
    OUT_OF_LIMITS = enum.auto()
    SHOULDER_SINGULAR = enum.auto()
    ELBOW_SINGULAR = enum.auto()
    WRIST_SINGULAR = enum.auto()
    SINGULAR = enum.auto()


NO_ANSWER = Status.OUT_OF_REACH | Status.OUT_OF_LIMITS
"""What rules an answer out; at a singularity it holds, but is not the only one near by."""

_WORDS = {
    Status.OUT_OF_REACH: "out of reach",
    Status.SHOULDER_SINGULAR: "singular shoulder: the wrist is as near the first axis as it gets",
    Status.ELBOW_SINGULAR: "singular elbow: the arm is stretched out or folded",
    Status.WRIST_SINGULAR: "singular wrist: joints 4 and 6 turn about one axis",
    Status.SINGULAR: "singular: some direction no joint moves the tool in",
}


class JointSolution(eqx.Module):
    """Joints for wanted poses.

    Attributes:
        joints: readings, rad or m; NaN where no joints put the tool there.
        status: of each, as `Status`.
        beyond: the joints whose limits are passed, or stand in the way.
    """

    joints: Float[Array, "*views joints"]
    status: Int[Array, "*views"]
    beyond: Bool[Array, "*views joints"]

    @property
    def reached(self) -> Bool[Array, "*views"]:
        """Where the joints put the tool at its pose and are within their limits."""
        return (self.status & int(NO_ANSWER)) == 0

    def reason(self, view: int | tuple[int, ...] = ()) -> str:
        """The status of one view in words; "ok" where there is nothing to say."""
        status = Status(int(self.status[view]))
        said = [words for kind, words in _WORDS.items() if status & kind]
        if status & Status.OUT_OF_LIMITS:
            joints = 1 + np.flatnonzero(np.asarray(self.beyond[view]))
            said.append(f"out of limits: joint {', '.join(map(str, joints))}")
        return "; ".join(said) or "ok"


def nearest_turn(
    arm: SerialArm, joints: Float[Array, "*views joints"], near: JointsLike | None = None
) -> Float[Array, "*views joints"]:
    """Readings moved by whole turns into their limits, and there as near as can be to given ones.

    Where no turn is within the limits, the one nearest the middle of them. Sliding joints stay.

    Args:
        arm: whose limits.
        joints: rad or m.
        near: by default the middle of the limits; zero where a joint has none.
    """
    turn, shape = 2.0 * jnp.pi, joints.shape
    lower, upper = (jnp.broadcast_to(bound, shape) for bound in arm.limits.T)
    bounded = jnp.isfinite(lower) & jnp.isfinite(upper)
    middle = jnp.where(bounded, 0.5 * (jnp.where(bounded, lower + upper, 0.0)), 0.0)
    wanted = middle if near is None else jnp.broadcast_to(jnp.asarray(near, dtype=float), shape)
    least = jnp.ceil((lower - SLACK - joints) / turn)
    most = jnp.floor((upper + SLACK - joints) / turn)
    inside = jnp.clip(jnp.round((wanted - joints) / turn), least, most)
    turns = jnp.where(least <= most, inside, jnp.round((middle - joints) / turn))
    return jnp.where(
        jnp.broadcast_to(np.array(arm.prismatic), shape), joints, joints + turn * turns
    )
