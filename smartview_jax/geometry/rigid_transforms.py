"""Check, apply and average rigid transforms, as a thin layer over `jaxlie`.

The library `jaxlie` provides the group SE(3) and its derivatives. A transform named
`target_from_source` maps points of `source` into `target`. Tangents are as in jaxlie: translation
(m) first, then rotation (rad).
"""

from types import ModuleType
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..runtime.array_namespace import as_float_array
from ..runtime.compilation import one_program
from .host import host_matrices, host_poses, host_transforms
from .matrices import moved_points, pose_matrices

PoseLike: TypeAlias = SE3 | Float[Array, "*batch 4 4"] | np.ndarray
"""Type of a rigid transform in the arguments of this library: an `SE3`, or 4x4 matrices."""


def as_se3(pose: PoseLike) -> SE3:
    """Return a rigid transform, given as an `SE3` or as 4x4 matrices, as an `SE3`.

    Matrices are assumed to be rigid; `check_rigid` tests them where they enter the library. The
    quaternion is normalised, because a matrix of few digits gives a quaternion whose length is not
    quite 1, which would scale every point that it is applied to.

    Raises:
        ValueError: an array whose last two axes are not 4 and 4.
    """
    if isinstance(pose, SE3):
        return pose
    shape = np.shape(pose)
    if shape[-2:] != (4, 4):
        raise ValueError(f"a pose is an SE3 or an array (..., 4, 4); found shape {shape}")
    if isinstance(pose, jax.Array):
        return SE3.from_matrix(jnp.asarray(pose, dtype=float)).normalize()
    transforms = host_transforms(np.asarray(pose, dtype=float))
    return SE3(as_float_array(transforms.wxyz_xyz))


def check_rigid(
    matrices: np.ndarray, labels: tuple[str, ...], tolerance: float = 2e-4
) -> dict[str, str]:
    """Return an error text for each 4x4 matrix that is not a rigid transform, by its label.

    Args:
        matrices: `(views, 4, 4)`.
        labels: one name per matrix, the key in the result.
        tolerance: largest accepted entry of `R^T R - I`. Matrices with four decimals, the fewest in
            use, have at most 2 sqrt(3) 0.5e-4.

    Returns:
        A dictionary that is empty if all matrices are rigid transforms.
    """
    problems: dict[str, str] = {}
    for label, matrix in zip(labels, np.asarray(matrices, dtype=float), strict=True):
        if not np.all(np.isfinite(matrix)):
            problems[label] = "the pose contains NaN or infinity"
            continue
        rotation = matrix[:3, :3]
        error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
        if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > tolerance:
            problems[label] = f"the last row of the pose is {matrix[3].tolist()}, not 0 0 0 1"
        elif error > tolerance:
            problems[label] = f"not a rotation: R^T R differs from identity by {error:.3g}"
        elif np.linalg.det(rotation) < 0.0:
            problems[label] = "not a rotation: the determinant is -1 (a mirrored frame)"
    return problems


@one_program
def transform_points(
    target_from_source: SE3, points: Float[Array, "*points 3"]
) -> Float[Array, "*transformed 3"]:
    """Apply a batch of transforms to points.

    Args:
        target_from_source: `(*batch)`.
        points: `(N, 3)`, the same for all transforms, or `(*batch, N, 3)`.

    Returns:
        `(*batch, N, 3)`.
    """
    rank = len(target_from_source.get_batch_axes()) + 2
    points = points.reshape((1,) * (rank - points.ndim) + points.shape)
    return moved_points(pose_matrices(target_from_source), points)


def transformed_coordinates(
    rotation: Float[Array, "*batch 3 3"],
    translation: Float[Array, "*batch 3"],
    points: Float[Array, "*batch N 3"],
) -> tuple[Float[Array, "*batch N"], Float[Array, "*batch N"], Float[Array, "*batch N"]]:
    """Return x, y and z of many transformed points, for programs that run often.

    Args:
        rotation: rotation matrices, multiplied by a scale if there is one.
        translation: of the same batch.
        points: of the same batch.
    """
    x, y, z = (points[..., k] for k in range(3))

    # XLA fuses products of single numbers; a product of such thin matrices takes longer.
    def coordinate(k: int) -> Float[Array, "*batch N"]:
        """Return one coordinate of all points."""
        by_x, by_y, by_z = (rotation[..., k, i, None] for i in range(3))
        return by_x * x + by_y * y + by_z * z + translation[..., k, None]

    return coordinate(0), coordinate(1), coordinate(2)


