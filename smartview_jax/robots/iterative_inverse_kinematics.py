"""Solve inverse kinematics numerically, by Levenberg-Marquardt iteration from a start near by.

Per pose, |r|^2 is minimised over the joints q, with the residual twist

    r(q) = log(wanted^-1 base_from_tool(q)).

Each step solves the damped normal equations

    (J^T J + I / radius) step = -J^T r,    J = dr/dq,

and the radius adapts to how well they predicted the change of |r|^2. With J^T J singular, at a
singularity or for a redundant arm, the damping makes the step unique. The iteration is written
here, with the geometric Jacobian: a general solver, which differentiates the chain, makes a program
five times the size, and one is compiled for every number of poses.

Source of the rule for the radius: Gould, Orban, Sartenaer and Toint, Sensitivity of trust-region
algorithms to their parameters, 2005.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from ..compilation import compiled_optimised
from ..geometry import se3_left_jacobian
from .command import JointsLike
from .serial_arm import SerialArm, pose_and_jacobian

MAX_STEPS = 100
"""Largest number of Levenberg-Marquardt steps per pose."""

TWIST_TOLERANCE = 1e-9
"""Largest component of the residual twist at which a pose counts as reached, m and rad."""

STEP_TOLERANCE = 1e-12
"""Largest change, absolute and relative, of joints and residual in the last step of all."""

MIN_REDUCTION, GOOD_REDUCTION = 0.01, 0.99
"""Smallest reduction of |r|^2, per predicted reduction, for a step to be taken, and to be good."""

GROWTH, SHRINKAGE = 3.5, 0.25
"""Factors of the radius after a good step, and after a step that is not taken."""

MAX_INITIAL_RANGE_FRACTION = 0.999
"""Largest distance of a start from the middle of a joint's range, per half of that range."""


@compiled_optimised
def solve_joints_iteratively(
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

    def solve_view(
        pose: Float[Array, "7"], start: Float[Array, "joints"]
    ) -> tuple[Float[Array, "joints"], Bool[Array, ""]]:
        # The iteration runs over unbounded coordinates, so that no step can leave the joint limits.
        unbounded, miss = _nearest(arm, pose, _unbounded_from_joints(start, arm.limits))
        return _joints_from_unbounded(unbounded, arm.limits), miss < TWIST_TOLERANCE

    poses = base_from_tool.wxyz_xyz
    starts = jnp.broadcast_to(jnp.asarray(near, dtype=float), (*poses.shape[:-1], arm.joint_count))
    # Every pose has its own damping and its own number of steps.
    for _ in poses.shape[:-1]:
        solve_view = jax.vmap(solve_view)
    return solve_view(poses, starts)


class _Iteration(NamedTuple):
    """State of one pose's iteration: where it is, what is known there, and what is tried next."""

    unbounded: Float[Array, "n"]
    residual: Float[Array, "6"]
    jacobian: Float[Array, "6 n"]
    cost: Float[Array, ""]
    step: Float[Array, "n"]
    predicted_change: Float[Array, ""]
    radius: Float[Array, ""]
    steps: Int[Array, ""]
    is_done: Bool[Array, ""]


@jax.custom_jvp
def _nearest(
    arm: SerialArm, pose: Float[Array, "7"], start: Float[Array, "n"]
) -> tuple[Float[Array, "n"], Float[Array, ""]]:
    """Return the unbounded coordinates near a start that minimise |r|^2, and the largest |r_k|."""

    def step(last: _Iteration) -> _Iteration:
        trial = last.unbounded + last.step
        residual, jacobian = _residual_and_jacobian(arm, pose, trial)
        cost = 0.5 * residual @ residual
        is_taken = cost - last.cost <= MIN_REDUCTION * last.predicted_change
        is_good = (cost - last.cost < GOOD_REDUCTION * last.predicted_change) & (
            last.predicted_change < 0.0
        )
        radius = last.radius * jnp.where(is_taken, jnp.where(is_good, GROWTH, 1.0), SHRINKAGE)
        is_converged = (
            is_taken & _is_close(trial, last.unbounded) & _is_close(residual, last.residual)
        )
        unbounded, residual, jacobian, kept_cost = (
            jnp.where(is_taken, new, old)
            for new, old in zip((trial, residual, jacobian, cost), last[:4], strict=True)
        )
        next_step = _damped_step(residual, jacobian, radius)
        change = jacobian @ next_step
        return _Iteration(
            unbounded,
            residual,
            jacobian,
            kept_cost,
            next_step,
            residual @ change + 0.5 * change @ change,
            radius,
            last.steps + 1,
            # No iteration helps a pose that is not finite.
            is_converged | ~jnp.isfinite(cost),
        )

    # Nothing is known yet: whatever the start's cost, it is less.
    zeros = jnp.zeros_like(start)
    first = _Iteration(
        start,
        jnp.zeros(6),
        jnp.zeros((6, len(start))),
        jnp.array(jnp.inf),
        zeros,
        jnp.array(0.0),
        jnp.array(1.0),
        jnp.array(0),
        jnp.array(False),
    )
    last = jax.lax.while_loop(lambda x: (x.steps < MAX_STEPS) & ~x.is_done, step, first)
    # A start whose cost is infinite or NaN was never taken.
    miss = jnp.where(jnp.isfinite(last.cost), jnp.max(jnp.abs(last.residual)), jnp.inf)
    return last.unbounded, miss


@_nearest.defjvp
def _nearest_jvp(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    """Differentiate the minimum by the implicit function theorem: its gradient J^T r stays zero."""
    arm, pose, _ = primals
    minimum, miss = _nearest(*primals)

    def gradient(
        arm: SerialArm, pose: Float[Array, "7"], unbounded: Float[Array, "n"]
    ) -> Float[Array, "n"]:
        residual, jacobian = _residual_and_jacobian(arm, pose, unbounded)
        return residual @ jacobian

    hessian = jax.jacfwd(gradient, 2)(arm, pose, minimum)
    _, gradient_change = jax.jvp(
        lambda arm, pose: gradient(arm, pose, minimum), primals[:2], tangents[:2]
    )
    change = jax.scipy.linalg.solve(hessian, -gradient_change, assume_a="pos")
    # Only whether the pose is reached depends on the miss.
    return (minimum, miss), (change, jnp.zeros_like(miss))


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


def _damped_step(
    residual: Float[Array, "6"], jacobian: Float[Array, "6 n"], radius: Float[Array, ""]
) -> Float[Array, "n"]:
    """Return the Levenberg-Marquardt step."""
    # It is the least-squares solution of [J; I / sqrt(radius)] step = [-r; 0].
    count = jacobian.shape[1]
    orthogonal, triangle = jnp.linalg.qr(
        jnp.concatenate([jacobian, jnp.eye(count) / jnp.sqrt(radius)])
    )
    return -jax.scipy.linalg.solve_triangular(triangle, residual @ orthogonal[:6])


def _is_close(new: Float[Array, "n"], old: Float[Array, "n"]) -> Bool[Array, ""]:
    """Return whether no component changed by more than the tolerance of a step."""
    return jnp.all(jnp.abs(new - old) < STEP_TOLERANCE * (1.0 + jnp.abs(new)))


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
