"""Compute with rigid transforms as 4x4 matrices in compiled programs, as `host.py` does outside.

A product of two `SE3`, which hold quaternions, is some fifty instructions of XLA, a product of two
matrices a single one; and a program takes as long to compile as it has instructions.
"""

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..runtime.array_namespace import AnyArray, array_namespace
from .left_jacobians import exponential_factors


def pose_matrices(transforms: SE3) -> Float[Array, "*batch 4 4"]:
    """Return transforms `(*batch)`, whose quaternions have length one, as 4x4 matrices."""
    numbers = jnp.asarray(transforms.wxyz_xyz)
    batch, quaternion = numbers.shape[:-1], numbers[..., :4]
    products = quaternion[..., :, None] * quaternion[..., None, :]
    # The entries of a rotation are quadratic forms of the quaternion's numbers.
    linear = jnp.concatenate([products.reshape(*batch, 16), numbers[..., 4:]], axis=-1)
    return (linear @ _ENTRIES).reshape(*batch, 4, 4) + _like(_CORNER, len(batch))


def matrix_exponentials(tangents: Float[Array, "*batch 6"]) -> Float[Array, "*batch 4 4"]:
    """Return the 4x4 matrices of tangents as `SE3.exp` does, translation first."""
    # exp(X) = I + X + (1 - cos t) / t^2 X^2 + (t - sin t) / t^3 X^3, with the angle t
    X = jnp.einsum("...k,kij->...ij", tangents, _GENERATORS)
    b, c = exponential_factors(tangents[..., 3:])
    identity = _like(np.eye(4), tangents.ndim - 1)
    return identity + X @ (identity + X @ (b * identity + c * X))


def shift_matrices(translations: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4 4"]:
    """Return the 4x4 matrices of translations."""
    shifts = jnp.einsum("...k,kij->...ij", translations, _GENERATORS[:3])
    return shifts + _like(np.eye(4), translations.ndim - 1)


def inverse_matrices(matrices: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 4 4"]:
    """Return the inverses of rigid 4x4 matrices."""
    # [R, t; 0, 1]^-1 = [R^T, -R^T t; 0, 1]
    rotation, translation = matrices[..., :3, :3], matrices[..., :3, 3:]
    turned = -jnp.sum(rotation * translation, axis=-2)[..., None]
    upper = jnp.concatenate([jnp.swapaxes(rotation, -1, -2), turned], axis=-1)
    return jnp.concatenate([upper, matrices[..., 3:, :]], axis=-2)


def adjoint_matrices(matrices: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 6 6"]:
    """Return the adjoints of rigid 4x4 matrices as `SE3.adjoint` does, translation first.

    An adjoint moves a twist from the right of the transform to its left.
    """
    # [R, [t] R; 0, R]
    rotation, translation = matrices[..., :3, :3], matrices[..., :3, 3:]
    coupling = jnp.cross(translation, rotation, axis=-2)
    upper = jnp.concatenate([rotation, coupling], axis=-1)
    lower = jnp.concatenate([jnp.zeros_like(rotation), rotation], axis=-1)
    return jnp.concatenate([upper, lower], axis=-2)


def moved_points(
    matrices: Float[Array, "*batch 4 4"], points: Float[Array, "*points N 3"]
) -> Float[Array, "*moved N 3"]:
    """Return points, N for each transform of a batch, after the transforms; batches broadcast."""
    rotation, translation = matrices[..., :3, :3], matrices[..., None, :3, 3]
    return jnp.asarray(points) @ jnp.swapaxes(rotation, -1, -2) + translation


def transforms_of(matrices: Float[Array, "*batch 4 4"]) -> SE3:
    """Return rigid 4x4 matrices as transforms, the inverse of `pose_matrices`."""
    # With the forms F_ij of a rotation's entries R_ij, 4 q q^T = I + sum_ij R_ij F_ij. A row is the
    # quaternion q times four of one of its numbers; the row of the largest is taken.
    batch = matrices.shape[:-2]
    flat = matrices[..., :3, :3].reshape(*batch, 9)
    products = (flat @ _ROTATION_FORMS).reshape(*batch, 4, 4) + _like(np.eye(4), len(batch))
    largest = jnp.argmax(jnp.diagonal(products, axis1=-2, axis2=-1), axis=-1)
    row = jnp.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :]
    quaternion = row / jnp.linalg.norm(row, axis=-1, keepdims=True)
    return SE3(jnp.concatenate([quaternion, matrices[..., :3, 3]], axis=-1))


def quaternion_product(
    first: Float[AnyArray, "*batch 4"], second: Float[AnyArray, "*batch 4"]
) -> Float[AnyArray, "*batch 4"]:
    """Return the products of quaternions of any length, real part first."""
    xp = array_namespace(first, second)
    return xp.einsum("...i,ijk,...j->...k", first, _QUATERNION_PRODUCT, second)


def _like(matrix: Float[np.ndarray, "rows columns"], axes: int) -> Float[Array, "..."]:
    """Return a matrix with so many axes of length one in front."""
    return jnp.asarray(matrix.reshape((1,) * axes + matrix.shape))


def _rotation_forms() -> Float[np.ndarray, "9 16"]:
    """Return the quadratic forms of a unit quaternion's numbers that are a rotation's entries."""
    # R = (w^2 - v.v) I + 2 v v^T + 2 w [v], with the vector part v = (x, y, z).
    w, *vector = np.eye(4)
    product = np.multiply.outer
    forms = np.zeros((3, 3, 4, 4))
    for i in range(3):
        forms[i, i] = product(w, w) - sum(product(part, part) for part in vector)
        for j in range(3):
            forms[i, j] += 2.0 * product(vector[i], vector[j])
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        forms[j, i] += 2.0 * product(w, vector[k])
        forms[i, j] -= 2.0 * product(w, vector[k])
    return 0.5 * (forms + forms.swapaxes(2, 3)).reshape(9, 16)


def _quaternion_product() -> Float[np.ndarray, "4 4 4"]:
    """Return the products of the units of quaternions: by the first, by the second, and numbers."""
    # (a, u)(b, v) = (a b - u.v, a v + b u + u x v)
    products = np.zeros((4, 4, 4))
    products[:, :, 0] = np.diag([1.0, -1.0, -1.0, -1.0])
    for k in (1, 2, 3):
        products[0, k, k] = products[k, 0, k] = 1.0
    for i, j, k in ((1, 2, 3), (2, 3, 1), (3, 1, 2)):
        products[i, j, k], products[j, i, k] = 1.0, -1.0
    return products


def _generators() -> Float[np.ndarray, "6 4 4"]:
    """Return the 4x4 matrices of the unit tangents, translations first."""
    generators = np.zeros((6, 4, 4))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        generators[k, k, 3] = 1.0
        generators[3 + k, j, i], generators[3 + k, i, j] = 1.0, -1.0
    return generators


_QUATERNION_PRODUCT = _quaternion_product()

_GENERATORS = _generators()

_ROTATION_FORMS = _rotation_forms()

_CORNER = np.diag([0.0, 0.0, 0.0, 1.0])
"""The part of a rigid matrix that is the same for all."""

_ENTRIES = np.zeros((19, 4, 4))
_ENTRIES[:16, :3, :3] = _ROTATION_FORMS.T.reshape(16, 3, 3)
_ENTRIES[16:, :3, 3] = np.eye(3)
_ENTRIES = _ENTRIES.reshape(19, 16)
"""The entries of a matrix by the products of a quaternion's numbers, and by the translation."""
