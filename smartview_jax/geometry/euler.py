"""Yaw, pitch, roll (Eq. 16) and the other three-angle conventions that robots report.

Each inverse takes its first two angles from the matrix, turns the first rotation back, and reads
the last angle from what is left. That pair of entries has length 1 whatever the pose, so near the
gimbal, where the first angle is ill determined, the last one makes up for it: the rotation comes
back to rounding, although the single angles do not.
"""

import jax.numpy as jnp
from jaxlie import SO3
from jaxtyping import Array, Float

GIMBAL = 1e-10
"""Cosine (or sine) of the middle angle under which the outer angles are one angle.

Far above rounding, so that composed transforms that should be at the gimbal are; far below any
angle that matters, since the rotation is wrong by about this much there.
"""


def rotation_from_ypr(ypr: Float[Array, "*batch 3"]) -> SO3:
    """`Rz(yaw) Ry(pitch) Rx(roll)`, rad (Eq. 16: psi_z, psi_y, psi_x)."""
    return SO3.from_rpy_radians(ypr[..., 2], ypr[..., 1], ypr[..., 0])


def ypr_from_rotation(rotation: SO3) -> Float[Array, "*batch 3"]:
    """Yaw, pitch, roll in rad, pitch within +-90 degrees; at +-90 degrees roll is zero."""
    R = rotation.as_matrix()
    cosine = jnp.hypot(R[..., 0, 0], R[..., 1, 0])
    gimbal = cosine < GIMBAL
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
    """`Rz(first) Ry(second) Rz(third)`, rad: Kawasaki's O, A, T."""
    first, second, third = angles[..., 0], angles[..., 1], angles[..., 2]
    return SO3.from_z_radians(first) @ SO3.from_y_radians(second) @ SO3.from_z_radians(third)


def zyz_from_rotation(rotation: SO3) -> Float[Array, "*batch 3"]:
    """The three angles in rad, the second in [0, 180] degrees; at its ends the first is zero."""
    R = rotation.as_matrix()
    sine = jnp.hypot(R[..., 0, 2], R[..., 1, 2])
    gimbal = sine < GIMBAL
    second = jnp.arctan2(sine, R[..., 2, 2])
    # The inner `where` keeps the derivative of the branch not taken finite.
    first = jnp.arctan2(R[..., 1, 2], jnp.where(gimbal, 1.0, R[..., 0, 2]))
    first = jnp.where(gimbal, 0.0, first)
    # The second row of Rz(-first) R = Ry(second) Rz(third) is (sin third, cos third, 0).
    s, c = jnp.sin(first), jnp.cos(first)
    third = jnp.arctan2(
        c * R[..., 1, 0] - s * R[..., 0, 0],
        c * R[..., 1, 1] - s * R[..., 0, 1],
    )
    return jnp.stack([first, second, third], axis=-1)
