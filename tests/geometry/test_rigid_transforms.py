import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax.geometry import (
    as_se3,
    check_rigid,
    host_exponentials,
    mean_pose,
    nearest_rotation,
    transform_points,
)

RNG = np.random.default_rng(0)


@jax.jit
def nearest_and_slopes(matrix, direction):
    """The nearest rotation, its slope in a direction, and the reverse-mode gradient there."""
    actual, slope = jax.jvp(nearest_rotation, (matrix,), (direction,))
    return actual, slope, jax.grad(lambda m: jnp.sum(nearest_rotation(m) * direction))(matrix)


def test_nearest_rotation_is_a_rotation_and_the_nearest():
    matrix = Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix() + 0.1 * RNG.normal(size=(3, 3))
    actual = np.asarray(nearest_and_slopes(matrix, np.eye(3))[0])
    np.testing.assert_allclose(actual @ actual.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(actual) > 0.0
    distance = np.linalg.norm(actual - matrix)
    for turn in 1e-3 * RNG.normal(size=(20, 3)):
        other = Rotation.from_rotvec(turn).as_matrix() @ actual
        assert np.linalg.norm(other - matrix) > distance


def test_nearest_rotation_differentiates_at_a_rotation():
    """There the singular values coincide, so that derivatives of the vectors would be NaN."""
    start = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    direction = RNG.normal(size=(3, 3))
    _, slope, reverse = nearest_and_slopes(start, direction)
    step = 1e-6
    ahead, behind = (
        np.asarray(nearest_and_slopes(start + s * direction, direction)[0]) for s in (step, -step)
    )
    np.testing.assert_allclose(slope, (ahead - behind) / (2.0 * step), atol=1e-8)
    np.testing.assert_allclose(np.sum(reverse * direction), np.sum(slope * direction), rtol=1e-9)


def test_the_mean_pose_is_scipys():
    rotations = Rotation.random(5, random_state=3)
    shifts = RNG.normal(size=(5, 3))
    matrices = np.tile(np.eye(4), (5, 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = rotations.as_matrix(), shifts
    weights = np.array([1.0, 2.0, 0.5, 0.0, 1.0])
    mean = mean_pose(as_se3(matrices), jnp.asarray(weights))
    expected = rotations[[0, 1, 2, 4]].mean(weights[[0, 1, 2, 4]]).as_matrix()
    np.testing.assert_allclose(mean.rotation().as_matrix(), expected, atol=1e-12)
    np.testing.assert_allclose(mean.translation(), np.average(shifts, axis=0, weights=weights))
    plain = mean_pose(as_se3(matrices))
    np.testing.assert_allclose(plain.translation(), shifts.mean(axis=0))


def test_few_digits_do_not_scale_points():
    matrix = np.round(host_exponentials(np.array([0.1, 0.2, 0.3, 0.5, -0.4, 1.2])), 4)
    point = jnp.array([[0.3, -0.2, 0.9]])
    moved = as_se3(matrix) @ point[0] - as_se3(matrix).translation()
    np.testing.assert_allclose(jnp.linalg.norm(moved), jnp.linalg.norm(point), rtol=1e-14)
    assert check_rigid(matrix[None], ("a",)) == {}


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda m: m.at[0, 0].set(jnp.nan), "NaN"),
        (lambda m: m.at[:3, :3].multiply(1.01), "rotation"),
        (lambda m: m.at[:3, 0].multiply(-1.0), "rotation"),
        (lambda m: m.at[3, 3].set(2.0), "row"),
    ],
)
def test_what_is_not_rigid_is_named(spoil, words):
    good = jnp.asarray(host_exponentials(np.array([0.1, 0.2, 0.3, 0.5, -0.4, 1.2])))
    problems = check_rigid(np.stack([good, spoil(good)]), ("good", "bad"))
    assert list(problems) == ["bad"]
    assert words in problems["bad"]


def test_points_are_transformed_as_by_matrices():
    pose = as_se3(host_exponentials(np.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.5])))
    points = jnp.asarray(RNG.normal(size=(4, 3)))
    np.testing.assert_allclose(
        transform_points(pose, points)[2], (pose.as_matrix() @ jnp.append(points[2], 1.0))[:3]
    )
    with pytest.raises(ValueError, match=r"\(\.\.\., 4, 4\); found shape \(3, 3\)"):
        as_se3(np.eye(3))
