"""Compute forward kinematics, and its derivatives, from Denavit-Hartenberg parameters.

References:
    Denavit and Hartenberg, A kinematic notation for lower-pair mechanisms, 1955 ("standard").
    Craig, Introduction to robotics, 1986 ("modified").
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxlie import SE3, SO3
from jaxtyping import Array, Bool, Float

from ..argument_checks import require_one_of
from ..geometry import PoseLike, as_se3
from ..runtime.array_namespace import to_device
from ..runtime.compilation import compiled, one_program
from .command import Command, JointsLike

DH_CONVENTIONS = ("standard", "modified")
"""The names of the Denavit-Hartenberg conventions."""


class SerialArm(eqx.Module):
    """An open kinematic chain of joints, described by Denavit-Hartenberg parameters.

    One link of it is the transform

        standard:  Rz(theta) Tz(d) Tx(a) Rx(alpha)
        modified:  Rx(alpha) Tx(a) Rz(theta) Tz(d)

    where the joint's reading is added to `theta`, or to `d` if the joint is prismatic.

    Attributes:
        theta: joint angle at a reading of zero, rad.
        d: offset along the joint axis, m.
        a: link length, m.
        alpha: link twist, rad.
        flange_from_tool: transform of the tool mounted on the last link.
        convention: `"standard"` or `"modified"`.
        prismatic: whether each joint is prismatic.
        limits: lower and upper limit of each reading, rad or m; infinite where there is none.
        base_from_first: pose of the frame whose z axis is the first joint's; by default the base's.
    """

    theta: Float[Array, "joints"]
    d: Float[Array, "joints"]
    a: Float[Array, "joints"]
    alpha: Float[Array, "joints"]
    flange_from_tool: SE3
    convention: str = eqx.field(static=True)
    prismatic: tuple[bool, ...] = eqx.field(static=True)
    limits: Float[Array, "joints 2"]
    base_from_first: SE3

    def __init__(
        self,
        theta: Sequence[float] | np.ndarray | Array,
        d: Sequence[float] | np.ndarray | Array,
        a: Sequence[float] | np.ndarray | Array,
        alpha: Sequence[float] | np.ndarray | Array,
        convention: str = "standard",
        prismatic: Sequence[bool] | None = None,
        flange_from_tool: PoseLike | None = None,
        limits: Sequence[Sequence[float]] | np.ndarray | Array | None = None,
        base_from_first: PoseLike | None = None,
    ):
        require_one_of("convention", convention, DH_CONVENTIONS)
        self.theta, self.d, self.a, self.alpha = (
            _as_jax_array(row) for row in (theta, d, a, alpha)
        )
        prismatic_flags = (False,) * len(self.d) if prismatic is None else prismatic
        self.prismatic = tuple(map(bool, prismatic_flags))
        shapes = {name: jnp.shape(getattr(self, name)) for name in ("theta", "d", "a", "alpha")} | {
            "prismatic": (len(self.prismatic),)
        }
        if len(set(shapes.values())) > 1 or self.theta.ndim != 1 or self.joint_count == 0:
            raise ValueError(f"an arm has one number per joint in each row; found {shapes}")
        # Not jaxlie's own identity, which compiles programs.
        identity = SE3(jax.device_put(np.eye(7)[0]))
        self.flange_from_tool = identity if flange_from_tool is None else as_se3(flange_from_tool)
        self.base_from_first = identity if base_from_first is None else as_se3(base_from_first)
        self.convention = convention
        self.limits = _checked_limits(limits, self.joint_count)

    @property
    def joint_count(self) -> int:
        """The number of joints."""
        return len(self.theta)

    def base_from_tool(self, joints: JointsLike) -> SE3:
        """Return the tool's poses `(*views)` at joint readings, by forward kinematics.

        Raises:
            ValueError: there is not one reading per joint.
        """
        joints = _as_jax_array(joints)
        if joints.shape[-1:] != (self.joint_count,):
            raise ValueError(
                f"joints: expected (..., {self.joint_count}), one reading per joint, "
                f"found {joints.shape}"
            )
        return _forward_kinematics(self, joints)

    def frame_origins(self, joints: JointsLike) -> Float[Array, "*views origins 3"]:
        """Return the origins of the frames along the chain in the base frame, m, the tool's last.

        There are two for each joint, one before either screw: the straight lines from one to the
        next run along the joint's axis and along the link.
        """
        return _origins(self, _as_jax_array(joints))

    def command(self, joints: JointsLike) -> Command:
        """Return joint readings with the tool pose that the controller computes from them."""
        return Command(self.base_from_tool(joints), _as_jax_array(joints))

    @one_program
    def violated_limits(
        self, joints: JointsLike, tolerance: float = 0.0
    ) -> Bool[Array, "*views joints"]:
        """Return which readings exceed a joint limit by more than a tolerance; NaN never does."""
        joints = jnp.asarray(joints, dtype=float)
        lower, upper = (jnp.broadcast_to(bound, joints.shape) for bound in self.limits.T)
        return (joints < lower - tolerance) | (joints > upper + tolerance)

    def jacobian(self, joints: Float[Array, "joints"] | np.ndarray) -> Float[Array, "6 joints"]:
        """Return the twist at the tool per unit of each joint reading, translation first."""
        return pose_and_jacobian(self, jnp.asarray(joints))[1]


def _as_jax_array(numbers: Sequence[Any] | np.ndarray | Array) -> Float[Array, "..."]:
    """Return numbers as a JAX array; host numbers without compiling a program."""
    if any(isinstance(x, Array) for x in jax.tree.leaves(numbers)):
        return jnp.asarray(numbers, dtype=float)
    # A copy, because `device_put` may share the memory of the caller's array.
    return to_device(np.array(numbers, dtype=float))


def _checked_limits(
    limits: Sequence[Sequence[float]] | np.ndarray | Array | None, joints: int
) -> Float[Array, "joints 2"]:
    """Return the joint limits as an array, infinite by default."""
    if limits is None:
        return jax.device_put(np.tile([-np.inf, np.inf], (joints, 1)))
    if np.shape(limits) != (joints, 2):
        raise ValueError(
            f"limits: expected ({joints}, 2), the least and the largest reading of each joint, "
            f"found {np.shape(limits)}"
        )
    # Inside jit limits have no values to check; they were checked when the arm was made outside.
    if not isinstance(limits, Tracer):
        for k, (lower, upper) in enumerate(np.asarray(limits, dtype=float).tolist()):
            if not lower < upper:
                raise ValueError(f"limits of joint {1 + k}: {lower} is not below {upper}")
    return _as_jax_array(limits)


def _screw(rotation: SO3, distance: Float[Array, "*views"], axis: int) -> SE3:
    """Return a rotation about a coordinate axis combined with a translation along it."""
    components = [jnp.zeros_like(distance)] * 3
    components[axis] = distance
    return SE3.from_rotation_and_translation(rotation, jnp.stack(components, axis=-1))


@one_program
def dh_jacobian(
    arm: SerialArm, joints: Float[Array, "*views joints"]
) -> Float[Array, "*views 6 rows joints"]:
    """Return the Jacobian of the tool pose with respect to all Denavit-Hartenberg parameters.

    It is the twist in the tool frame, translation first, per unit of each joint's `theta`, `d`, `a`
    and `alpha`. The Jacobian is geometric: each parameter is a screw about the z or the x axis of a
    frame of the chain, and no automatic differentiation is needed.
    """
    tool, frames = chain_frames(arm, joints)
    theta, d = _screw_twists(arm.convention, tool, frames, 2)
    alpha, a = _screw_twists(arm.convention, tool, frames, 0)
    return jnp.swapaxes(jnp.stack([theta, d, a, alpha], axis=-2), -3, -1)


@one_program
def pose_and_jacobian(
    arm: SerialArm, joints: Float[Array, "joints"]
) -> tuple[SE3, Float[Array, "6 joints"]]:
    """Return the tool's pose, and its twist in the tool frame per unit of each joint reading."""
    tool, frames = chain_frames(arm, joints)
    # A revolute joint's reading is added to theta, a prismatic joint's to d.
    theta, d = _screw_twists(arm.convention, tool, frames, 2)
    return tool, jnp.where(jnp.array(arm.prismatic)[:, None], d, theta).T


