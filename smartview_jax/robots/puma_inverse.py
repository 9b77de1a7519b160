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
from .command import JointsLike
from .joint_solution import SLACK, JointSolution, Status, nearest_turn
from .serial_arm import SerialArm

BRANCHES = tuple(
    (shoulder, elbow, wrist) for shoulder in (1, -1) for elbow in (1, -1) for wrist in (1, -1)
)
"""Signs of the eight solutions: shoulder, elbow and wrist.

The shoulder's sign is the side of the first axis on which the wrist centre lies; the elbow's and
the wrist's are the signs of their bend.
"""

SINGULAR = 1e-9
"""Distance to a singularity, m or rad, below which a pose is treated as singular."""

_SHAPE = (
    "a Puma-like arm has six turning joints, standard numbers, alpha = +-90, 0, +-90, +-90, +-90 "
    "degrees, a4 = a5 = d5 = 0, a2 not 0, and a3 and d4 not both 0"
)


def is_puma_like(arm: SerialArm) -> bool:
    """Return whether `puma_joints` can solve for an arm.

    Inside jit it is False, because the values of the arm's parameters are not available there.
    """
    hidden = any(isinstance(number, Tracer) for number in (arm.a, arm.d, arm.alpha))
    return _has_structure(arm) and not hidden and bool(_misshape(arm) <= SINGULAR)


def puma_joints(arm: SerialArm, base_from_tool: PoseLike) -> JointSolution:
    """Return all eight inverse-kinematics solutions of wanted poses, in the order of `BRANCHES`.

    Angles are shifted by whole revolutions into the joint limits where possible. At a singularity,
    joint 4 (wrist) or joint 1 or 2 (shoulder) is arbitrary; it is set to zero there, and solutions
    coincide. The result is differentiable where a solution exists and is not singular.

    Args:
        arm: a Puma-like arm, as described in the module's docstring.
        base_from_tool: wanted poses, `(*views)`.

    Returns:
        Joints `(*views, 8, 6)`; NaN where a branch does not reach.

    Raises:
        ValueError: the arm is not Puma-like; inside jit an error at run time.
    """
    if not _has_structure(arm):
        raise ValueError(_SHAPE)
    wrong = _misshape(arm)
    if not isinstance(wrong, Tracer) and not wrong <= SINGULAR:
        raise ValueError(f"{_SHAPE}; found alpha {arm.alpha}, a {arm.a}, d {arm.d}")
    poses = as_se3(base_from_tool).wxyz_xyz
    poses = eqx.error_if(poses, wrong > SINGULAR, _SHAPE)
    signs = jnp.array(BRANCHES, dtype=float)
    solve = jax.vmap(lambda pose, sign: _branch(arm, SE3(pose), sign), in_axes=(None, 0))
    for _ in poses.shape[:-1]:
        solve = jax.vmap(solve, in_axes=(0, None))
    angles, reached, singular = solve(poses, signs)
    joints = nearest_turn(arm, angles - jnp.broadcast_to(arm.theta, angles.shape))
    beyond = arm.out_of_limits(joints, SLACK) & reached[..., None]
    return JointSolution(
        jnp.where(reached[..., None], joints, jnp.nan), _status(reached, singular, beyond), beyond
    )


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
        return _branch(arm, SE3(pose), signs)[0] - arm.theta

    poses = base_from_tool.wxyz_xyz
    for _ in poses.shape[:-1]:
        solve = jax.vmap(solve)
    return solve(poses)


def nearest_puma_joints(
    arm: SerialArm, base_from_tool: PoseLike, near: JointsLike
) -> JointSolution:
    """Return the solution closest to given joints, `(*views, 6)`.

    Solutions within the joint limits are preferred. Closeness is the sum of squared joint
    differences. A joint whose range exceeds one revolution uses the revolution that is closest.
    """
    found = puma_joints(arm, base_from_tool)
    shape = found.joints.shape
    near = jnp.broadcast_to(jnp.asarray(near, dtype=float), (*shape[:-2], 6))[..., None, :]
    near = jnp.broadcast_to(near, shape)
    joints = nearest_turn(arm, found.joints, near)
    far = jnp.sum((joints - near) ** 2, axis=-1)
    # The penalty exceeds any distance between joints: a solution beyond the limits is selected only
    # if no solution is within them, and a branch that does not reach (NaN) only if none does.
    far = jnp.where(found.reached, far, 1e12 + far)
    far = jnp.where(jnp.isnan(far), jnp.inf, far)
    # The selection is piecewise constant, so no gradient flows through it.
    best = jnp.argmin(jax.lax.stop_gradient(far), axis=-1, keepdims=True)
    return JointSolution(
        jnp.take_along_axis(joints, best[..., None], axis=-2)[..., 0, :],
        jnp.take_along_axis(found.status, best, axis=-1)[..., 0],
        jnp.take_along_axis(found.beyond, best[..., None], axis=-2)[..., 0, :],
    )


