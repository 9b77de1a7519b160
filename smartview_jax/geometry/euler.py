"""Convert rotations to and from three angles: yaw, pitch, roll (Eq. 16) and all other conventions.

Each inverse reads two angles from the matrix, undoes the first rotation, and reads the last angle
from the product. The two entries that give the last angle form a vector of length 1 in every pose.
Near gimbal lock, where the first angle is poorly determined, the last angle therefore compensates
for its error: the rotation is recovered to rounding error, although the single angles are not.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxlie import SO3
from jaxtyping import Array, Float

from ..runtime.compilation import one_program

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


class EulerConvention(NamedTuple):
    """Convention of three angles: their axes, and whether the axes are fixed or moving.

    Attributes:
        axes: in the order of the angles, such as `"ZYX"`.
        moving: whether each rotation is about the axes as rotated by the previous rotations.
    """

    axes: str
    moving: bool

    def to_matrices(self, angles: Float[np.ndarray, "rows 3"]) -> Float[np.ndarray, "rows 3 3"]:
        """Return the rotation matrices of angles in rad."""
        first, second, third = (
            axis_rotations(axis, angles[:, k]) for k, axis in enumerate(self.axes)
        )
        return first @ second @ third if self.moving else third @ second @ first

    def from_matrices(self, matrices: Float[np.ndarray, "rows 3 3"]) -> Float[np.ndarray, "rows 3"]:
        """Return the angles of rotation matrices, rad.

        The second angle is within +-90 degrees, or in [0, 180] degrees if the outer axes are the
        same. Where it is at an end of this range, only a sum or difference of the outer angles is
        defined. For moving axes the first angle is then zero if the outer axes are the same, and
        the third otherwise. For fixed axes, whose angles are the moving ones in reverse order, it
        is the other of the two.
        """
        if self.moving:
            return _moving_angles(matrices, self.axes)
        return _moving_angles(matrices, self.axes[::-1])[:, ::-1]


def axis_rotations(axis: str, angles: Float[np.ndarray, "rows"]) -> Float[np.ndarray, "rows 3 3"]:
    """Return the matrices of rotations about one coordinate axis, `"X"`, `"Y"` or `"Z"`.

    Args:
        axis: name of the axis.
        angles: of the rotations, rad.
    """
    i = "XYZ".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    matrices = np.zeros((len(angles), 3, 3))
    matrices[:, i, i] = 1.0
    matrices[:, j, j] = matrices[:, k, k] = np.cos(angles)
    matrices[:, k, j] = np.sin(angles)
    matrices[:, j, k] = -matrices[:, k, j]
    return matrices


EULER_CONVENTIONS = {
    f"euler_{axes}_{'moving' if moving else 'fixed'}": EulerConvention(axes, moving)
    for axes in ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX", "XYX", "XZX", "YXY", "YZY", "ZXZ", "ZYZ")
    for moving in (False, True)
}
"""All conventions of three angles, by name."""


def _moving_angles(R: Float[np.ndarray, "rows 3 3"], axes: str) -> Float[np.ndarray, "rows 3"]:
    """Return the angles of rotations about moving axes, rad."""
    # R = Ri(a) Rj(b) Rk(c); l is the axis that is neither i nor j, and ei x ej = sign el.
    i, j, k = ("XYZ".index(axis) for axis in axes)
    l = 3 - i - j
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    proper = i == k
    # v = R ek = Ri(a) Rj(b) ek has no c:
    #   i = k:  cos b ei + sin b (sin a ej - sign cos a el)
    #   l = k:  sign sin b ei + cos b (cos a el - sign sin a ej)
    v = R[:, :, k]
    across = np.hypot(v[:, j], v[:, l])
    gimbal = across < GIMBAL_LOCK_TOLERANCE
    if proper:
        second = np.arctan2(across, v[:, i])
        first = np.where(gimbal, 0.0, np.arctan2(v[:, j], -sign * v[:, l]))
    else:
        second = np.arctan2(sign * v[:, i], across)
        # With c = 0, R ej = cos a ej + sign sin a el.
        first = np.where(
            gimbal,
            np.arctan2(sign * R[:, l, j], R[:, j, j]),
            np.arctan2(-sign * v[:, j], v[:, l]),
        )
    # Row j of Ri(-a) R = Rj(b) Rk(c) is cos c ej + sin c (sign ei), or (-sign el) if i = k.
    row = np.cos(first)[:, None] * R[:, j] + sign * np.sin(first)[:, None] * R[:, l]
    third = np.arctan2(-sign * row[:, l] if proper else sign * row[:, i], row[:, j])
    if not proper:
        third = np.where(gimbal, 0.0, third)
    return np.stack([first, second, third], axis=1)
