"""Yaw, pitch, roll (Eq. 16) and the other three-angle conventions that robots report."""

import jax.numpy as jnp
from jaxlie import SO3
from jaxtyping import Array, Float

_GIMBAL = 1e-7


def rotation_from_ypr(ypr: Float[Array, "*batch 3"]) -> SO3:
    """`Rz(yaw) Ry(pitch) Rx(roll)`, rad (Eq. 16: psi_z, psi_y, psi_x)."""
    return SO3.from_rpy_radians(ypr[..., 2], ypr[..., 1], ypr[..., 0])


def ypr_from_rotation(rotation: SO3) -> Float[Array, "*batch 3"]:
    """Yaw, pitch, roll in rad, pitch within +-90 degrees; at +-90 degrees roll is zero."""
    R = rotation.as_matrix()
    cosine = jnp.hypot(R[..., 0, 0], R[..., 1, 0])
    gimbal = cosine < _GIMBAL
    pitch = jnp.arctan2(-R[..., 2, 0], cosine)
    yaw = jnp.arctan2(
        jnp.where(gimbal, -R[..., 0, 1], R[..., 1, 0]),
        jnp.where(gimbal, R[..., 1, 1], R[..., 0, 0]),
    )
    roll = jnp.where(gimbal, 0.0, jnp.arctan2(R[..., 2, 1], jnp.where(gimbal, 1.0, R[..., 2, 2])))
    return jnp.stack([yaw, pitch, roll], axis=-1)


def rotation_from_zyz(angles: Float[Array, "*batch 3"]) -> SO3:
    """`Rz(first) Ry(second) Rz(third)`, rad: Kawasaki's O, A, T."""
    first, second, third = angles[..., 0], angles[..., 1], angles[..., 2]
    return SO3.from_z_radians(first) @ SO3.from_y_radians(second) @ SO3.from_z_radians(third)


def zyz_from_rotation(rotation: SO3) -> Float[Array, "*batch 3"]:
    """The three angles in rad, the second in [0, 180] degrees; at its ends the first is zero."""
    R = rotation.as_matrix()
    sine = jnp.hypot(R[..., 0, 2], R[..., 1, 2])
    gimbal = sine < _GIMBAL
    second = jnp.arctan2(sine, R[..., 2, 2])
    first = jnp.where(gimbal, 0.0, jnp.arctan2(R[..., 1, 2], jnp.where(gimbal, 1.0, R[..., 0, 2])))
    regular = jnp.arctan2(R[..., 2, 1], jnp.where(gimbal, 1.0, -R[..., 2, 0]))
    third = jnp.where(gimbal, jnp.arctan2(R[..., 1, 0], R[..., 1, 1]), regular)
    return jnp.stack([first, second, third], axis=-1)