def _screw_twists(
    convention: str, tool: SE3, frames: SE3, axis: int
) -> tuple[Float[Array, "*views joints 6"], Float[Array, "*views joints 6"]]:
    """Return the tool's twists per unit of a turn about each joint's axis, and of a slide along it.

    The axis is 2 for screws about z (`theta` and `d`), 0 for those about x (`alpha` and `a`). Tool
    and frames are from `chain_frames`.
    """
    # In the standard convention the z screw is the first of a link and the x screw the second; in
    # the modified convention it is the reverse.
    screw = 0 if (axis == 2) == (convention == "standard") else 1
    tool_from_frame = SE3(tool.wxyz_xyz[..., None, :]).inverse() @ SE3(
        frames.wxyz_xyz[..., screw, :]
    )
    # Let n be the direction of a screw axis and p a point on it, in the tool frame. Per unit of the
    # parameter the tool moves by the twist (translation, rotation)
    #     (p x n, n)  for a rotation about the axis (theta about z, alpha about x),
    #     (n, 0)      for a translation along it (d along z, a along x).
    direction = tool_from_frame.rotation().as_matrix()[..., axis]
    turn = jnp.cross(tool_from_frame.translation(), direction)
    return (
        jnp.concatenate([turn, direction], axis=-1),
        jnp.concatenate([direction, jnp.zeros_like(direction)], axis=-1),
    )