@jax.custom_jvp
def nearest_rotation(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Return the rotation that is closest to a matrix in the Frobenius norm.

    It has its own derivative, which exists wherever the closest rotation is unique. The singular
    vectors from which it is computed are not differentiable where singular values are equal, as at
    every rotation and at every mean of equal rotations.
    """
    return _orthogonal_factor(matrix, jnp)


def host_nearest_rotation(
    matrix: Float[np.ndarray, "*batch 3 3"],
) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the closest rotations with NumPy, NaN where a matrix is not finite."""
    # NumPy's decomposition raises an error if a matrix is not finite; JAX's returns NaN.
    finite = np.isfinite(matrix).all(axis=(-2, -1), keepdims=True)
    return np.where(finite, _orthogonal_factor(np.where(finite, matrix, np.eye(3)), np), np.nan)


def host_nearest_pose(
    points: Float[np.ndarray, "points 3"], measured: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "4 4"]:
    """Return the pose that brings points nearest to measured ones, by least squares (Kabsch)."""
    middle, target = points.mean(axis=0), measured.mean(axis=0)
    rotation = host_nearest_rotation((measured - target).T @ (points - middle))
    return host_poses(rotation, target - rotation @ middle)


def _orthogonal_factor(matrix: Any, array_module: ModuleType) -> Any:
    """Return the nearest rotation by the singular value decomposition of NumPy or of JAX."""
    # M = U S V^T   gives   R = U diag(1, 1, det(U V^T)) V^T.
    U, _, Vt = array_module.linalg.svd(matrix)
    sign = array_module.linalg.det(U @ Vt)
    ones = array_module.ones_like(sign)
    return (U * array_module.stack([ones, ones, sign], axis=-1)[..., None, :]) @ Vt


@nearest_rotation.defjvp
def _nearest_rotation_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"]]:
    """Return the nearest rotation and its directional derivative."""
    # M = R P with P symmetric (polar decomposition), and dR = R W with W skew-symmetric, give
    #   R^T dM - dM^T R = W P + P W,
    # which for the axial vectors k of the left side and w of W is
    #   k = (trace(P) I - P) w.
    (M,), (dM,) = primals, tangents
    R = nearest_rotation(M)
    P = R.T @ M
    K = R.T @ dM
    k = jnp.stack([K[2, 1] - K[1, 2], K[0, 2] - K[2, 0], K[1, 0] - K[0, 1]])
    w = jnp.linalg.solve(jnp.trace(P) * jnp.eye(3) - P, k)
    return R, jnp.cross(R, w[None])


def mean_pose(
    poses: SE3, weights: Float[Array, "poses"] | Float[np.ndarray, "poses"] | None = None
) -> SE3:
    """Return the chordal mean of poses, computed with NumPy.

    Its rotation is nearest to the weighted mean of the rotation matrices, and its translation is
    the weighted mean of the translations.

    Reference: Hartley, Trumpf, Dai, Li, Rotation averaging, IJCV 103, 2013 (chordal L2 mean).

    Args:
        poses: `(poses)`.
        weights: not negative, not all zero; equal by default.
    """
    matrices = host_matrices(poses)
    return host_transforms(
        mean_matrix(matrices, np.ones(len(matrices)) if weights is None else np.asarray(weights))
    )


def mean_matrix(
    matrices: Float[np.ndarray, "*batch poses 4 4"], weights: Float[np.ndarray, "poses"]
) -> Float[np.ndarray, "*batch 4 4"]:
    """Return the chordal mean of poses as 4x4 matrices; see `mean_pose`."""
    # R = argmin over rotations of sum_i w_i |R_i - R|^2 = nearest_rotation(sum_i w_i R_i),
    # t = sum_i w_i t_i,   with weights w_i that are normalised to the sum 1.
    mean = np.einsum("i,...ijk->...jk", weights / weights.sum(), matrices)
    mean[..., :3, :3] = host_nearest_rotation(mean[..., :3, :3])
    return mean
