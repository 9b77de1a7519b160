"""Whether an arm gets somewhere, and with which joints."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..robots import Command, JointsLike, SerialArm, joints_near


def reach(
    arm: SerialArm, command: Command, near: JointsLike
) -> tuple[Float[Array, "*views joints"], Bool[Array, "*views"]]:
    """Joint readings for commands, and whether the arm gets there with them.

    Args:
        arm: as its controller believes it to be.
        command: poses `(*views)`; joints that it has already are kept, NaN where there are none.
        near: readings in whose neighbourhood to look.
    """
    if command.joints is not None:
        return command.joints, jnp.all(jnp.isfinite(command.joints), axis=-1)
    return joints_near(arm, command.base_from_tool, near)
