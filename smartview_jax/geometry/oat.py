"""Convert poses to and from VAL's six numbers X, Y, Z, O, A, T (Eq. 18).

The orientation angles are defined by

    R = Rz(O) Rx(A) M0 Rz(T) = Rz(O) M0 Ry(A) Rz(T),   M0 = [[0,1,0],[0,0,-1],[-1,0,0]]

At O = A = T = 0 the tool points along -y. At A = +-90 degrees it points straight down or up, as it
does when a camera looks at a table, and only T - O (or T + O) is defined there. Therefore this
format is used for files and commands only: nothing is estimated, averaged or interpolated in it.
Near this gimbal lock O and T vary strongly from pose to pose, and only their combination is
meaningful: the O of one pose with the T of another gives an orientation near neither pose.

Reference: UNIMATION, VAL, 1977; the paper's Eq. 18.
"""

from types import ModuleType

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

from ..runtime.array_namespace import AnyArray, to_device
from ..runtime.compilation import is_traced, one_program
from .euler import GIMBAL_LOCK_TOLERANCE
from .host import host_matrices
from .rigid_transforms import PoseLike, as_se3

VAL_M0 = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
"""The matrix M0 of VAL's angles (Eq. 18)."""


@one_program
def rotation_from_oat(oat: Float[Array, "*batch 3"]) -> SO3:
    """Return the rotation of the angles O, A, T in rad (Eq. 18)."""
    # R = Rz(O) M0 Ry(A) Rz(T)
    O, A, T = oat[..., 0], oat[..., 1], oat[..., 2]
    M0 = SO3.from_matrix(jnp.broadcast_to(jnp.array(VAL_M0), (*O.shape, 3, 3)))
    return SO3.from_z_radians(O) @ M0 @ SO3.from_y_radians(A) @ SO3.from_z_radians(T)


def oat_from_rotation(
    rotation: SO3,
    other_branch: bool = False,
    gimbal_o: float | Float[AnyArray, "*#batch"] = 0.0,
) -> Float[Array, "*batch 3"]:
    """Return the angles O, A, T of a rotation in rad, with A within +-90 degrees.

    Args:
        rotation: `(*batch)`.
        other_branch: return the second solution `(O + pi, pi - A, T + pi)` of the same rotation.
        gimbal_o: the O to return where the tool points straight down or up, such as the last
            commanded O; one for all rotations or one for each. In the other branch pi is added to
            it too.
    """
    # An array, because a program would be compiled for each Python number.
    if not isinstance(gimbal_o, Array):
        gimbal_o = np.asarray(gimbal_o, dtype=float)
    if is_traced(rotation, gimbal_o):
        return jnp.asarray(_oat_angles(rotation.as_matrix(), other_branch, gimbal_o, jnp))
    # Outside of a transformation NumPy is faster: there is no program to compile or to load.
    numbers = np.asarray(rotation.wxyz)
    at_origin = np.concatenate([numbers, np.zeros((*numbers.shape[:-1], 3))], axis=-1)
    poses = SE3(at_origin)  # pyright: ignore[reportArgumentType]
    matrices = host_matrices(poses)[..., :3, :3]
    return to_device(_oat_angles(matrices, other_branch, np.asarray(gimbal_o), np))


def _oat_angles(
    R: Float[AnyArray, "*batch 3 3"],
    other_branch: bool,
    gimbal_o: Float[AnyArray, "*#batch"],
    xp: ModuleType,
) -> Float[AnyArray, "*batch 3"]:
    """Return the angles of `oat_from_rotation`, computed with NumPy or JAX (`xp`)."""
    # R = Rz(O) M0 Ry(A) Rz(T) has the last column (sin O cos A, -cos O cos A, -sin A).
    cosine = xp.hypot(R[..., 0, 2], R[..., 1, 2])
    gimbal = cosine < GIMBAL_LOCK_TOLERANCE
    A = xp.arctan2(-R[..., 2, 2], cosine)
    # The inner `where` keeps the derivative of the unused branch finite: JAX differentiates both.
    O = xp.arctan2(xp.where(gimbal, 1.0, R[..., 0, 2]), -R[..., 1, 2])
    O = xp.where(gimbal, xp.broadcast_to(xp.asarray(gimbal_o, R.dtype), O.shape), O)
    # The first row of Rz(-O) R = M0 Ry(A) Rz(T) is (sin T, cos T, 0), so T is consistent with the
    # chosen O, also at gimbal lock.
    s, c = xp.sin(O), xp.cos(O)
    T = xp.arctan2(c * R[..., 0, 0] + s * R[..., 1, 0], c * R[..., 0, 1] + s * R[..., 1, 1])
    if other_branch:
        # The sine and the cosine bring an angle to [-pi, pi].
        O, T = (xp.arctan2(xp.sin(angle + xp.pi), xp.cos(angle + xp.pi)) for angle in (O, T))
        A = xp.pi - A
    return xp.stack([O, A, T], axis=-1)


def xyzoat(
    base_from_tool: PoseLike, gimbal_o: float | Float[Array, "*#batch"] = 0.0
) -> Float[Array, "*batch 6"]:
    """Return a pose in VAL's format: x, y, z in m, then O, A, T in rad, A within +-90 degrees.

    Args:
        base_from_tool: `(*batch)`.
        gimbal_o: the O to return where the tool points straight down or up, as in
            `oat_from_rotation`.

    For example:

        >>> base_from_tool = np.diag([1.0, -1.0, -1.0, 1.0])
        >>> base_from_tool[:3, 3] = 0.5, 0.0, 0.3
        >>> print(np.round(sv.xyzoat(base_from_tool), 3))
        [0.5   0.    0.3   0.    1.571 1.571]
    """
    pose = as_se3(base_from_tool)
    numbers = pose.wxyz_xyz
    if is_traced(numbers, gimbal_o):
        angles = oat_from_rotation(pose.rotation(), gimbal_o=gimbal_o)
        return jnp.concatenate([pose.translation(), angles], axis=-1)
    numbers = np.asarray(numbers)
    rotation = SO3(numbers[..., :4])  # pyright: ignore[reportArgumentType]
    angles = oat_from_rotation(rotation, gimbal_o=gimbal_o)
    return to_device(np.concatenate([numbers[..., 4:], angles], axis=-1))


@one_program
def se3_from_xyzoat(numbers: Float[Array, "*batch 6"]) -> SE3:
    """Return the pose with the given x, y, z (m) and O, A, T (rad).

    For example:

        >>> downwards = sv.se3_from_xyzoat(np.array([0.5, 0.0, 0.3, 0.0, np.pi / 2, 0.0]))
        >>> print(np.rint(sv.geometry.host_matrices(downwards)[:3, :3]).astype(int))
        [[ 0  1  0]
         [ 1  0  0]
         [ 0  0 -1]]
    """
    rotation = rotation_from_oat(numbers[..., 3:])
    return SE3.from_rotation_and_translation(rotation, numbers[..., :3])
