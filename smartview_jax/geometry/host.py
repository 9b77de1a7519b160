"""Compute with rigid transforms as NumPy matrices, without compiling a JAX program."""

import numpy as np
from jaxlie import SE3
from jaxtyping import Float


def host_matrices(poses: SE3) -> Float[np.ndarray, "*batch 4 4"]:
    """Return transforms `(*batch)` as 4x4 matrices.

    A matrix is NaN where a transform is not finite, or where its quaternion is zero.
    """
    numbers = np.asarray(poses.wxyz_xyz)
    given = np.isfinite(numbers).all(axis=-1) & numbers[..., :4].any(axis=-1)
    if given.all():
        return host_poses(_rotations_of_quaternions(numbers[..., :4]), numbers[..., 4:])
    matrices = np.full((*numbers.shape[:-1], 4, 4), np.nan)
    rotations = _rotations_of_quaternions(numbers[given][:, :4])
    matrices[given] = host_poses(rotations, numbers[given][:, 4:])
    return matrices


def _rotations_of_quaternions(
    wxyz: Float[np.ndarray, "*batch 4"],
) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the rotation matrices of quaternions, real part first, of any length but zero."""
    # R = I + 2 (w [v] + [v]^2) / |q|^2 for q = (w, v), with [v] the matrix of v x. The entries of
    # the second term are sums of products of two of the four numbers: for a few poses one product
    # of matrices takes half as long as the formula.
    products = (wxyz[..., :, None] * wxyz[..., None, :]).reshape(*wxyz.shape[:-1], 16)
    turned = (products @ _TURNED_BY_PRODUCTS).reshape(*wxyz.shape[:-1], 3, 3)
    return np.eye(3) + turned / np.vecdot(wxyz, wxyz)[..., None, None]


def host_poses(
    rotations: Float[np.ndarray, "*rotations 3 3"],
    translations: Float[np.ndarray, "*translations 3"],
) -> Float[np.ndarray, "*batch 4 4"]:
    """Return the rigid 4x4 matrices of rotations and translations, whose batches broadcast."""
    batch = np.broadcast_shapes(rotations.shape[:-2], translations.shape[:-1])
    matrices = np.zeros((*batch, 4, 4))
    matrices[..., :3, :3], matrices[..., :3, 3] = rotations, translations
    matrices[..., 3, 3] = 1.0
    return matrices


def host_rotation_vectors(
    matrices: Float[np.ndarray, "*batch rows rows"],
) -> Float[np.ndarray, "*batch 3"]:
    """Return the rotation vectors of rotations or of rigid 4x4 matrices, rad.

    Raises:
        ValueError: a matrix that is not finite, mirrored or singular.
    """
    rotations = matrices[..., :3, :3].reshape(-1, 3, 3)
    if not np.isfinite(rotations).all() or not (np.linalg.det(rotations) > 0.0).all():
        raise ValueError(
            "expected rotations, found a matrix that is mirrored, singular or not finite"
        )
    return _rotation_vectors(rotations).reshape(*matrices.shape[:-2], 3)


def _rotation_vectors(rotations: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the rotation vectors of rotations, rad."""
    # SciPy first looks for the nearest rotations, which takes several times as long.
    quaternions = _quaternions(rotations)
    real, imaginary = quaternions[:, :1], quaternions[:, 1:]
    length = np.linalg.norm(imaginary, axis=1, keepdims=True)
    # A quaternion and its negative are one rotation, by an angle of at most half a turn.
    half_angle = np.arctan2(length, np.abs(real))
    per_length = np.where(length > 0.0, 2.0 * half_angle / np.where(length > 0.0, length, 1.0), 2.0)
    return np.copysign(per_length, real) * imaginary


def host_transforms(matrices: Float[np.ndarray, "*batch 4 4"]) -> SE3:
    """Return rigid 4x4 matrices as transforms `(*batch)` of NumPy arrays, the inverse conversion.

    A transform is NaN where its matrix is not finite.
    """
    numbers = np.full((*matrices.shape[:-2], 7), np.nan)
    finite = np.isfinite(matrices).all(axis=(-2, -1))
    numbers[finite] = _transform_numbers(matrices[finite])
    return SE3(numbers)  # pyright: ignore[reportArgumentType]


