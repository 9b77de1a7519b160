"""Solve inverse kinematics numerically, by Levenberg-Marquardt iteration from a start near by."""

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..compilation import optimised
from .command import JointsLike
from .serial_arm import SerialArm

STEPS = 100
"""Largest number of Levenberg-Marquardt steps per pose."""

ARRIVED = 1e-9
"""Largest component of the residual twist at which a pose counts as reached, m and rad."""

EDGE = 0.999
"""Largest distance of a start from the middle of a joint's range, per half of that range."""


@optimised
def joints_near(
    arm: SerialArm, base_from_tool: SE3, near: JointsLike
) -> tuple[Float[Array, "*views joints"], Bool[Array, "*views"]]:
    """Return joint angles near a start at which the tool of an arm has the wanted pose.

    The Levenberg-Marquardt damping keeps the solution of a redundant arm close to the start. For a
    pose out of reach the result is near the pose. Joints stay within their limits; a joint that its
    limit holds back ends at the limit.

    Args:
        arm: any serial arm.
        base_from_tool: wanted pose, `(*views)`.
        near: joint readings at which the iteration starts.

    Returns:
        Joint readings, and whether they reach the pose.
    """
    # Per pose, minimise |r|^2 over the joints q, with the residual twist
    #     r(q) = log(wanted^-1 base_from_tool(q)).
    # Each step solves the damped normal equations
    #     (J^T J + lambda I) step = -J^T r,    J = dr/dq,
    # and lambda adapts to whether the step reduced |r|^2. With J^T J singular, at a singularity or
    # for a redundant arm, the damping makes the step unique.
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
        # The iteration runs over unbounded coordinates, so that no step can leave the joint limits.
        # A pose out of reach is not an error here: the second result reports it.
        found = optx.least_squares(left_free, solver, first, max_steps=STEPS, throw=False).value
        found = _within(found, arm.limits)
        return found, jnp.max(jnp.abs(left(found))) < ARRIVED

    poses = base_from_tool.wxyz_xyz
    starts = jnp.broadcast_to(jnp.asarray(near, dtype=float), (*poses.shape[:-1], arm.size))
    # Every pose has its own damping and its own number of steps.
    for _ in poses.shape[:-1]:
        view = jax.vmap(view)
    return view(poses, starts)


def _free(joints: Float[Array, "n"], limits: Float[Array, "n 2"]) -> Float[Array, "n"]:
    """Return unbounded coordinates of joints within limits, the inverse of `_within`.

    Joints without limits are their own coordinates.
    """
    low, high, one, two = _bounds(limits)
    # With two limits q = middle + half_range sin(free), solved for `free`.
    ends = jnp.arcsin(jnp.clip((joints - 0.5 * (low + high)) / (0.5 * (high - low)), -EDGE, EDGE))
    # With one limit q = low + sqrt(1 + free^2) - 1. At a limit dq/dfree is zero, and the iteration
    # could never leave it; so it starts slightly inside.
    away = jnp.maximum(
        jnp.where(jnp.isfinite(limits[:, 0]), joints - low, high - joints), 1.0 - EDGE
    )
    return jnp.where(two, ends, jnp.where(one, jnp.sqrt((1.0 + away) ** 2 - 1.0), joints))


def _within(free: Float[Array, "n"], limits: Float[Array, "n 2"]) -> Float[Array, "n"]:
    """Return joints within their limits as a smooth function of unbounded coordinates.

    With two limits it is a sine, with one limit a hyperbola, without limits the identity.
    """
    low, high, one, two = _bounds(limits)
    both = 0.5 * (low + high) + 0.5 * (high - low) * jnp.sin(jnp.where(two, free, 0.0))
    away = jnp.sqrt(1.0 + jnp.where(one, free, 0.0) ** 2) - 1.0
    single = jnp.where(jnp.isfinite(limits[:, 0]), low + away, high - away)
    return jnp.where(two, both, jnp.where(one, single, free))


def _bounds(limits: Float[Array, "n 2"]) -> tuple[Array, Array, Array, Array]:
    """Return lower and upper bounds, and masks of the joints with one and with two finite limits.

    A bound that does not exist is replaced by -1 or 1, which keeps derivatives finite.
    """
    finite = jnp.isfinite(limits)
    low, high = jnp.where(finite, limits, jnp.array([[-1.0, 1.0]])).T
    return low, high, finite[:, 0] ^ finite[:, 1], finite.all(axis=1)
