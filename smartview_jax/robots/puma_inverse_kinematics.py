"""Solve the inverse kinematics of Puma-like arms in closed form, with all eight solutions.

An arm is Puma-like when its standard Denavit-Hartenberg parameters are, from joint 1 to 6,

    alpha   +-90     0   +-90   +-90   +-90   any    degrees
    a         a1    a2     a3      0      0    a6
    d         d1    d2     d3     d4      0    d6

The last three axes then intersect in one point, the wrist centre, which the last three joints do
not move, and joints 2 and 3 move it in a plane. Signs and lengths are arbitrary, and most may be
zero: both models of the PUMA 560 and most industrial six-axis arms have this structure.

Source: Paul and Zhang, Computationally efficient kinematics for manipulators with spherical wrists,
IJRR 5(2), 1986, for the order of the steps; the formulae are derived here for any signs.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxlie import SE3, SO3
from jaxtyping import Array, Bool, Float, Int

from ..geometry import PoseLike, as_se3
from ..runtime.compilation import one_program
from .command import JointsLike
from .joint_solution import LIMIT_TOLERANCE, JointSolution, SolutionStatus, wrap_to_limits
from .serial_arm import SerialArm

BRANCHES = tuple(
    (shoulder, elbow, wrist) for shoulder in (1, -1) for elbow in (1, -1) for wrist in (1, -1)
)
"""Signs of the eight solutions: shoulder, elbow and wrist.

