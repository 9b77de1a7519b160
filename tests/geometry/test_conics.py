import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3

from smartview_jax.geometry import circle_dual_conic, conic_centre, region_centroid

POSE = SE3.from_rotation_and_translation(
    SO3.from_rpy_radians(0.4, -0.7, 0.2), jnp.array([0.03, -0.05, 0.3])
)
RADIUS = jnp.asarray(0.04)


def seen_circle(angle):
    """The circle's image on the plane at unit distance, point by point."""
    flat = RADIUS * jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)], axis=-1)
    points = SE3(POSE.wxyz_xyz[None]).apply(flat)
    return points[:, :2] / points[:, 2:]


def test_the_conic_passes_through_the_projected_circle():
    conic = np.linalg.inv(circle_dual_conic(POSE, RADIUS))
    points = np.asarray(seen_circle(jnp.linspace(0.0, 6.0, 50)))
    homogeneous = np.concatenate([points, np.ones((50, 1))], axis=1)
    value = np.einsum("ni,ij,nj->n", homogeneous, conic, homogeneous)
    np.testing.assert_allclose(value / np.linalg.norm(conic), 0.0, atol=1e-14)


def test_the_centre_halves_every_chord_through_it():
    conic = np.linalg.inv(circle_dual_conic(POSE, RADIUS))
    centre = np.asarray(conic_centre(circle_dual_conic(POSE, RADIUS)))
    for direction in ([1.0, 0.0], [0.3, -0.8]):
        a, b = np.append(centre, 1.0), np.append(direction, 0.0)
        # The roots of a quadratic without a linear term are opposite.
        assert abs(a @ conic @ b) < 1e-12 * abs(b @ conic @ b)
    gap = np.linalg.norm(centre - np.asarray(POSE.translation()[:2] / POSE.translation()[2]))
    assert gap > 0.005


def test_an_ellipse_has_its_centroid_in_its_centre():
    angle = 2.0 * jnp.pi / 48 * jnp.arange(48.0)
    boundary, velocity = jax.jvp(seen_circle, (angle,), (jnp.ones_like(angle),))
    np.testing.assert_allclose(
        region_centroid(boundary, velocity),
        conic_centre(circle_dual_conic(POSE, RADIUS)),
        atol=1e-13,
    )


def test_the_centroid_of_a_limacon_far_from_the_origin():
    """`r = 1 + a cos(t)` encloses a region whose centroid is known."""
    a, far = 0.4, jnp.array([1e6, -2e6])

    def limacon(t):
        unit = jnp.stack([jnp.cos(t), jnp.sin(t)], axis=-1)
        return far[None] + (1.0 + a * jnp.cos(t))[:, None] * unit

    angle = 2.0 * jnp.pi / 16 * jnp.arange(16.0)
    boundary, velocity = jax.jvp(limacon, (angle,), (jnp.ones_like(angle),))
    wanted = np.array([(a + a**3 / 4.0) / (1.0 + a**2 / 2.0), 0.0])
    for turn in (boundary, velocity), (boundary[::-1], -velocity[::-1]):
        np.testing.assert_allclose(region_centroid(*turn) - far, wanted, atol=1e-8)
