"""Hand-eye transforms of motions that tell little: what they leave open stays where it starts."""

import numpy as np
import pytest

from smartview_jax.geometry import host_exponentials, host_transforms
from smartview_jax.hand_eye import solve_hand_eye

HAND = host_exponentials(np.array([0.03, 0.06, 0.1, 0.2, -1.5, 1.0]))
WORLD = host_exponentials(np.array([0.5, 0.1, 0.02, 2.0, 0.5, -1.0]))


def motion(turns):
    """Robot and camera poses, the latter with some noise, for twists of the robot's base."""
    rng = np.random.default_rng(1)
    robot = host_exponentials(turns) @ host_exponentials(np.array([0.4, 0, 0.3, 1.0, 2.0, 0.5]))
    noise = rng.normal(size=(len(turns), 6)) * 1e-4
    camera = HAND @ np.linalg.inv(robot) @ WORLD @ host_exponentials(noise)
    return host_transforms(np.linalg.inv(robot)), host_transforms(camera)


@pytest.fixture(scope="module")
def about_z():
    rng = np.random.default_rng(0)
    turns = np.zeros((15, 6))
    turns[:, :3], turns[:, 5] = rng.uniform(-0.1, 0.1, (15, 3)), rng.uniform(-1.0, 1.0, 15)
    return motion(turns)


def test_one_axis_leaves_the_target_at_the_height_of_the_base(about_z):
    result = solve_hand_eye(*about_z)
    assert result.best_starts == ("minimum norm", "minimum norm")
    world = np.asarray(result.holder_from_world.as_matrix())
    assert abs(world[2, 3]) < 1e-9
    np.testing.assert_allclose(world[:2, 3], WORLD[:2, 3], atol=5e-4)
    np.testing.assert_allclose(world[:3, :3], WORLD[:3, :3], atol=2e-3)


def test_a_camera_on_a_hand_is_put_near_it(about_z):
    """Camera and target may slide together along z: the camera comes to its nearest place."""
    result = solve_hand_eye(*about_z, camera_on_hand=True)
    camera = np.asarray(result.camera_from_mount.as_matrix())
    axis = camera[:3, :3] @ np.asarray(about_z[0].as_matrix())[0, :3, 2]
    assert abs(axis @ camera[:3, 3]) < 1e-9
    across = np.eye(3) - np.outer(axis, axis)
    np.testing.assert_allclose(across @ camera[:3, 3], across @ HAND[:3, 3], atol=5e-4)
    # The target slid by the same length.
    world = np.asarray(result.holder_from_world.as_matrix())[:3, 3]
    slid = (camera[:3, 3] - HAND[:3, 3]) @ axis
    np.testing.assert_allclose(world - WORLD[:3, 3], [0.0, 0.0, -slid], atol=1e-3)


def test_a_known_camera_stays_where_it_is_known_to_be(about_z):
    start = (host_transforms(HAND), None)
    result = solve_hand_eye(*about_z, start=start)
    np.testing.assert_allclose(result.camera_from_mount.as_matrix(), HAND, atol=2e-3)
    np.testing.assert_allclose(result.holder_from_world.as_matrix(), WORLD, atol=2e-3)


def test_shifts_alone_tell_the_rotation():
    shifts = np.zeros((15, 6))
    shifts[:, :3] = np.random.default_rng(0).uniform(-0.2, 0.2, (15, 3))
    result = solve_hand_eye(*motion(shifts), start=(host_transforms(HAND), None))
    np.testing.assert_allclose(
        result.camera_from_mount.as_matrix()[:3, :3], HAND[:3, :3], atol=2e-3
    )
    np.testing.assert_allclose(result.camera_from_mount.translation(), HAND[:3, 3], atol=2e-3)
