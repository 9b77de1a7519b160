import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from smartview_jax.geometry import (
    circle_dual_conic,
    conic_centre,
    host_transforms,
    region_centroid,
)

MATRIX = np.eye(4)
MATRIX[:3, :3] = Rotation.from_euler("xyz", [0.4, -0.7, 0.2]).as_matrix()
MATRIX[:3, 3] = [0.03, -0.05, 0.3]
POSE, RADIUS = host_transforms(MATRIX), 0.04


@jax.jit
def conic_and_centre(pose, radius):
    dual = circle_dual_conic(pose, radius)
    return jnp.linalg.inv(dual), conic_centre(dual)


centroid = jax.jit(region_centroid)


def seen_circle(angle):
    """The circle's image on the plane at unit distance, point by point, and its derivative."""
    flat = RADIUS * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    turn = RADIUS * np.stack([-np.sin(angle), np.cos(angle), np.zeros_like(angle)], axis=-1)
    x, dx = flat @ MATRIX[:3, :3].T + MATRIX[:3, 3], turn @ MATRIX[:3, :3].T
    image = x[:, :2] / x[:, 2:]
    return image, (dx[:, :2] - image * dx[:, 2:]) / x[:, 2:]


def test_the_conic_passes_through_the_projected_circle():
    conic = np.asarray(conic_and_centre(POSE, RADIUS)[0])
    points, _ = seen_circle(np.linspace(0.0, 6.0, 50))
    homogeneous = np.concatenate([points, np.ones((50, 1))], axis=1)
    value = np.einsum("ni,ij,nj->n", homogeneous, conic, homogeneous)
    np.testing.assert_allclose(value / np.linalg.norm(conic), 0.0, atol=1e-14)


def test_the_centre_halves_every_chord_through_it():
    conic, centre = map(np.asarray, conic_and_centre(POSE, RADIUS))
    for direction in ([1.0, 0.0], [0.3, -0.8]):
        a, b = np.append(centre, 1.0), np.append(direction, 0.0)
        # The roots of a quadratic without a linear term are opposite.
        assert abs(a @ conic @ b) < 1e-12 * abs(b @ conic @ b)
    gap = np.linalg.norm(centre - MATRIX[:2, 3] / MATRIX[2, 3])
    assert gap > 0.005


def test_an_ellipse_has_its_centroid_in_its_centre():
    boundary, velocity = seen_circle(2.0 * np.pi / 48 * np.arange(48.0))
    centre = conic_and_centre(POSE, RADIUS)[1]
    np.testing.assert_allclose(centroid(boundary, velocity), centre, atol=1e-13)


def test_the_centroid_of_a_limacon_far_from_the_origin():
    """`r = 1 + a cos(t)` encloses a region whose centroid is known."""
    a, far = 0.4, np.array([1e6, -2e6])
    # As many samples as the ellipse has, so that one program serves both.
    t = 2.0 * np.pi / 48 * np.arange(48.0)
    unit = np.stack([np.cos(t), np.sin(t)], axis=-1)
    across = np.stack([-np.sin(t), np.cos(t)], axis=-1)
    radius, slope = 1.0 + a * np.cos(t), -a * np.sin(t)
    boundary = far + radius[:, None] * unit
    velocity = slope[:, None] * unit + radius[:, None] * across
    wanted = np.array([(a + a**3 / 4.0) / (1.0 + a**2 / 2.0), 0.0])
    for turn in (boundary, velocity), (boundary[::-1], -velocity[::-1]):
        np.testing.assert_allclose(centroid(*turn) - far, wanted, atol=1e-8)
