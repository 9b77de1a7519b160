import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from scipy.spatial.transform import Rotation

from smartview_jax.geometry import (
    host_exponentials,
    host_inverse_left_jacobians,
    host_logarithms,
    host_matrices,
    host_nearest_rotation,
    host_pairwise_rotation_angles,
    host_poses,
    host_rotation_angles,
    host_rotation_vectors,
    host_rotations_between,
    host_transformed,
    host_transforms,
    nearest_rotation,
    transform_points,
)

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-4, 0.3, 3.1])
def test_host_functions_agree_with_jaxlie(size):
    axis = RNG.normal(size=(2, 3))
    tangents = np.concatenate(
        [RNG.normal(size=(2, 3)), size * axis / np.linalg.norm(axis, axis=1, keepdims=True)], axis=1
    )
    poses = SE3.exp(jnp.asarray(tangents))
    matrices = host_matrices(poses)
    np.testing.assert_allclose(matrices, poses.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(host_logarithms(matrices), tangents, atol=1e-13)
    np.testing.assert_allclose(host_exponentials(tangents), matrices, atol=1e-14)
    np.testing.assert_allclose(host_transforms(matrices).as_matrix(), matrices, atol=1e-14)


def test_rotation_vectors_are_scipys_up_to_half_a_turn():
    axes = np.concatenate([RNG.normal(size=(20, 3)), np.eye(3), -np.eye(3)])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.array([[1e-9], [1e-3], [2.0], [3.0], [np.pi - 1e-6]])[:, None]
    turns = Rotation.from_rotvec((angles * axes).reshape(-1, 3))
    vectors = host_rotation_vectors(turns.as_matrix())
    np.testing.assert_allclose(vectors, turns.as_rotvec(), atol=1e-14)
    # At half a turn the axis may have either sign.
    half = host_rotation_vectors(Rotation.from_rotvec(np.pi * axes).as_matrix())
    np.testing.assert_allclose(np.abs(half), np.abs(np.pi * axes), atol=1e-7)


@pytest.mark.parametrize(
    "wrong",
    [
        np.diag([1.0, 1.0, -1.0]),
        np.diag([1.0, 1.0, np.inf]),
        np.full((3, 3), np.nan),
        np.zeros((3, 3)),
    ],
)
def test_what_is_no_rotation_has_no_rotation_vector(wrong):
    with pytest.raises(ValueError, match="mirrored, singular or not finite"):
        host_rotation_vectors(np.stack([np.eye(3), wrong]))


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 0.3, np.pi])
def test_angles_between_rotations_keep_their_digits(angle):
    axis = np.array([[1.0, 0.0, 0.0], [0.6, 0.0, 0.8]])
    turned = host_exponentials(np.concatenate([np.ones((2, 3)), angle * axis], axis=1))
    start = host_exponentials(RNG.normal(size=(2, 6)))
    angles = host_rotation_angles(start @ turned, start)
    # The chord changes little with the angle near half a turn.
    np.testing.assert_allclose(angles, angle, rtol=1e-7, atol=1e-15)
    assert host_rotation_angles(start[:, None], start).shape == (2, 2)


def test_angles_between_every_two_rotations_are_scipys():
    first, second = host_exponentials(RNG.normal(size=(2, 3, 6)))
    of_second = Rotation.from_matrix(second[:, :3, :3])
    expected = [(Rotation.from_matrix(R) * of_second.inv()).magnitude() for R in first[:, :3, :3]]
    np.testing.assert_allclose(host_pairwise_rotation_angles(first, second), expected, atol=1e-7)


@pytest.mark.parametrize("length", [0.0, 1e-6, 0.3, 3.0])
def test_a_small_turn_changes_a_rotation_vector_by_the_inverse_left_jacobian(length):
    vectors = RNG.normal(size=(4, 3))
    vectors *= length / np.linalg.norm(vectors, axis=1, keepdims=True)
    step = 1e-5
    turns = Rotation.from_rotvec(np.repeat(step * np.concatenate([np.eye(3), -np.eye(3)]), 4, 0))
    turned = (turns * Rotation.from_rotvec(np.tile(vectors, (6, 1)))).as_rotvec()
    forward, backward = turned.reshape(2, 3, 4, 3)
    expected = (forward - backward).transpose(1, 2, 0) / (2.0 * step)
    np.testing.assert_allclose(host_inverse_left_jacobians(vectors), expected, atol=1e-8)


