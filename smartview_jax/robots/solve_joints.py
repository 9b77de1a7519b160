"""Joints for a pose of the tool, of any arm, and in words why there are none."""

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
"""Share of its range within which a joint that did not arrive counts as held up by its limit."""

DULL = 1e-6
"""Least singular value of the Jacobian, m and rad a rad, of an arm that is not singular."""


def joints_for_pose(arm: SerialArm, base_from_tool: PoseLike, near: JointsLike) -> JointSolution:
    """Joints that put an arm's tool at wanted poses, `(*views)`, within their limits.

    A Puma-like arm is solved in closed form: of all its answers the one nearest `near`. Others, and
    arms whose numbers jit hides, by iteration from there, which finds one answer at most.

    Args:
        arm: any.
        base_from_tool: wanted.
        near: joints to be near to.
    """
    poses = as_se3(base_from_tool)
    return (_in_closed_form if is_puma_like(arm) else _by_iteration)(arm, poses, near)


_in_closed_form = optimised(nearest_puma_joints)


@optimised
def _by_iteration(arm: SerialArm, poses: SE3, near: JointsLike) -> JointSolution:
    joints, reached = joints_near(arm, poses, near)
    lower, upper = (jnp.broadcast_to(bound, joints.shape) for bound in arm.limits.T)
    span = jnp.where(jnp.isfinite(upper - lower), upper - lower, 1.0)
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
    """How far the tool can be from the first joint, stretched out: no pose beyond is reached."""
    slide = jnp.where(jnp.array(arm.prismatic), jnp.max(jnp.abs(arm.limits), axis=1), 0.0)
    links = jnp.sum(jnp.hypot(arm.a, jnp.abs(arm.d) + slide))
    return links + jnp.linalg.norm(arm.flange_from_tool.translation())


def _sharpness(arm: SerialArm, joints: Float[Array, "*views joints"]) -> Float[Array, "*views"]:
    """Least singular value of the Jacobian: how far the tool moves in its worst direction."""
    jacobian = arm.jacobian
    for _ in joints.shape[:-1]:
        jacobian = jax.vmap(jacobian)
    values = jnp.linalg.svd(jax.lax.stop_gradient(jacobian(joints)), compute_uv=False)
    return values[..., -1]
