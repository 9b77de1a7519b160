import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.geometry import host_transforms
from smartview_jax.staged import Interpolation

CAMERA = Camera(800.0, 800.0, 320.0, 240.0, Pinhole(), (640, 480))
CROSS = 0.03 * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], dtype=float)
OUT = np.array([0.48, -0.6, 0.64])
"""Normal of the plane that the viewpoints lie in."""


def poses_at(positions):
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 3] = positions
    return host_transforms(poses)


def tilted(positions):
    """Positions over the plane through the base's origin with that normal."""
    x = np.cross(OUT, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    normal = OUT / np.linalg.norm(OUT)
    return positions @ np.stack([x, np.cross(normal, x), normal])


def between(positions):
    """Extrinsics are a linear function of the position, so interpolation can be exact."""
    seen = poses_at(np.asarray(positions) @ np.diag([1.0, -1.0, -1.0]) + [0.0, 0.0, 0.5])
    return Interpolation(CAMERA, poses_at(positions), seen)


def test_a_place_between_viewpoints_is_the_mean_of_its_neighbours():
    actual = between(tilted(CROSS))
    np.testing.assert_allclose(actual.weights(jnp.asarray(tilted(CROSS[1:].mean(0)))), 0.2)
    place = tilted(np.array([0.011, -0.006, 0.0]))
    pose = actual.camera_from_world(poses_at(place[None]))
    expected = place @ np.diag([1.0, -1.0, -1.0]) + [0.0, 0.0, 0.5]
    np.testing.assert_allclose(pose.translation()[0], expected, atol=1e-14)


def test_noise_across_the_plane_of_the_viewpoints_does_not_swell_the_weights():
    """A tenth of a millimetre across 30 mm used to give weights of hundreds."""
    rng = np.random.default_rng(0)
    noisy = CROSS + 1e-4 * rng.normal(size=CROSS.shape)
    actual = between(tilted(noisy))
    assert actual.spanned_axes.shape == (2, 3)
    outside = tilted(np.array([[0.01, 0.01, 0.01], [0.0, 0.0, -0.02]]))
    assert np.abs(actual.weights(jnp.asarray(outside))).max() < 1.0
    np.testing.assert_allclose(np.sum(actual.weights(jnp.asarray(outside)), axis=1), 1.0)


@pytest.mark.parametrize(("stretch", "dimensions"), [(0.0, 2), (0.05, 2), (0.8, 3)])
def test_directions_are_spanned_where_viewpoints_spread(stretch, dimensions):
    rng = np.random.default_rng(1)
    positions = rng.normal(size=(12, 3)) * [1.0, 0.8, stretch]
    actual = between(tilted(positions))
    assert actual.spanned_axes.shape == (dimensions, 3)
    again = actual.weights(actual.positions) @ actual.positions
    kept = actual.spanned_axes.T @ actual.spanned_axes
    np.testing.assert_allclose((again - actual.positions) @ kept, 0.0, atol=1e-12)


def test_one_line_and_one_place():
    line = between(CROSS[:3])
    assert line.spanned_axes.shape == (1, 3)
    np.testing.assert_array_equal(
        line.is_inside(poses_at([[0.02, 0, 0], [0.04, 0, 0], [0.0, 0.01, 0]])), [True, False, False]
    )
    assert between(np.zeros((2, 3))).spanned_axes.shape == (0, 3)


def test_inside_is_what_a_linear_programme_calls_inside():
    actual = between(tilted(CROSS))
    places = np.random.default_rng(2).uniform(-0.03, 0.03, (200, 3)) * [1.0, 1.0, 0.0]
    inside = actual.is_inside(poses_at(tilted(places)))
    A = np.vstack([CROSS[:, :2].T, np.ones(5)])
    expected = [linprog(np.zeros(5), A_eq=A, b_eq=[x, y, 1.0]).status == 0 for x, y, _ in places]
    # What lies within a hundredth of the hull's edge may count either way.
    clear = np.abs(np.abs(places).sum(axis=1) / 0.03 - 1.0) > 0.02
    np.testing.assert_array_equal(inside[clear], np.array(expected)[clear])
    assert 50 < clear.sum() < 200 > inside.sum() > 50


def test_far_from_the_plane_is_outside():
    actual = between(tilted(CROSS))
    above = tilted(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.01]]))
    np.testing.assert_array_equal(actual.is_inside(poses_at(above)), [True, False])