The shoulder's sign is the side of the first axis on which the wrist centre lies; the elbow's and
the wrist's are the signs of their bend.
"""

SINGULARITY_TOLERANCE = 1e-9
"""Distance to a singularity, m or rad, below which a pose is treated as singular."""

_STRUCTURE_MESSAGE = (
    "a Puma-like arm has six revolute joints, standard Denavit-Hartenberg parameters, "
    "alpha = +-90, 0, +-90, +-90, +-90 degrees, a4 = a5 = d5 = 0, a2 not 0, "
    "and a3 and d4 not both 0"
)


def is_puma_like(arm: SerialArm) -> bool:
    """Return whether `puma_joints` can solve for an arm.

    Inside jit it is False, because the values of the arm's parameters are not available there.
    """
    is_traced = any(isinstance(row, Tracer) for row in (arm.a, arm.d, arm.alpha))
    return (
        _is_standard_six_revolute(arm)
        and not is_traced
        and bool(_structure_deviation(arm) <= SINGULARITY_TOLERANCE)
    )


def puma_joints(arm: SerialArm, base_from_tool: PoseLike) -> JointSolution:
    """Return all eight inverse-kinematics solutions of wanted poses, in the order of `BRANCHES`.

    Angles are shifted by whole revolutions into the joint limits where possible. At a singularity,
    joint 4 (wrist) or joint 1 or 2 (shoulder) is arbitrary; it is set to zero there, and solutions
    coincide. The result is differentiable where a solution exists and is not singular.

    Args:
        base_from_tool: wanted poses, `(*views)`.

    Returns:
        Joints `(*views, 8, 6)`; NaN where a branch does not reach.

    Raises:
        ValueError: the arm is not Puma-like; inside jit an error at run time.
    """
    poses = _checked_poses(arm, base_from_tool)
    return _all_solutions(arm, poses, jnp.zeros((*poses.get_batch_axes(), 6)))


@one_program
def _all_solutions(
    arm: SerialArm, base_from_tool: SE3, near: Float[Array, "*views 6"]
) -> JointSolution:
    """Return all eight solutions; that the arm is Puma-like is not checked.

    A joint that is arbitrary at a singularity keeps its reading in `near`.
    """
    signs = jnp.array(BRANCHES, dtype=float)

    def solve(pose: Array, near: Array, sign: Array) -> tuple[Array, Array, Array]:
        return _solve_branch(arm, SE3(pose), sign, arm.theta + near)

    solve = jax.vmap(solve, in_axes=(None, None, 0))
    for _ in base_from_tool.get_batch_axes():
        solve = jax.vmap(solve, in_axes=(0, 0, None))
    angles, reached, singular = solve(base_from_tool.wxyz_xyz, near, signs)
    joints = wrap_to_limits(arm, angles - jnp.broadcast_to(arm.theta, angles.shape))
    violated_limits = arm.violated_limits(joints, LIMIT_TOLERANCE) & reached[..., None]
    return JointSolution(
        jnp.where(reached[..., None], joints, jnp.nan),
        _status_flags(reached, singular, violated_limits),
        violated_limits,
    )


def _checked_poses(arm: SerialArm, base_from_tool: PoseLike) -> SE3:
    """Return the poses if the arm is Puma-like; otherwise raise, inside jit at run time."""
    if not _is_standard_six_revolute(arm):
        raise ValueError(_STRUCTURE_MESSAGE)
    deviation, poses = _structure_deviation(arm), as_se3(base_from_tool)
    # A program that may raise calls Python, and so cannot be kept for later processes.
    if isinstance(deviation, Tracer):
        refused = deviation > SINGULARITY_TOLERANCE
        return SE3(eqx.error_if(poses.wxyz_xyz, refused, _STRUCTURE_MESSAGE))
    if not deviation <= SINGULARITY_TOLERANCE:
        raise ValueError(f"{_STRUCTURE_MESSAGE}; found alpha {arm.alpha}, a {arm.a}, d {arm.d}")
    return poses


def branch_joints(
    arm: SerialArm, base_from_tool: SE3, signs: Float[Array, "3"]
) -> Float[Array, "*views 6"]:
    """Return one solution of `puma_joints` for any pose, without regard to joint limits.

    Angles are not shifted by whole revolutions. For a pose out of reach the arm is stretched out,
    or folded, towards the pose, and the orientation of the hand is still the wanted one.

    Args:
        arm: a Puma-like arm; this is not checked.
        base_from_tool: wanted poses, `(*views)`.
        signs: one of `BRANCHES`.
    """

    def solve(pose: Float[Array, "7"]) -> Float[Array, "6"]:
        return _solve_branch(arm, SE3(pose), signs, arm.theta)[0] - arm.theta

    poses = base_from_tool.wxyz_xyz
    for _ in poses.shape[:-1]:
        solve = jax.vmap(solve)
    return solve(poses)


def nearest_puma_joints(
    arm: SerialArm, base_from_tool: PoseLike, near: JointsLike
) -> JointSolution:
    """Return the solution closest to given joints, `(*views, 6)`.

    Solutions within the joint limits are preferred. Closeness is the sum of squared joint
    differences. A joint whose range exceeds one revolution uses the revolution that is closest. A
    joint that is arbitrary at a singularity of wrist or shoulder keeps its reading in `near`.
    """
    return nearest_solution(arm, _checked_poses(arm, base_from_tool), near)


@one_program
def nearest_solution(arm: SerialArm, base_from_tool: SE3, near: JointsLike) -> JointSolution:
    """Return what `nearest_puma_joints` does; that the arm is Puma-like is not checked."""
    views = base_from_tool.get_batch_axes()
    near = jnp.broadcast_to(jnp.asarray(near, dtype=float), (*views, 6))
    solutions = _all_solutions(arm, base_from_tool, near)
    near = jnp.broadcast_to(near[..., None, :], solutions.joints.shape)
    joints = wrap_to_limits(arm, solutions.joints, near)
    distance = jnp.sum((joints - near) ** 2, axis=-1)
    # The penalty exceeds any distance between joints: a solution beyond the limits is selected only
    # if no solution is within them, and a branch that does not reach (NaN) only if none does.
    distance = jnp.where(solutions.is_solved, distance, 1e12 + distance)
    distance = jnp.where(jnp.isnan(distance), jnp.inf, distance)
    # The selection is piecewise constant, so no gradient flows through it.
    best = jnp.argmin(jax.lax.stop_gradient(distance), axis=-1, keepdims=True)
    return JointSolution(
        jnp.take_along_axis(joints, best[..., None], axis=-2)[..., 0, :],
        jnp.take_along_axis(solutions.status, best, axis=-1)[..., 0],
        jnp.take_along_axis(solutions.violated_limits, best[..., None], axis=-2)[..., 0, :],
    )


def _is_standard_six_revolute(arm: SerialArm) -> bool:
    """Return whether an arm has six revolute joints in the standard convention."""
    return arm.convention == "standard" and arm.joint_count == 6 and not any(arm.prismatic)


@one_program
def _structure_deviation(arm: SerialArm) -> Float[Array, ""]:
    """Return the deviation of an arm's parameters from a Puma-like arm, m or rad.

    It is infinite where the closed form would divide by zero (a2 = 0, or a3 = d4 = 0), and for
    alpha2 near 180 degrees.
    """
    right_angle_twists = np.array([0, 2, 3, 4])
    deviations = [
        jnp.cos(arm.alpha[right_angle_twists]),
        jnp.sin(arm.alpha[1])[None],
        arm.a[3:5],
        arm.d[4:5],
    ]
    deviation = jnp.max(jnp.abs(jnp.concatenate(deviations)))
    is_degenerate = (jnp.cos(arm.alpha[1]) < 0.0) | (arm.a[1] == 0.0)
    return jnp.where(is_degenerate | ((arm.a[2] == 0.0) & (arm.d[3] == 0.0)), jnp.inf, deviation)


def _solve_branch(
    arm: SerialArm,
    base_from_tool: SE3,
    signs: Float[Array, "3"],
    near: Float[Array, "6"],
) -> tuple[Float[Array, "6"], Bool[Array, ""], Bool[Array, "3"]]:
    """Return the angles `reading + theta` of one branch, whether it reaches, and its singularities.

    The three singularity flags are for shoulder, elbow and wrist. An angle that is arbitrary at a
    singularity is taken from `near`.
    """
    first_from_flange = (
        arm.base_from_first.inverse() @ base_from_tool @ arm.flange_from_tool.inverse()
    )
    first_from_wrist = first_from_flange @ _wrist_from_flange(arm).inverse()
    (t1, t2, t3), clearances = _arm_angles(arm, first_from_wrist.translation(), signs, near)
    forearm_rotation = SO3.from_z_radians(t1) @ SO3.from_x_radians(arm.alpha[0])
    forearm_rotation = (
        forearm_rotation @ SO3.from_z_radians(t2 + t3) @ SO3.from_x_radians(arm.alpha[2])
    )
    rotation = (forearm_rotation.inverse() @ first_from_wrist.rotation()).as_matrix()
    (t4, t5, t6), wrist_singular = _wrist_angles(arm, rotation, signs[2], near[3])
    reached = (clearances > -SINGULARITY_TOLERANCE).all()
    singular = jnp.append(clearances < SINGULARITY_TOLERANCE, wrist_singular)
    return jnp.stack([t1, t2, t3, t4, t5, t6]), reached, singular


def _arm_angles(
    arm: SerialArm,
    wrist: Float[Array, "3"],
    signs: Float[Array, "3"],
    near: Float[Array, "6"],
) -> tuple[tuple[Float[Array, ""], ...], Float[Array, "2"]]:
    """Return the angles of joints 1 to 3, which put the wrist's centre at a place.

    Both clearances, of shoulder and elbow, measure the distance to the boundary of the workspace,
    m: negative outside, near zero at a singularity.
    """
    # s_k = sin(alpha_k) is +1 or -1 where the twist is +-90 degrees; t_k is the angle of joint k.
    s = jnp.sin(arm.alpha)
    x, y, z = wrist

    # The wrist's centre is Rz(t1) (a1 + reach_x, -s1 shoulder_offset, d1 + s1 reach_y).
    shoulder_offset = arm.d[1] + arm.d[2]
    # The horizontal part (x, y) = Rz(t1) (forward, -s1 offset) has two solutions for t1:
    #     forward = +-sqrt(x^2 + y^2 - offset^2),  t1 = atan2(y, x) - atan2(-s1 offset, forward)
    # The square is factored, (r - |offset|) (r + |offset|) with r = axis_distance, to keep its
    # digits near the singularity.
    axis_distance = jnp.sqrt(_floored_square(x**2 + y**2))
    shoulder_clearance = axis_distance - jnp.abs(shoulder_offset)
    forward_distance = signs[0] * jnp.sqrt(
        _floored_square(shoulder_clearance * (axis_distance + jnp.abs(shoulder_offset)))
    )
    t1 = _atan2_or(y, x, near[0]) - _atan2_or(-s[0] * shoulder_offset, forward_distance, 0.0)
    reach_x, reach_y = forward_distance - arm.a[0], s[0] * (z - arm.d[0])

    # Two links in a plane: a2, and from there (a3, -s3 d4), of length `forearm_length`.
    upper_arm_length, forearm_length = arm.a[1], jnp.sqrt(arm.a[2] ** 2 + arm.d[3] ** 2)
    # Law of cosines for the elbow's bend, with the sine from Heron's product, which keeps its
    # digits near a stretched or a folded arm:
    #     cos(bend) = (|reach|^2 - upper^2 - fore^2) / (2 upper fore)
    #     sin(bend)^2 = ((upper + fore)^2 - |reach|^2) (|reach|^2 - (upper - fore)^2)
    #                   / (2 upper fore)^2
    # with upper = upper_arm_length and fore = forearm_length; the factors are outer and inner gap.
    reach_squared = reach_x**2 + reach_y**2
    outer_gap = (upper_arm_length + forearm_length) ** 2 - reach_squared
    inner_gap = reach_squared - (upper_arm_length - forearm_length) ** 2
    sine = (
        jnp.sqrt(_floored_square(outer_gap))
        * jnp.sqrt(_floored_square(inner_gap))
        / (2.0 * upper_arm_length * forearm_length)
    )
    cosine = (reach_squared - upper_arm_length**2 - forearm_length**2) / (
        2.0 * upper_arm_length * forearm_length
    )
    bend = _atan2_or(signs[1] * sine, cosine, 0.0)
    t3 = bend - jnp.arctan2(-s[2] * arm.d[3], arm.a[2])
    # t2 = atan2(reach_y, reach_x) - atan2(fore sin(bend), upper + fore cos(bend))
    wrist_angle = jnp.arctan2(
        forearm_length * jnp.sin(bend), upper_arm_length + forearm_length * jnp.cos(bend)
    )
    t2 = _atan2_or(reach_y, reach_x, near[1] + wrist_angle) - wrist_angle
    arm_length = jnp.abs(upper_arm_length) + forearm_length
    # A gap is in m^2, hence the division.
    elbow_clearance = jnp.minimum(outer_gap, inner_gap) / arm_length
    return (t1, t2, t3), jnp.stack([shoulder_clearance, elbow_clearance])


def _wrist_angles(
    arm: SerialArm,
    rotation: Float[Array, "3 3"],
    sign: Float[Array, ""],
    near: Float[Array, ""],
) -> tuple[tuple[Float[Array, ""], ...], Bool[Array, ""]]:
    """Return the angles of joints 4 to 6, and whether the wrist is singular.

    The rotation is of the hand to the forearm; joint 4 is at `near` where it is arbitrary.
    """
    # The rotation is W = Rz(t4) Ry(-s4 t5) Rz(u) with u = -s4 s5 t6, followed by a rotation by 180
    # degrees about x if s4 = s5. That rotation is removed by `flip`.
    s = jnp.sin(arm.alpha)
    sign_product = s[3] * s[4]
    flip = jnp.stack([jnp.ones(()), -sign_product, -sign_product])
    W = rotation * flip[None]
    # The third column of W is (cos t4 sin b, sin t4 sin b, cos b), with b = -s4 t5. It gives t4 and
    # t5; for b = 0 only t4 + u is determined, and t4 is arbitrary.
    wrist_sine = jnp.sqrt(_floored_square(W[0, 2] ** 2 + W[1, 2] ** 2))
    wrist_singular = wrist_sine < SINGULARITY_TOLERANCE
    t4 = jnp.where(wrist_singular, near, _atan2_or(sign * W[1, 2], sign * W[0, 2], near))
    sin4, cos4 = jnp.sin(t4), jnp.cos(t4)
    t5 = -s[3] * jnp.arctan2(cos4 * W[0, 2] + sin4 * W[1, 2], W[2, 2])
    # The second row of Rz(-t4) W is (sin u, cos u, 0): it determines t6 for any t5, even zero.
    t6 = -sign_product * jnp.arctan2(
        cos4 * W[1, 0] - sin4 * W[0, 0], cos4 * W[1, 1] - sin4 * W[0, 1]
    )
    return (t4, t5, t6), wrist_singular


def _wrist_from_flange(arm: SerialArm) -> SE3:
    """Return the fixed transform from the wrist centre, after joint 6, to the flange.

    It includes `d6`, because joint 6 rotates about the axis along which `d6` extends.
    """
    zero = jnp.zeros_like(arm.a[5])
    translation = SE3.from_translation(jnp.stack([arm.a[5], zero, arm.d[5]]))
    return translation @ SE3.from_rotation(SO3.from_x_radians(arm.alpha[5]))


def _floored_square(square: Float[Array, ""]) -> Float[Array, ""]:
    """Return the argument of a square root, bounded below by 1e-200 for a finite derivative."""
    return jnp.maximum(square, 1e-200)


def _atan2_or(
    y: Float[Array, ""], x: Float[Array, ""], default: Float[Array, ""] | float
) -> Float[Array, ""]:
    """Return the angle of the vector (x, y), or another value where the vector is zero."""
    is_zero = (jnp.abs(x) < SINGULARITY_TOLERANCE) & (jnp.abs(y) < SINGULARITY_TOLERANCE)
    # Both arguments are replaced before atan2, since its derivative at (0, 0) is NaN, which a
    # selection afterwards would not remove.
    angle = jnp.arctan2(jnp.where(is_zero, 0.0, y), jnp.where(is_zero, 1.0, x))
    return jnp.where(is_zero, default, angle)


def _status_flags(
    reached: Bool[Array, "*b"], singular: Bool[Array, "*b 3"], violated_limits: Bool[Array, "*b 6"]
) -> Int[Array, "*b"]:
    """Return the `SolutionStatus` flags of solutions."""
    singular_flags = (
        SolutionStatus.SHOULDER_SINGULAR,
        SolutionStatus.ELBOW_SINGULAR,
        SolutionStatus.WRIST_SINGULAR,
    )
    status = jnp.where(reached, 0, int(SolutionStatus.OUT_OF_REACH))
    status = status | jnp.where(violated_limits.any(axis=-1), int(SolutionStatus.OUT_OF_LIMITS), 0)
    for k, flag in enumerate(singular_flags):
        status = status | jnp.where(singular[..., k] & reached, int(flag), 0)
    return status
