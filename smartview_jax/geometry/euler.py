"""Convert rotations to and from yaw, pitch, roll (Eq. 16) and the z-y-z angles of robots.

Each inverse reads two angles from the matrix, undoes the first rotation, and reads the last angle
from the product. The two entries that give the last angle form a vector of length 1 in every pose.
Near gimbal lock, where the first angle is ill determined, the last angle therefore compensates for
it: the rotation is recovered to rounding error, although the single angles are not.
"""

import jax.numpy as jnp
from jaxlie import SO3
from jaxtyping import Array, Float

from ..compilation import one_program

GIMBAL_LOCK_TOLERANCE = 1e-10
"""Limit on the cosine (or sine) of the middle angle, below which a pose is at gimbal lock.

At gimbal lock only the sum or difference of the outer angles is defined. The limit is far above
rounding error, so that composed transforms that should be at gimbal lock are recognised, and far
below any angle that matters, since the rotation is wrong by about this much there.
"""


def rotation_from_ypr(ypr: Float[Array, "*batch 3"]) -> SO3:
    """Return the rotation `Rz(yaw) Ry(pitch) Rx(roll)` of angles in rad.

    In Eq. 16 the angles are called psi_z, psi_y, psi_x.
    """
    return SO3.from_rpy_radians(ypr[..., 2], ypr[..., 1], ypr[..., 0])


@one_program
def ypr_from_rotation(rotation: SO3) -> Float[Array, "*batch 3"]:
    """Return yaw, pitch and roll of a rotation, in rad.

    Pitch is within +-90 degrees. At +-90 degrees, where only yaw plus or minus roll is defined,
    roll is zero.
    """
    # R = Rz(yaw) Ry(pitch) Rx(roll) has
    #   R_11 = cos yaw cos pitch,  R_21 = sin yaw cos pitch,  R_31 = -sin pitch,
    # and with roll = 0 also R_12 = -sin yaw, R_22 = cos yaw, which are used at gimbal lock.
    R = rotation.as_matrix()
    cosine = jnp.hypot(R[..., 0, 0], R[..., 1, 0])
    gimbal = cosine < GIMBAL_LOCK_TOLERANCE
    pitch = jnp.arctan2(-R[..., 2, 0], cosine)
    yaw = jnp.arctan2(
        jnp.where(gimbal, -R[..., 0, 1], R[..., 1, 0]),
        jnp.where(gimbal, R[..., 1, 1], R[..., 0, 0]),
    )
    # The second row of Rz(-yaw) R = Ry(pitch) Rx(roll) is (0, cos roll, -sin roll).
    s, c = jnp.sin(yaw), jnp.cos(yaw)
    roll = jnp.arctan2(
        s * R[..., 0, 2] - c * R[..., 1, 2],
        c * R[..., 1, 1] - s * R[..., 0, 1],
    )
    return jnp.stack([yaw, pitch, jnp.where(gimbal, 0.0, roll)], axis=-1)


def rotation_from_zyz(angles: Float[Array, "*batch 3"]) -> SO3:
    """Return the rotation `Rz(first) Ry(second) Rz(third)` of angles in rad.

    Kawasaki calls these angles O, A, T.
    """
    first, second, third = angles[..., 0], angles[..., 1], angles[..., 2]
    return SO3.from_z_radians(first) @ SO3.from_y_radians(second) @ SO3.from_z_radians(third)


@one_program
def zyz_from_rotation(rotation: SO3) -> Float[Array, "*batch 3"]:
    """Return the z-y-z angles of a rotation, in rad.

    The second angle is in [0, 180] degrees. At 0 and 180 degrees, where only the sum or the
    difference of the outer angles is defined, the first angle is zero.
    """
    # R = Rz(first) Ry(second) Rz(third) has the last column
    #   (cos first sin second, sin first sin second, cos second).
    R = rotation.as_matrix()
    sine = jnp.hypot(R[..., 0, 2], R[..., 1, 2])
    gimbal = sine < GIMBAL_LOCK_TOLERANCE
    second = jnp.arctan2(sine, R[..., 2, 2])
    # The inner `where` keeps the derivative of the unused branch finite: JAX differentiates both.
    first = jnp.arctan2(R[..., 1, 2], jnp.where(gimbal, 1.0, R[..., 0, 2]))
    first = jnp.where(gimbal, 0.0, first)
    # The second row of Rz(-first) R = Ry(second) Rz(third) is (sin third, cos third, 0).
    s, c = jnp.sin(first), jnp.cos(first)
    third = jnp.arctan2(
        c * R[..., 1, 0] - s * R[..., 0, 0],
        c * R[..., 1, 1] - s * R[..., 0, 1],
    )
    return jnp.stack([first, second, third], axis=-1)
