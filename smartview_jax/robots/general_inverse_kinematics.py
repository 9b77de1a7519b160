"""Solve the inverse kinematics of any arm, and report why a pose has no solution."""

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float

from ..geometry import PoseLike, as_se3
from ..runtime.compilation import compiled_optimised
from .command import JointsLike
from .iterative_inverse_kinematics import solve_joints_iteratively
from .joint_solution import JointSolution, SolutionStatus
from .puma_inverse_kinematics import is_puma_like, nearest_solution
from .serial_arm import SerialArm

AT_LIMIT_FRACTION = 1e-3
"""Distance from a limit, as a fraction of the joint's range, that counts as at the limit.

For a joint without two limits it is in rad or m.
"""

MIN_SINGULAR_VALUE = 1e-6
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
    return (_closed_form_solution if is_puma_like(arm) else _iterative_solution)(arm, poses, near)


_closed_form_solution = compiled_optimised(nearest_solution)


@compiled_optimised
def _iterative_solution(arm: SerialArm, poses: SE3, near: JointsLike) -> JointSolution:
    """Return the solution that iteration from `near` finds, with its status."""
    joints, reached = solve_joints_iteratively(arm, poses, near)
    lower, upper = (jnp.broadcast_to(bound, joints.shape) for bound in arm.limits.T)
    span = jnp.where(jnp.isfinite(upper - lower), upper - lower, 1.0)
    # The iteration cannot say why it failed. A joint at its limit is blamed, unless the pose is
    # beyond the stretched-out arm, which no limit explains.
    at_limit = jnp.minimum(joints - lower, upper - joints) < AT_LIMIT_FRACTION * span
    violated = at_limit & ~reached[..., None]
    position = poses.translation()
    shoulder = jnp.broadcast_to(arm.base_from_first.translation(), position.shape)
    out_of_reach = jnp.linalg.norm(position - shoulder, axis=-1) > _max_reach(arm)
    limit_violated = violated.any(axis=-1) & ~out_of_reach
    failure = jnp.where(
        limit_violated, int(SolutionStatus.OUT_OF_LIMITS), int(SolutionStatus.OUT_OF_REACH)
    )
    singular = jnp.where(
        _min_singular_value(arm, joints) < MIN_SINGULAR_VALUE, int(SolutionStatus.SINGULAR), 0
    )
    return JointSolution(
        jnp.where(reached[..., None], joints, jnp.nan),
        jnp.where(reached, 0, failure) | singular,
        violated & limit_violated[..., None],
    )


def _max_reach(arm: SerialArm) -> Float[Array, ""]:
    """Return an upper bound of the distance from the first joint to the tool, m.

    No pose beyond it can be reached.
    """
    stroke = jnp.where(jnp.array(arm.prismatic), jnp.max(jnp.abs(arm.limits), axis=1), 0.0)
    # Joint k moves the next frame by at most hypot(a, |d| + stroke), whatever its angle.
    links = jnp.sum(jnp.hypot(arm.a, jnp.abs(arm.d) + stroke))
    return links + jnp.linalg.norm(arm.flange_from_tool.translation())


def _min_singular_value(
    arm: SerialArm, joints: Float[Array, "*views joints"]
) -> Float[Array, "*views"]:
    """Return the smallest singular value of the Jacobian, a measure of distance to a singularity.

    It is how far the tool moves in its worst direction per unit of joint motion.
    """
    jacobian = arm.jacobian
    for _ in joints.shape[:-1]:
        jacobian = jax.vmap(jacobian)
    # Only a flag depends on it, so that no gradient is needed.
    singular_values = jnp.linalg.svd(jax.lax.stop_gradient(jacobian(joints)), compute_uv=False)
    return singular_values[..., -1]
