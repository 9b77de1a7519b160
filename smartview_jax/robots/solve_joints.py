"""Solve the inverse kinematics of any arm, and report why a pose has no solution."""

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float

from ..compilation import optimised
from ..geometry import PoseLike, as_se3
from .command import JointsLike
from .inverse_kinematics import joints_near
from .joint_solution import JointSolution, Status
from .puma_inverse import is_puma_like, nearest_puma_joints
from .serial_arm import SerialArm

AT_LIMIT = 1e-3
"""Distance from a limit, as a fraction of the joint's range, that counts as at the limit.

For a joint without two limits it is in rad or m.
"""

DULL = 1e-6
"""Smallest singular value of the Jacobian (m and rad per rad) below which an arm is singular."""


def joints_for_pose(arm: SerialArm, base_from_tool: PoseLike, near: JointsLike) -> JointSolution:
    """Return joints, within their limits, that put the tool of an arm at wanted poses `(*views)`.

    A Puma-like arm is solved in closed form, and the solution closest to `near` is returned. Other
    arms, and arms inside jit, are solved by iteration from `near`, which finds at most one
    solution.

    Args:
        arm: any serial arm.
        base_from_tool: wanted poses.
        near: joint readings to be close to.
    """
    poses = as_se3(base_from_tool)
    return (_in_closed_form if is_puma_like(arm) else _by_iteration)(arm, poses, near)


_in_closed_form = optimised(nearest_puma_joints)


@optimised
def _by_iteration(arm: SerialArm, poses: SE3, near: JointsLike) -> JointSolution:
    """Return the solution that iteration from `near` finds, with its status."""
    joints, reached = joints_near(arm, poses, near)
    lower, upper = (jnp.broadcast_to(bound, joints.shape) for bound in arm.limits.T)
    span = jnp.where(jnp.isfinite(upper - lower), upper - lower, 1.0)
    # The iteration cannot say why it failed. A joint at its limit is blamed, unless the pose is
    # beyond the stretched-out arm, which no limit explains.
    at_limit = jnp.minimum(joints - lower, upper - joints) < AT_LIMIT * span
    beyond = at_limit & ~reached[..., None]
    place = poses.translation()
    shoulder = jnp.broadcast_to(arm.base_from_first.translation(), place.shape)
    far = jnp.linalg.norm(place - shoulder, axis=-1) > _length(arm)
    held = beyond.any(axis=-1) & ~far
    missed = jnp.where(held, int(Status.OUT_OF_LIMITS), int(Status.OUT_OF_REACH))
    singular = jnp.where(_sharpness(arm, joints) < DULL, int(Status.SINGULAR), 0)
    return JointSolution(
        jnp.where(reached[..., None], joints, jnp.nan),
        jnp.where(reached, 0, missed) | singular,
        beyond & held[..., None],
    )


def _length(arm: SerialArm) -> Float[Array, ""]:
    """Return an upper bound of the distance from the first joint to the tool, m.

    No pose beyond it can be reached.
    """
    slide = jnp.where(jnp.array(arm.prismatic), jnp.max(jnp.abs(arm.limits), axis=1), 0.0)
    links = jnp.sum(jnp.hypot(arm.a, jnp.abs(arm.d) + slide))
    return links + jnp.linalg.norm(arm.flange_from_tool.translation())


def _sharpness(arm: SerialArm, joints: Float[Array, "*views joints"]) -> Float[Array, "*views"]:
    """Return the smallest singular value of the Jacobian, a measure of distance to a singularity.

    It is how far the tool moves in its worst direction per unit of joint motion.
    """
    jacobian = arm.jacobian
    for _ in joints.shape[:-1]:
        jacobian = jax.vmap(jacobian)
    values = jnp.linalg.svd(jax.lax.stop_gradient(jacobian(joints)), compute_uv=False)
    return values[..., -1]
