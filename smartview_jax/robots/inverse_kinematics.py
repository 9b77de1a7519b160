"""Joint angles that put a tool somewhere, found by iteration from angles near by."""

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from .command import JointsLike
from .serial_arm import SerialArm

STEPS = 100
"""Of Levenberg-Marquardt, at most."""

ARRIVED = 1e-9
"""Of the twist that is left, m and rad."""


@eqx.filter_jit
def joints_near(
    arm: SerialArm, base_from_tool: SE3, near: JointsLike
) -> tuple[Float[Array, "*views joints"], Bool[Array, "*views"]]:
    """Joint angles near given ones at which an arm's tool is at a pose.

    Damped steps: an arm with joints to spare moves them no more than it has to, and a pose out of
    reach ends at one that is near it.

    Args:
        arm: any.
        base_from_tool: wanted, `(*views)`.
        near: where to begin.

    Returns:
        Angles, and whether they reach the pose.
    """
    solver = optx.LevenbergMarquardt(rtol=1e-12, atol=1e-12)

    def view(
        pose: Float[Array, "7"], start: Float[Array, "joints"]
    ) -> tuple[Float[Array, "joints"], Bool[Array, ""]]:
        wanted = SE3(pose).inverse()

        def left(joints: Float[Array, "joints"], _: None = None) -> Float[Array, "6"]:
            return (wanted @ arm.base_from_tool(joints)).log()

        found = optx.least_squares(left, solver, start, max_steps=STEPS, throw=False).value
        return found, jnp.max(jnp.abs(left(found))) < ARRIVED

    poses = base_from_tool.wxyz_xyz
    starts = jnp.broadcast_to(jnp.asarray(near, dtype=float), (*poses.shape[:-1], arm.size))
    for _ in poses.shape[:-1]:
        view = jax.vmap(view)
    return view(poses, starts)