@compiled
def _forward_kinematics(arm: SerialArm, joints: Float[Array, "*views joints"]) -> SE3:
    """Return the pose of the tool: `SerialArm.base_from_tool`, compiled."""
    return chain_frames(arm, joints)[0]


@compiled
def _origins(
    arm: SerialArm, joints: Float[Array, "*views joints"]
) -> Float[Array, "*views origins 3"]:
    """Return the origins of all frames along the chain: `SerialArm.frame_origins`, compiled."""
    tool, frames = chain_frames(arm, joints)
    along = frames.translation().reshape(*joints.shape[:-1], -1, 3)
    return jnp.concatenate([along, tool.translation()[..., None, :]], axis=-2)


def chain_frames(arm: SerialArm, joints: Float[Array, "*views joints"]) -> tuple[SE3, SE3]:
    """Return the tool's poses, and the frames before both screws of each joint.

    The tool's poses are `(*views)`, the frames `(*views, joints, 2)`; all are in the base frame.
    """
    views = joints.shape[:-1]
    parameters = (arm.theta, arm.d, arm.a, arm.alpha, jnp.array(arm.prismatic))

    def next_frame(pose: Array, joint: tuple[Array, ...]) -> tuple[Array, Array]:
        first, second = _link_screws(arm.convention, *joint)
        middle = SE3(pose) @ first
        return (middle @ second).wxyz_xyz, jnp.stack([pose, middle.wxyz_xyz], axis=-2)

    # A scan over the joints: written out as a Python loop, the chain took XLA about one second of
    # compile time per joint.
    first = jnp.broadcast_to(arm.base_from_first.wxyz_xyz, (*views, 7))
    last, frames = jax.lax.scan(next_frame, first, (*parameters, jnp.moveaxis(joints, -1, 0)))
    tool = SE3(last) @ SE3(jnp.broadcast_to(arm.flange_from_tool.wxyz_xyz, (*views, 7)))
    return tool, SE3(jnp.moveaxis(frames, 0, -3))


def _link_screws(
    convention: str,
    theta: Float[Array, ""],
    d: Float[Array, ""],
    a: Float[Array, ""],
    alpha: Float[Array, ""],
    prismatic: Bool[Array, ""],
    reading: Float[Array, "*views"],
) -> tuple[SE3, SE3]:
    """Return the screws of a joint and of the link after it, in the order of the convention."""
    zeros = jnp.zeros_like(reading)
    angle = theta + jnp.where(prismatic, zeros, reading)
    distance = d + jnp.where(prismatic, reading, zeros)
    joint = _screw(SO3.from_z_radians(angle), distance, 2)
    link = _screw(SO3.from_x_radians(alpha + zeros), a + zeros, 0)
    return (joint, link) if convention == "standard" else (link, joint)
