"""Check, apply, average and differentiate rigid transforms, as a thin layer over `jaxlie`.

The library `jaxlie` provides the group SE(3) and its derivatives. A transform named
`target_from_source` maps points of `source` into `target`. Tangents are jaxlie's: translation (m)
first, then rotation (rad).
"""

from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

PoseLike: TypeAlias = SE3 | Float[Array, "*batch 4 4"] | np.ndarray
"""Type of a rigid transform in the arguments of this library: an `SE3`, or 4x4 matrices."""


def as_se3(pose: PoseLike) -> SE3:
    """Return a rigid transform as an `SE3`, whether it is given as one or as 4x4 matrices.

    Matrices are assumed to be rigid here; `check_rigid` tests them where they enter the library.
    Their rounding error is removed: from a matrix of few digits jaxlie computes a quaternion whose
    length is not quite 1, which would scale every point that it is applied to.

    Raises:
        ValueError: an array whose last two axes are not 4 and 4.
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
    """Return an error text for each 4x4 matrix that is not a rigid transform, by its label.

    Args:
        matrices: `(views, 4, 4)`.
        labels: one name per matrix, the key in the result.
        tolerance: largest accepted entry of `R^T R - I`. Matrices written with four decimals, the
            fewest in use, have at most 2 sqrt(3) 0.5e-4.

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


def rotation_angle(rotation: SO3) -> Float[Array, "*batch"]:
    """Return the angle of a rotation, in [0, pi] rad; it is differentiable except at angle zero."""
    return jnp.linalg.norm(rotation.log(), axis=-1)


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
    return SE3(target_from_source.wxyz_xyz[..., None, :]).apply(points)


@jax.custom_jvp
def nearest_rotation(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Return the rotation that is closest to a matrix in the Frobenius norm.

    It has its own derivative, which exists wherever the closest rotation is unique. The singular
    vectors that it is computed from are not differentiable where singular values are equal, which
    they are at every rotation and at every mean of equal rotations.
    """
    # M = U S V^T   gives   R = U diag(1, 1, det(U V^T)) V^T.
    U, _, Vt = jnp.linalg.svd(matrix)
    sign = jnp.linalg.det(U @ Vt)
    return (U * jnp.stack([jnp.ones(()), jnp.ones(()), sign])[None]) @ Vt


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


def mean_pose(poses: SE3, weights: Float[Array, "poses"] | None = None) -> SE3:
    """Return the chordal mean of poses.

    Its rotation is the one nearest to the weighted mean of the rotation matrices, and its
    translation the weighted mean of the translations.

    Reference: Hartley, Trumpf, Dai, Li, Rotation averaging, IJCV 103, 2013 (chordal L2 mean).

    Args:
        poses: `(poses)`.
        weights: not negative, not all zero; equal by default.
    """
    # R = argmin over rotations of sum_i w_i |R_i - R|^2 = nearest_rotation(sum_i w_i R_i),
    # t = sum_i w_i t_i,   with weights w_i that are normalised to the sum 1.
    if weights is None:
        weights = jnp.ones(poses.get_batch_axes())
    normalised_weights = weights / jnp.sum(weights)
    rotation = nearest_rotation(
        jnp.einsum("i,ijk->jk", normalised_weights, poses.rotation().as_matrix())
    )
    return SE3.from_rotation_and_translation(
        SO3.from_matrix(rotation), normalised_weights @ poses.translation()
    )


def se3_left_jacobian(tangent: Float[Array, "6"]) -> Float[Array, "6 6"]:
    """Return the left Jacobian J of `SE3.exp` at a tangent.

    For small d, `exp(tangent + d) = exp(J d) @ exp(tangent)`. The last three rows and columns of J
    are the left Jacobian of `SO3.exp`.
    """
    # exp(v, w) = (t, R) with t = V(w) v, and dR = [V dw]x R. Applying exp(J d) on the left changes
    # the translation by (J d)_t + (J d)_w x t, so that
    #   J = [ V   dt/dw + [t]x V ]
    #       [ 0   V              ]
    # Only the translation is differentiated: dt/dv is V itself.
    translation = SE3.exp(tangent).translation()
    translation_jacobian = jax.jacfwd(lambda t: SE3.exp(t).translation())(tangent)
    V = translation_jacobian[:, :3]
    upper_right = translation_jacobian[:, 3:] + jnp.cross(translation[None], V.T).T
    return jnp.block([[V, upper_right], [jnp.zeros((3, 3)), V]])
