"""Joint angles that put a tool somewhere, found by iteration from angles near by."""

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..compilation import optimised
from .command import JointsLike
from .serial_arm import SerialArm

STEPS = 100
"""Of Levenberg-Marquardt, at most."""

ARRIVED = 1e-9
"""Of the twist that is left, m and rad."""

EDGE = 0.999
"""Share of a joint's range, from its middle, that a search may begin at."""


@optimised
def joints_near(
    arm: SerialArm, base_from_tool: SE3, near: JointsLike
) -> tuple[Float[Array, "*views joints"], Bool[Array, "*views"]]:
    """Joint angles near given ones at which an arm's tool is at a pose.

    Damped steps: an arm with joints to spare moves them no more than it has to, and a pose out of
    reach ends at one that is near it. Joints stay within their limits; those that could not get on
    for them end there.

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

        def left(joints: Float[Array, "joints"]) -> Float[Array, "6"]:
            return (wanted @ arm.base_from_tool(joints)).log()

        def left_free(free: Float[Array, "joints"], _: None = None) -> Float[Array, "6"]:
            return left(_within(free, arm.limits))

        first = _free(start, arm.limits)
        found = optx.least_squares(left_free, solver, first, max_steps=STEPS, throw=False).value
        found = _within(found, arm.limits)
        return found, jnp.max(jnp.abs(left(found))) < ARRIVED

    poses = base_from_tool.wxyz_xyz
    starts = jnp.broadcast_to(jnp.asarray(near, dtype=float), (*poses.shape[:-1], arm.size))
    for _ in poses.shape[:-1]:
        view = jax.vmap(view)
    return view(poses, starts)


def _free(joints: Float[Array, "n"], limits: Float[Array, "n 2"]) -> Float[Array, "n"]:
    """Coordinates without limits: the inverse of `_within`. Without limits they are the joints."""
    low, high, one, two = _bounds(limits)
    ends = jnp.arcsin(jnp.clip((joints - 0.5 * (low + high)) / (0.5 * (high - low)), -EDGE, EDGE))
    # From the end of its range a joint would see no way to go.
    away = jnp.maximum(
        jnp.where(jnp.isfinite(limits[:, 0]), joints - low, high - joints), 1.0 - EDGE
    )
    return jnp.where(two, ends, jnp.where(one, jnp.sqrt((1.0 + away) ** 2 - 1.0), joints))


def _within(free: Float[Array, "n"], limits: Float[Array, "n 2"]) -> Float[Array, "n"]:
    """Joints within their limits: smooth, so that damped steps need not know of them."""
    low, high, one, two = _bounds(limits)
    both = 0.5 * (low + high) + 0.5 * (high - low) * jnp.sin(jnp.where(two, free, 0.0))
    away = jnp.sqrt(1.0 + jnp.where(one, free, 0.0) ** 2) - 1.0
    single = jnp.where(jnp.isfinite(limits[:, 0]), low + away, high - away)
    return jnp.where(two, both, jnp.where(one, single, free))


def _bounds(limits: Float[Array, "n 2"]) -> tuple[Array, Array, Array, Array]:
    """Bounds, +-1 where there is none, and which joints have one or two of them."""
    finite = jnp.isfinite(limits)
    low, high = jnp.where(finite, limits, jnp.array([[-1.0, 1.0]])).T
    return low, high, finite[:, 0] ^ finite[:, 1], finite.all(axis=1)
