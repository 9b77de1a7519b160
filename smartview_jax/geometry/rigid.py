"""Rigid transforms: a thin layer over `jaxlie`, which holds the group and its derivatives.

A transform named `target_from_source` maps points of `source` into `target`. Tangents are
jaxlie's: translation (m) first, then rotation (rad).
"""

from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

PoseLike: TypeAlias = SE3 | Float[Array, "*batch 4 4"] | np.ndarray
"""A rigid transform as this library takes it: an `SE3`, or 4x4 matrices."""


def as_se3(pose: PoseLike) -> SE3:
    """An `SE3` from either form of a rigid transform.

    Matrices are trusted to be rigid here: `check_rigid` is the test at the library's edge. Their
    rounding is removed, though: what jaxlie makes of a matrix of few digits is a quaternion not
    quite of length 1, and that would scale every point it is applied to.
    """
    if isinstance(pose, SE3):
        return pose
    matrix = jnp.asarray(pose, dtype=float)
    if matrix.shape[-2:] != (4, 4):
        raise ValueError(f"a pose is an SE3 or an array (..., 4, 4); found shape {matrix.shape}")
    return SE3.from_matrix(matrix).normalize()


def check_rigid(
    matrices: np.ndarray, labels: tuple[str, ...], tolerance: float = 2e-4
) -> dict[str, str]:
    """What is wrong with each 4x4 matrix, by label; empty where all are rigid transforms.

    Args:
        matrices: `(views, 4, 4)`.
        labels: one name per matrix, used as key of the answer.
        tolerance: largest entry of `R^T R - I` accepted. Four decimals, the fewest in use, make
            it 2 sqrt(3) 0.5e-4 at most.
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


def rotation_angle(rotation: SO3) -> Float[Array, "*batch"]:
    """Angle of a rotation in radians, in [0, pi]; differentiable away from the identity."""
    return jnp.linalg.norm(rotation.log(), axis=-1)


def transform_points(
    target_from_source: SE3, points: Float[Array, "*points 3"]
) -> Float[Array, "*moved 3"]:
    """Points under a batch of transforms `(*batch)`: `(N, 3)` for all, or `(*batch, N, 3)`."""
    rank = len(target_from_source.get_batch_axes()) + 2
    points = points.reshape((1,) * (rank - points.ndim) + points.shape)
    return SE3(target_from_source.wxyz_xyz[..., None, :]).apply(points)


@jax.custom_jvp
def nearest_rotation(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The rotation closest to a matrix in the Frobenius norm.

    Differentiable wherever that rotation is unique; the derivative of the singular vectors is not,
    being undefined at every rotation and every mean of equal rotations.
    """
    U, _, Vt = jnp.linalg.svd(matrix)
    sign = jnp.linalg.det(U @ Vt)
    return (U * jnp.stack([jnp.ones(()), jnp.ones(()), sign])[None]) @ Vt


@nearest_rotation.defjvp
def _nearest_rotation_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"]]:
    """From `M = R P`, P symmetric: `R^T dM - dM^T R = W P + P W`, with `dR = R W`, W skew.

    For the axial vectors of the two sides that is `k = (trace(P) I - P) w`.
    """
    (M,), (dM,) = primals, tangents
    R = nearest_rotation(M)
    P = R.T @ M
    K = R.T @ dM
    k = jnp.stack([K[2, 1] - K[1, 2], K[0, 2] - K[2, 0], K[1, 0] - K[0, 1]])
    w = jnp.linalg.solve(jnp.trace(P) * jnp.eye(3) - P, k)
    return R, jnp.cross(R, w[None])


def mean_pose(poses: SE3, weights: Float[Array, "poses"] | None = None) -> SE3:
    """Chordal mean: nearest rotation to the weighted mean matrix, weighted mean translation.

    Args:
        poses: `(poses)`.
        weights: not negative, not all zero; by default all alike.
    """
    if weights is None:
        weights = jnp.ones(poses.get_batch_axes())
    share = weights / jnp.sum(weights)
    rotation = nearest_rotation(jnp.einsum("i,ijk->jk", share, poses.rotation().as_matrix()))
    return SE3.from_rotation_and_translation(SO3.from_matrix(rotation), share @ poses.translation())


def exp_jacobian(tangent: Float[Array, "6"]) -> Float[Array, "6 6"]:
    """Left Jacobian J of `SE3.exp`: `exp(tangent + d) = exp(J d) @ exp(tangent)` for small d.

    Its last three rows and columns are the left Jacobian of `SO3.exp`.
    """
    start = SE3.exp(tangent).translation()
    moved = jax.jacfwd(lambda t: SE3.exp(t).translation())(tangent)
    # `t = V v`: the derivative by v is V, which is the Jacobian of the rotation as well.
    V = moved[:, :3]
    shift = moved[:, 3:] + jnp.cross(start[None], V.T).T
    return jnp.block([[V, shift], [jnp.zeros((3, 3)), V]])