def _has_structure(arm: SerialArm) -> bool:
    """Return whether an arm has six revolute joints in the standard convention."""
    return arm.convention == "standard" and arm.size == 6 and not any(arm.prismatic)


def _misshape(arm: SerialArm) -> Float[Array, ""]:
    """Return how far the parameters of an arm are from a Puma-like arm, m or rad.

    It is infinite where the closed form would divide by zero (a2 = 0, or a3 = d4 = 0), and for
    alpha2 near 180 degrees.
    """
    right = np.array([0, 2, 3, 4])
    off = [jnp.cos(arm.alpha[right]), jnp.sin(arm.alpha[1])[None], arm.a[3:5], arm.d[4:5]]
    wrong = jnp.max(jnp.abs(jnp.concatenate(off)))
    turned = (jnp.cos(arm.alpha[1]) < 0.0) | (arm.a[1] == 0.0)
    return jnp.where(turned | ((arm.a[2] == 0.0) & (arm.d[3] == 0.0)), jnp.inf, wrong)


def _branch(
    arm: SerialArm, base_from_tool: SE3, sign: Float[Array, "3"]
) -> tuple[Float[Array, "6"], Bool[Array, ""], Bool[Array, "3"]]:
    """Return the angles `reading + theta` of one branch, whether it reaches, and its singularities.

    The three singularity flags are those of shoulder, elbow and wrist.
    """
    s = jnp.sin(arm.alpha)
    hand = arm.base_from_first.inverse() @ base_from_tool @ arm.flange_from_tool.inverse()
    hand = hand @ _last_link(arm).inverse()
    x, y, z = hand.translation()

    # The wrist's centre is Rz(t1) (a1 + reach_x, -s1 offset, d1 + s1 reach_y).
    offset = arm.d[1] + arm.d[2]
    # The horizontal part (x, y) = Rz(t1) (ahead, -s1 offset) has two solutions for t1:
    #     ahead = +-sqrt(x^2 + y^2 - offset^2),  t1 = atan2(y, x) - atan2(-s1 offset, ahead)
    # The square is factored, (r - |offset|) (r + |offset|), to keep its digits near the
    # singularity.
    from_axis = jnp.sqrt(_positive(x**2 + y**2))
    room = from_axis - jnp.abs(offset)
    ahead = sign[0] * jnp.sqrt(_positive(room * (from_axis + jnp.abs(offset))))
    t1 = _angle(y, x, arm.theta[0]) - _angle(-s[0] * offset, ahead, 0.0)
    reach_x, reach_y = ahead - arm.a[0], s[0] * (z - arm.d[0])

    # Two links in a plane: a2, and from there (a3, -s3 d4), of length `fore`.
    upper, fore = arm.a[1], jnp.sqrt(arm.a[2] ** 2 + arm.d[3] ** 2)
    # Law of cosines for the elbow's bend, with the sine from Heron's product, which keeps its
    # digits near a stretched or a folded arm:
    #     cos(bend) = (|reach|^2 - upper^2 - fore^2) / (2 upper fore)
    #     sin(bend)^2 = ((upper + fore)^2 - |reach|^2) (|reach|^2 - (upper - fore)^2)
    #                   / (2 upper fore)^2
    square = reach_x**2 + reach_y**2
    stretched = (upper + fore) ** 2 - square
    folded = square - (upper - fore) ** 2
    sine = jnp.sqrt(_positive(stretched)) * jnp.sqrt(_positive(folded)) / (2.0 * upper * fore)
    cosine = (square - upper**2 - fore**2) / (2.0 * upper * fore)
    bend = _angle(sign[1] * sine, cosine, 0.0)
    t3 = bend - jnp.arctan2(-s[2] * arm.d[3], arm.a[2])
    # t2 = atan2(reach) - atan2(fore sin(bend), upper + fore cos(bend))
    along = jnp.arctan2(fore * jnp.sin(bend), upper + fore * jnp.cos(bend))
    t2 = _angle(reach_y, reach_x, arm.theta[1] + along) - along

    # The forearm's rotation being known, the wrist's remains. It is W = Rz(t4) Ry(-s4 t5) Rz(u)
    # with u = -s4 s5 t6, followed by a rotation by 180 degrees about x if s4 = s5. That rotation is
    # removed by `flip`.
    fore_arm = SO3.from_z_radians(t1) @ SO3.from_x_radians(arm.alpha[0])
    fore_arm = fore_arm @ SO3.from_z_radians(t2 + t3) @ SO3.from_x_radians(arm.alpha[2])
    same = s[3] * s[4]
    flip = jnp.stack([jnp.ones(()), -same, -same])
    W = (fore_arm.inverse() @ hand.rotation()).as_matrix() * flip[None]
    # The third column of W is (cos t4 sin b, sin t4 sin b, cos b), with b = -s4 t5. It gives t4 and
    # t5; for b = 0 only t4 + u is determined, and t4 keeps its value at a zero reading.
    tilt = jnp.sqrt(_positive(W[0, 2] ** 2 + W[1, 2] ** 2))
    straight = tilt < SINGULAR
    t4 = jnp.where(
        straight, arm.theta[3], _angle(sign[2] * W[1, 2], sign[2] * W[0, 2], arm.theta[3])
    )
    sin4, cos4 = jnp.sin(t4), jnp.cos(t4)
    t5 = -s[3] * jnp.arctan2(cos4 * W[0, 2] + sin4 * W[1, 2], W[2, 2])
    # The second row of Rz(-t4) W is (sin u, cos u, 0): it determines t6 for any t5, even zero.
    t6 = -same * jnp.arctan2(cos4 * W[1, 0] - sin4 * W[0, 0], cos4 * W[1, 1] - sin4 * W[0, 1])

    length = jnp.abs(upper) + fore
    margin = jnp.minimum(stretched, folded) / length
    reached = (room > -SINGULAR) & (margin > -SINGULAR)
    # `room` and `margin` measure the distance to the boundary of the workspace, m: negative
    # outside, near zero at a singularity of shoulder or elbow.
    singular = jnp.stack([room < SINGULAR, margin < SINGULAR, straight])
    return jnp.stack([t1, t2, t3, t4, t5, t6]), reached, singular


