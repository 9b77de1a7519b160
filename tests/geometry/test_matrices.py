import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from smartview_jax.geometry import (
    adjoint_matrices,
    inverse_matrices,
    matrix_exponentials,
    moved_points,
    pose_matrices,
    quaternion_product,
    shift_matrices,
    transforms_of,
)

RNG = np.random.default_rng(0)

# Small rotations, half a turn about each axis and one between, and some smaller ones.
HALF_TURNS = np.pi * np.array(
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.6, -0.48, 0.64]]
)
VECTORS = np.concatenate([1e-7 * np.eye(3), HALF_TURNS, RNG.normal(size=(6, 3))])
ROTATIONS = Rotation.from_rotvec(VECTORS)
TRANSLATIONS = RNG.normal(size=(len(VECTORS), 3))


def rigid_matrices():
    """The 4x4 matrices of the rotations and translations, by SciPy."""
    matrices = np.tile(np.eye(4), (len(VECTORS), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = ROTATIONS.as_matrix(), TRANSLATIONS
    return matrices


def transforms():
    """The same as quaternions, by SciPy."""
    x, y, z, w = ROTATIONS.as_quat().T
    return SE3(jnp.asarray(np.column_stack([w, x, y, z, TRANSLATIONS])))


@jax.jit
def forms(transforms):
    """All forms of transforms, in one program."""
    matrices = pose_matrices(transforms)
    return (
        matrices,
        inverse_matrices(matrices),
        adjoint_matrices(matrices),
        transforms_of(matrices).wxyz_xyz,
    )


def test_matrices_are_scipys_and_numpys():
    matrices, inverses, adjoints, numbers = map(np.asarray, forms(transforms()))
    expected = rigid_matrices()
    np.testing.assert_allclose(matrices, expected, atol=1e-15)
    np.testing.assert_allclose(inverses, np.linalg.inv(expected), atol=1e-14)
    for matrix, adjoint in zip(expected, adjoints, strict=True):
        # T exp(xi) T^-1 = exp(Ad xi), to first order in xi.
        for generator, column in zip(np.eye(6), adjoint.T, strict=True):
            moved = matrix @ tangent_matrix(generator) @ np.linalg.inv(matrix)
            np.testing.assert_allclose(tangent_matrix(column), moved, atol=1e-14)
    before = np.asarray(transforms().wxyz_xyz)
    signs = np.sign(np.sum(numbers[:, :4] * before[:, :4], axis=1, keepdims=True))
    np.testing.assert_allclose(numbers[:, :4] * signs, before[:, :4], atol=1e-15)
    np.testing.assert_array_equal(numbers[:, 4:], TRANSLATIONS)


def tangent_matrix(tangent):
    """The 4x4 matrix of a tangent, translation first."""
    matrix = np.zeros((4, 4))
    # The k-th column of the matrix of the cross product with w is w x e_k.
    matrix[:3, :3], matrix[:3, 3] = np.cross(tangent[3:], np.eye(3)).T, tangent[:3]
    return matrix


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.4999, 0.5001, 3.0, 7.0])
def test_exponentials_are_scipys(angle):
    tangent = np.r_[RNG.normal(size=3), angle * np.array([0.6, -0.48, 0.64])]
    actual = np.asarray(matrix_exponentials(jnp.asarray(tangent)))
    np.testing.assert_allclose(actual, expm(tangent_matrix(tangent)), atol=2e-14)


def test_exponentials_are_differentiable_at_zero():
    """A fit begins there; the slope is the tangent's own matrix."""
    slopes = np.asarray(jax.jit(jax.jacrev(matrix_exponentials))(jnp.zeros(6)))
    expected = np.stack([tangent_matrix(unit) for unit in np.eye(6)], axis=-1)
    np.testing.assert_allclose(slopes, expected, atol=1e-15)


def test_shifts_and_points():
    points = RNG.normal(size=(1, 5, 3))
    shifted = shift_matrices(jnp.asarray(TRANSLATIONS))
    np.testing.assert_array_equal(shifted[:, :3, 3], TRANSLATIONS)
    moved = moved_points(jnp.asarray(rigid_matrices()), jnp.asarray(points))
    expected = np.stack([turn.apply(points[0]) for turn in ROTATIONS]) + TRANSLATIONS[:, None]
    np.testing.assert_allclose(moved, expected, atol=1e-14)


def test_products_of_quaternions_are_scipys():
    first, second = Rotation.random(5, random_state=1), Rotation.random(5, random_state=2)
    numbers = [jnp.asarray(np.roll(turn.as_quat(), 1, axis=1)) for turn in (first, second)]
    actual = np.asarray(quaternion_product(*numbers))
    expected = np.roll((first * second).as_quat(), 1, axis=1)
    expected *= np.sign(np.sum(actual * expected, axis=1, keepdims=True))
    np.testing.assert_allclose(actual, expected, atol=1e-15)