def _transform_numbers(matrices: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 7"]:
    """Return the numbers `wxyz_xyz` of matrices: a unit quaternion and a translation.

    SciPy is not used: for a matrix of few digits it returns the nearest rotation, which differs
    from jaxlie's result, and it refuses the mirrored matrices that masked views may have.
    """
    return np.hstack([_quaternions(matrices[:, :3, :3]), matrices[:, :3, 3]])


def _quaternions(R: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 4"]:
    """Return the unit quaternions of rotations, real part first, with the signs that jaxlie has."""
    # 4 q q^T of the unit quaternion q: each row is 4 w, 4 x, 4 y or 4 z times the quaternion.
    rows = (R.reshape(-1, 9) @ _ROWS_BY_ENTRIES).reshape(-1, 4, 4) + np.eye(4)
    # The row is chosen as in jaxlie, so that it is far from zero.
    first, second, third = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    chosen = np.where(third < 0.0, np.where(first > second, 1, 2), np.where(first < -second, 3, 0))
    quaternions = rows[np.arange(len(R)), chosen]
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def _turned_by_products() -> Float[np.ndarray, "16 9"]:
    """Return the matrix from the 16 products of `(w, v)` to the entries of `2 (w [v] + [v]^2)`."""
    by_products = np.zeros((4, 4, 3, 3))
    basis = np.eye(3)
    # The columns of [v] are v x e_i, and [v]^2 is v v^T - |v|^2 I.
    for k in range(3):
        by_products[0, k + 1] = 2.0 * np.cross(basis[k], basis).T
        by_products[k + 1, k + 1] -= 2.0 * basis
        for j in range(3):
            by_products[k + 1, j + 1] += 2.0 * np.outer(basis[k], basis[j])
    return by_products.reshape(16, 9)


_TURNED_BY_PRODUCTS = _turned_by_products()


def _rows_by_entries() -> Float[np.ndarray, "9 16"]:
    """Return the matrix from the entries of a rotation to the products of its quaternion.

    The products are the 4x4 matrix `4 q q^T - I` of the quaternion `q = (w, x, y, z)`.
    """
    by_entry = np.zeros((3, 3, 4, 4))
    for k in range(3):
        by_entry[k, k, np.arange(4), np.arange(4)] = -1.0
        by_entry[k, k, [0, k + 1], [0, k + 1]] = 1.0
    for i, j, axis in ((2, 1, 1), (0, 2, 2), (1, 0, 3)):
        for row, column in ((0, axis), (axis, 0)):
            by_entry[i, j, row, column], by_entry[j, i, row, column] = 1.0, -1.0
        for row, column in ((i + 1, j + 1), (j + 1, i + 1)):
            by_entry[i, j, row, column] = by_entry[j, i, row, column] = 1.0
    return by_entry.reshape(9, 16)


_ROWS_BY_ENTRIES = _rows_by_entries()


def host_logarithms(matrices: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 6"]:
    """Return the tangents of rigid 4x4 matrices as `SE3.log` does, translation first.

    A tangent is NaN where its matrix is not finite.
    """
    tangents = np.full((*matrices.shape[:-2], 6), np.nan)
    finite = np.isfinite(matrices).all(axis=(-2, -1))
    if finite.any():
        t = matrices[finite][:, :3, 3]
        w = _rotation_vectors(matrices[finite][:, :3, :3])
        # The translation t is V v of the tangent (v, w), with V the left Jacobian at w.
        turned = np.cross(w, t)
        factor = _inverse_left_jacobian_factors(w)
        tangents[finite] = np.concatenate(
            [t - 0.5 * turned + factor * np.cross(w, turned), w], axis=1
        )
    return tangents


def host_inverse_left_jacobians(
    vectors: Float[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the inverse left Jacobians of `SO3.exp` at rotation vectors (rad).

    For small d, `log(exp(d) @ exp(vector)) = vector + inverse @ d`.
    """
    cross = host_cross_matrices(vectors)
    factors = _inverse_left_jacobian_factors(vectors)[..., None]
    return np.eye(3) - 0.5 * cross + factors * (cross @ cross)


def _inverse_left_jacobian_factors(
    vectors: Float[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch 1"]:
    """Return the factor of `[vector]^2` in the inverse left Jacobian."""
    # J^-1 = I - [w] / 2 + (1 - h cot h) [w]^2 / angle^2, with [w] the matrix of w x and h half the
    # angle. At angle zero the last term is exactly zero, whatever the divisor.
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    factors = 1.0 - np.cos(0.5 * angle) / np.sinc(0.5 * angle / np.pi)
    return factors / np.where(angle > 0.0, angle, 1.0) ** 2


def host_rotation_angles(
    first: Float[np.ndarray, "*batch 4 4"], second: Float[np.ndarray, "*others 4 4"]
) -> Float[np.ndarray, "*both"]:
    """Return the angles between the rotations of poses whose batches broadcast, rad.

    By the chord |A - B| = 2 sqrt(2) sin(angle / 2), which keeps the digits of small angles that the
    cosine loses.
    """
    chord = np.linalg.norm(first[..., :3, :3] - second[..., :3, :3], axis=(-2, -1))
    return np.asarray(2.0 * np.arcsin(np.clip(chord / np.sqrt(8.0), 0.0, 1.0)))


def host_pairwise_rotation_angles(
    first: Float[np.ndarray, "n 4 4"], second: Float[np.ndarray, "m 4 4"]
) -> Float[np.ndarray, "n m"]:
    """Return the angles between the rotations of every two poses, rad.

    By `2 cos(angle) + 1 = trace(R S^T)`, the sum of the products of their entries: one product of
    matrices for any number of pairs, to some 1e-8 rad.
    """
    R, S = (poses[:, :3, :3].reshape(len(poses), 9) for poses in (first, second))
    return np.arccos(np.clip(0.5 * (R @ S.T - 1.0), -1.0, 1.0))


def host_exponentials(tangents: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Return the rigid 4x4 matrices of tangents as `SE3.exp` does, translation first."""
    v, w = tangents[..., :3], tangents[..., 3:]
    angle = np.linalg.norm(w, axis=-1, keepdims=True)
    # R = I + s [w] + b [w]^2 and t = V v = v + b w x v + c w x (w x v), with s = sin a / a,
    # b = (1 - cos a) / a^2 and c = (a - sin a) / a^3 for the angle a; near zero c is the start of
    # its Taylor series.
    s = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    safe = np.where(angle > 1e-3, angle, 1.0)
    c = np.where(angle > 1e-3, (safe - np.sin(safe)) / safe**3, 1.0 / 6.0 - angle**2 / 120.0)
    # NumPy's function for cross products takes five times as long for few vectors.
    cross = host_cross_matrices(w)
    turned = cross @ v[..., None]
    rotations = np.eye(3) + s[..., None] * cross + b[..., None] * (cross @ cross)
    translations = v + b * turned[..., 0] + c * (cross @ turned)[..., 0]
    return host_poses(rotations, translations)


def host_transformed(
    target_from_source: Float[np.ndarray, "*batch 4 4"], points: Float[np.ndarray, "*points 3"]
) -> Float[np.ndarray, "*transformed 3"]:
    """Apply rigid 4x4 matrices to points, as `transform_points` applies transforms.

    Args:
        target_from_source: `(*batch)` matrices.
        points: `(N, 3)`, the same for all matrices, or `(*batch, N, 3)`; or one point `(3,)` for
            one matrix.
    """
    R, t = target_from_source[..., :3, :3], target_from_source[..., :3, 3]
    return points @ R.swapaxes(-1, -2) + (t if points.ndim == 1 else t[..., None, :])


def host_cross_matrices(
    vectors: Float[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the matrices of the vector product with vectors from the left."""
    entries = np.zeros((*vectors.shape[:-1], 9))
    entries[..., _CROSS_ENTRIES[0]], entries[..., _CROSS_ENTRIES[1]] = vectors, -vectors
    return entries.reshape(*vectors.shape, 3)


_CROSS_ENTRIES = [7, 2, 3], [5, 6, 1]
"""Where a cross matrix has x, y and z, and where -x, -y and -z: indices of entries, row by row."""


def host_rotations_between(
    start: Float[np.ndarray, "n 3"], end: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3 3"]:
    """Return the smallest rotations that take unit vectors to others; of opposite ones, any."""
    # Half a turn about the start, which leaves it, and one about the axis half-way to the end.
    middle = start + end
    opposite = np.linalg.norm(middle, axis=1) < 1e-8
    if opposite.any():
        nearest = np.eye(3)[np.argmin(np.abs(start[opposite]), axis=1)]
        middle[opposite] = np.cross(start[opposite], nearest)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    return _half_turns(middle) @ _half_turns(start)


def _half_turns(axes: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Return the rotations by half a turn about unit vectors."""
    return 2.0 * axes[:, :, None] * axes[:, None, :] - np.eye(3)


def host_adjoints(matrices: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 6 6"]:
    """Return the adjoints of rigid 4x4 matrices as `SE3.adjoint` does, translation first.

    An adjoint moves a twist from one side of the transform to the other:
    `T exp(xi) = exp(adjoint xi) T`.
    """
    R, t = matrices[..., :3, :3], matrices[..., :3, 3]
    # The adjoint is [[R, [t] R], [0, R]].
    adjoints = np.zeros((*matrices.shape[:-2], 6, 6))
    adjoints[..., :3, :3] = adjoints[..., 3:, 3:] = R
    adjoints[..., :3, 3:] = host_cross_matrices(t) @ R
    return adjoints
