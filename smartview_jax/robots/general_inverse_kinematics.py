"""Solve the inverse kinematics of any arm, and report why a pose has no solution."""

from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..geometry import PoseLike, as_se3, se3_left_jacobian
from ..runtime.compilation import compiled_optimised
from .command import JointsLike
from .joint_solution import JointSolution, SolutionStatus
from .puma_inverse_kinematics import is_puma_like, nearest_solution
from .serial_arm import SerialArm, pose_and_jacobian

AT_LIMIT_FRACTION = 1e-3
"""Distance from a limit, as a fraction of the joint's range, that counts as at the limit.

For a joint without two limits it is in rad or m.
"""

MIN_SINGULAR_VALUE = 1e-6
"""Smallest singular value of the Jacobian (m and rad per rad) below which an arm is singular."""

MAX_STEPS = 100
"""Largest number of Levenberg-Marquardt steps per pose."""

TWIST_TOLERANCE = 1e-9
"""Largest component of the residual twist at which a pose counts as reached, m and rad."""

MAX_INITIAL_RANGE_FRACTION = 0.999
"""Largest distance of a start from the middle of a joint's range, per half of that range."""


def joints_for_pose(arm: SerialArm, base_from_tool: PoseLike, near: JointsLike) -> JointSolution:
    """Return joints, within their limits, that put the tool of an arm at wanted poses `(*views)`.

    A Puma-like arm is solved in closed form, and the solution closest to `near` is returned. Other
    arms, and arms inside jit, are solved by iteration from `near`, which finds at most one
    solution.

    Args:
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


@compiled_optimised
def solve_joints_iteratively(
    arm: SerialArm, base_from_tool: SE3, near: JointsLike
) -> tuple[Float[Array, "*views joints"], Bool[Array, "*views"]]:
    """Return joint angles near a start at which the tool of an arm has the wanted pose.

    The Levenberg-Marquardt damping keeps the solution of a redundant arm close to the start. For a
    pose out of reach the result is near the pose. Joints stay within their limits; a joint that its
    limit holds back ends at the limit.

    Args:
        base_from_tool: wanted pose, `(*views)`.
        near: joint readings at which the iteration starts.

    Returns:
        Joint readings, and whether they reach the pose.
    """
    # Imported here, because most commands know no arm.
    import optimistix as optx

    # Per pose, minimise |r|^2 over the joints q, with the residual twist
    #     r(q) = log(wanted^-1 base_from_tool(q)).
    # Each step solves the damped normal equations
    #     (J^T J + lambda I) step = -J^T r,    J = dr/dq,
    # and lambda adapts to whether the step reduced |r|^2. With J^T J singular, at a singularity or
    # for a redundant arm, the damping makes the step unique.
    solver = optx.LevenbergMarquardt(rtol=1e-12, atol=1e-12)

    def solve_view(
        pose: Float[Array, "7"], start: Float[Array, "joints"]
    ) -> tuple[Float[Array, "joints"], Bool[Array, ""]]:
        # The iteration runs over unbounded coordinates, so that no step can leave the joint limits.
        # A pose out of reach is not an error here: the second result reports it.
        unbounded = optx.least_squares(
            lambda x, _: _residual(arm, pose, x),
            solver,
            _unbounded_from_joints(start, arm.limits),
            max_steps=MAX_STEPS,
            throw=False,
        ).value
        is_reached = jnp.max(jnp.abs(_residual(arm, pose, unbounded))) < TWIST_TOLERANCE
        return _joints_from_unbounded(unbounded, arm.limits), is_reached

    poses = base_from_tool.wxyz_xyz
    starts = jnp.broadcast_to(jnp.asarray(near, dtype=float), (*poses.shape[:-1], arm.joint_count))
    # Every pose has its own damping and its own number of steps.
    for _ in poses.shape[:-1]:
        solve_view = jax.vmap(solve_view)
    return solve_view(poses, starts)


@jax.custom_jvp
def _residual(
    arm: SerialArm, pose: Float[Array, "7"], unbounded: Float[Array, "n"]
) -> Float[Array, "6"]:
    """Return the residual twist, whose derivative is the geometric Jacobian.

    A program of the iteration is a quarter of the size that it has with the chain differentiated.
    """
    return _residual_and_jacobian(arm, pose, unbounded)[0]


def _residual_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    """Differentiate the residual: by the chain only where arm or pose change, too."""
    residual, jacobian = _residual_and_jacobian(*primals)
    change = jnp.zeros_like(residual)
    if not _is_zero(tangents[2]):
        change += jacobian @ tangents[2]
    if not all(map(_is_zero, jax.tree.leaves(tangents[:2], is_leaf=_is_zero))):
        arm_and_pose = jax.tree.map(
            lambda x: jnp.zeros(x.shape, x.dtype) if _is_zero(x) else x,
            tangents[:2],
            is_leaf=_is_zero,
        )
        change += jax.jvp(
            lambda arm, pose: _residual_and_jacobian(arm, pose, primals[2])[0],
            primals[:2],
            arm_and_pose,
        )[1]
    return residual, change


def _is_zero(tangent: Any) -> bool:
    """Return whether a tangent is known to be zero."""
    return isinstance(tangent, SymbolicZero)


_residual.defjvp(_residual_jvp, symbolic_zeros=True)


def _residual_and_jacobian(
    arm: SerialArm, pose: Float[Array, "7"], unbounded: Float[Array, "n"]
) -> tuple[Float[Array, "6"], Float[Array, "6 n"]]:
    """Return the residual twist and its Jacobian with respect to the unbounded coordinates."""
    joints, slopes = jax.jvp(
        lambda x: _joints_from_unbounded(x, arm.limits), (unbounded,), (jnp.ones_like(unbounded),)
    )
    tool, tool_twists = pose_and_jacobian(arm, joints)
    residual = (SE3(pose).inverse() @ tool).log()
    # With J_l the left Jacobian of exp, log(exp(r) exp(twist)) = r + J_l(-r)^-1 twist + ...
    jacobian = jnp.linalg.solve(se3_left_jacobian(-residual), tool_twists)
    return residual, jacobian * slopes[None]


def _unbounded_from_joints(
    joints: Float[Array, "n"], limits: Float[Array, "n 2"]
) -> Float[Array, "n"]:
    """Return unbounded coordinates of joints within limits.

    It is the inverse of `_joints_from_unbounded`; joints without limits are their own coordinates.
    """
    lower, upper, one_sided, two_sided = _finite_bounds(limits)
    # With two limits q = middle + half_range sin(x), solved for the unbounded coordinate x.
    two_sided_coordinates = jnp.arcsin(
        jnp.clip(
            (joints - 0.5 * (lower + upper)) / (0.5 * (upper - lower)),
            -MAX_INITIAL_RANGE_FRACTION,
            MAX_INITIAL_RANGE_FRACTION,
        )
    )
    # With one limit q = lower + distance, or upper - distance, with distance = sqrt(1 + x^2) - 1.
    # At a limit dq/dx is zero, and the iteration could never leave it: it starts slightly inside.
    distance = jnp.maximum(
        jnp.where(jnp.isfinite(limits[:, 0]), joints - lower, upper - joints),
        1.0 - MAX_INITIAL_RANGE_FRACTION,
    )
    return jnp.where(
        two_sided,
        two_sided_coordinates,
        jnp.where(one_sided, jnp.sqrt((1.0 + distance) ** 2 - 1.0), joints),
    )


def _joints_from_unbounded(
    unbounded: Float[Array, "n"], limits: Float[Array, "n 2"]
) -> Float[Array, "n"]:
    """Return joints within their limits as a smooth function of unbounded coordinates.

    With two limits it is a sine, with one limit a hyperbola, without limits the identity.
    """
    lower, upper, one_sided, two_sided = _finite_bounds(limits)
    two_sided_joints = 0.5 * (lower + upper) + 0.5 * (upper - lower) * jnp.sin(
        jnp.where(two_sided, unbounded, 0.0)
    )
    distance = jnp.sqrt(1.0 + jnp.where(one_sided, unbounded, 0.0) ** 2) - 1.0
    one_sided_joints = jnp.where(jnp.isfinite(limits[:, 0]), lower + distance, upper - distance)
    return jnp.where(two_sided, two_sided_joints, jnp.where(one_sided, one_sided_joints, unbounded))


def _finite_bounds(limits: Float[Array, "n 2"]) -> tuple[Array, Array, Array, Array]:
    """Return lower and upper bounds, and masks of the joints with one and with two finite limits.

    A bound that does not exist is replaced by -1 or 1, which keeps derivatives finite.
    """
    finite = jnp.isfinite(limits)
    lower, upper = jnp.where(finite, limits, jnp.array([[-1.0, 1.0]])).T
    return lower, upper, finite[:, 0] ^ finite[:, 1], finite.all(axis=1)