def test_poses_that_are_not_finite_stay_marked_and_spoil_no_others():
    numbers = np.tile([1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3], (3, 1))
    numbers[1, 5] = np.nan
    matrices = host_matrices(SE3(jnp.asarray(numbers)))
    missing = [[False], [True], [False]]
    for actual in (
        host_transforms(matrices).wxyz_xyz,
        host_logarithms(matrices),
        host_nearest_rotation(matrices[:, :3, :3]).reshape(3, 9),
    ):
        np.testing.assert_array_equal(np.isnan(actual), np.broadcast_to(missing, actual.shape))


@pytest.mark.filterwarnings("error")
def test_a_quaternion_of_zeros_is_no_rotation_and_spoils_no_others():
    """Trackers write it where they see nothing."""
    numbers = np.array([[0.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3], [2.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3]])
    matrices = host_matrices(SE3(jnp.asarray(numbers)))
    assert np.isnan(matrices[0]).all()
    np.testing.assert_array_equal(matrices[1, :3], np.c_[np.eye(3), [0.1, 0.2, 0.3]])


def test_the_nearest_rotation_on_the_host_is_that_of_jax():
    matrices = RNG.normal(size=(4, 3, 3))
    actual = host_nearest_rotation(matrices)
    for matrix, rotation in zip(matrices, actual, strict=True):
        np.testing.assert_allclose(rotation, nearest_rotation(jnp.asarray(matrix)), atol=1e-13)


def test_host_points_are_moved_as_jaxlie_moves_them():
    poses = SE3.exp(jnp.asarray(RNG.normal(size=(3, 6))))
    points = RNG.normal(size=(5, 3))
    matrices, expected = host_matrices(poses), np.asarray(transform_points(poses, points))
    np.testing.assert_allclose(host_transformed(matrices, points), expected, atol=1e-14)
    np.testing.assert_allclose(host_transformed(matrices[1], points), expected[1], atol=1e-14)
    np.testing.assert_allclose(host_transformed(matrices[1], points[2]), expected[1, 2], atol=1e-14)


def test_poses_are_put_together_from_rotations_and_translations():
    tangents = 0.5 * np.random.default_rng(1).normal(size=(2, 3, 6))
    expected = np.asarray(SE3.exp(jnp.asarray(tangents)).as_matrix())
    rotations, translations = expected[..., :3, :3], expected[..., :3, 3]
    np.testing.assert_array_equal(host_poses(rotations, translations), expected)
    # Batches broadcast.
    many = host_poses(rotations, translations[0, 0])
    np.testing.assert_array_equal(many[1, 2] @ [0.0, 0.0, 0.0, 1.0], [*translations[0, 0], 1.0])
    np.testing.assert_array_equal(many[1, 2, :3, :3], rotations[1, 2])
    for matrices in (expected, rotations):
        np.testing.assert_allclose(host_rotation_vectors(matrices), tangents[..., 3:], atol=1e-14)


def test_the_smallest_rotation_between_directions_is_scipys_also_of_opposite_ones():
    ends = RNG.normal(size=(5, 3))
    ends /= np.linalg.norm(ends, axis=1, keepdims=True)
    ends = np.concatenate([ends, [[0.0, 0.0, 1.0], [1e-7, 0.0, -1.0]]])
    starts = np.tile([0.0, 0.0, 1.0], (len(ends), 1))
    for end, rotation in zip(ends, host_rotations_between(starts, ends), strict=True):
        expected = Rotation.align_vectors(end[None], starts[:1])[0].as_matrix()
        np.testing.assert_allclose(rotation, expected, atol=1e-7)
    # Of nearly opposite ones rounding turns the axis, but leaves a rotation.
    off = np.array([1e-7, 3e-6, 1e-4])
    nearly = np.stack([np.zeros(3), np.sin(off), -np.cos(off)], axis=1)
    for end, turned in zip(nearly, host_rotations_between(starts[:3], nearly), strict=True):
        np.testing.assert_allclose(turned @ starts[0], end, atol=1e-8)
        np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-12)
    for start in np.concatenate([ends[:3], np.eye(3)]):
        across = np.cross(start, [0.6, 0.0, 0.8])
        for angle in (0.0, 1e-9, 3e-6, 1e-4):
            end = angle * across - start
            end /= np.linalg.norm(end)
            (turned,) = host_rotations_between(start[None], end[None])
            np.testing.assert_allclose(turned @ start, end, atol=3e-8)
            np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=3e-8)
            assert np.linalg.det(turned) == pytest.approx(1.0)