def _last_link(arm: SerialArm) -> SE3:
    """Return the fixed transform from the wrist centre, after joint 6, to the flange.

    It includes `d6`, because joint 6 rotates about the axis along which `d6` extends.
    """
    zero = jnp.zeros_like(arm.a[5])
    along = SE3.from_translation(jnp.stack([arm.a[5], zero, arm.d[5]]))
    return along @ SE3.from_rotation(SO3.from_x_radians(arm.alpha[5]))


def _positive(square: Float[Array, ""]) -> Float[Array, ""]:
    """Return the argument of a square root, bounded below by 1e-200 for a finite derivative."""
    return jnp.maximum(square, 1e-200)


def _angle(
    y: Float[Array, ""], x: Float[Array, ""], otherwise: Float[Array, ""] | float
) -> Float[Array, ""]:
    """Return the angle of the vector (x, y), or another value where the vector is zero."""
    nothing = (jnp.abs(x) < SINGULAR) & (jnp.abs(y) < SINGULAR)
    # Both arguments are replaced before atan2, since its derivative at (0, 0) is NaN, which a
    # selection afterwards would not remove.
    found = jnp.arctan2(jnp.where(nothing, 0.0, y), jnp.where(nothing, 1.0, x))
    return jnp.where(nothing, otherwise, found)


def _status(
    reached: Bool[Array, "*b"], singular: Bool[Array, "*b 3"], beyond: Bool[Array, "*b 6"]
) -> Int[Array, "*b"]:
    """Return the `Status` flags of solutions."""
    kinds = (Status.SHOULDER_SINGULAR, Status.ELBOW_SINGULAR, Status.WRIST_SINGULAR)
    status = jnp.where(reached, 0, int(Status.OUT_OF_REACH))
    status = status | jnp.where(beyond.any(axis=-1), int(Status.OUT_OF_LIMITS), 0)
    for k, kind in enumerate(kinds):
        status = status | jnp.where(singular[..., k] & reached, int(kind), 0)
    return status
