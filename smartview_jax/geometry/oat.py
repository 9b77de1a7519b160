"""VAL's orientation angles O, A, T, and the six-number pose XYZOAT (Eq. 18).

    R = Rz(O) Rx(A) M0 Rz(T) = Rz(O) M0 Ry(A) Rz(T),   M0 = [[0,1,0],[0,0,-1],[-1,0,0]]

At O = A = T = 0 the tool points along -y. At A = +-90 degrees it points straight down or up, which
is how one looks at a table, and only T - O (or T + O) is defined there. So this is a format for
files and commands only: nothing is estimated, averaged or interpolated in it.

Reference: UNIMATION, VAL, 1977; the paper's Eq. 18.
"""

import jax.numpy as jnp
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

from .rigid import PoseLike, as_se3

_GIMBAL = 1e-7
"""Cosine of A under which O and T cannot be told apart in double precision."""

_M0 = ((0.0, 1.0, 0.0), (0.0, 0.0, -1.0), (-1.0, 0.0, 0.0))


def rotation_from_oat(oat: Float[Array, "*batch 3"]) -> SO3:
    """The rotation of angles O, A, T, in rad."""
    O, A, T = oat[..., 0], oat[..., 1], oat[..., 2]
    middle = SO3.from_matrix(jnp.broadcast_to(jnp.array(_M0), (*O.shape, 3, 3)))
    return SO3.from_z_radians(O) @ middle @ SO3.from_y_radians(A) @ SO3.from_z_radians(T)


def oat_from_rotation(
    rotation: SO3, other_branch: bool = False, gimbal_o: float = 0.0
) -> Float[Array, "*batch 3"]:
    """O, A, T in rad, A within +-90 degrees.

    Args:
        rotation: `(*batch)`.
        other_branch: the same rotation as `(O + pi, pi - A, T + pi)`.
        gimbal_o: O where the tool points straight down or up, such as the last commanded one.
    """
    R = rotation.as_matrix()
    cosine = jnp.hypot(R[..., 0, 2], R[..., 1, 2])
    gimbal = cosine < _GIMBAL
    safe = jnp.where(gimbal, 1.0, R[..., 0, 2])
    O = jnp.arctan2(safe, -R[..., 1, 2])
    A = jnp.arctan2(-R[..., 2, 2], cosine)
    T = jnp.arctan2(jnp.where(gimbal, 1.0, R[..., 2, 1]), -R[..., 2, 0])
    # Straight down (A > 0) only T - O is defined, straight up T + O.
    free = jnp.arctan2(R[..., 0, 0], R[..., 0, 1])
    chosen = jnp.full_like(free, gimbal_o)
    O = jnp.where(gimbal, chosen, O)
    T = jnp.where(gimbal, free + jnp.where(A > 0.0, chosen, -chosen), T)
    if other_branch:
        O, A, T = O + jnp.pi, jnp.pi - A, T + jnp.pi
    return jnp.stack([_wrapped(O), A, _wrapped(T)], axis=-1)


def xyzoat(base_from_tool: PoseLike, gimbal_o: float = 0.0) -> Float[Array, "*batch 6"]:
    """A pose as VAL writes it: x, y, z in m, then O, A, T in rad."""
    pose = as_se3(base_from_tool)
    angles = oat_from_rotation(pose.rotation(), gimbal_o=gimbal_o)
    return jnp.concatenate([pose.translation(), angles], axis=-1)


def se3_from_xyzoat(numbers: Float[Array, "*batch 6"]) -> SE3:
    """The pose of x, y, z (m) and O, A, T (rad)."""
    rotation = rotation_from_oat(numbers[..., 3:])
    return SE3.from_rotation_and_translation(rotation, numbers[..., :3])


def _wrapped(angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    return jnp.arctan2(jnp.sin(angle), jnp.cos(angle))
