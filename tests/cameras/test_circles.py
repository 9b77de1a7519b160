import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3, SO3

from smartview_jax.cameras import (
    Camera,
    Fisheye,
    Pinhole,
    Radial,
    circle_centre_bias,
    circle_image_centre,
)
from smartview_jax.cameras.circles import region_centroid
from smartview_jax.geometry import host_exponentials, host_matrices, host_transforms

POSE = SE3.from_rotation_and_translation(
    SO3.from_rpy_radians(0.3, -0.6, 0.2), jnp.array([0.06, -0.04, 0.25])
)
RADIUS = jnp.asarray(0.05)
LENSES = [
    Pinhole(),
    Radial(-0.2),
    Radial(0.3),
    Fisheye(0.05, -0.01, 0.0, 0.0),
]


# One program for each lens and shape.
@eqx.filter_jit
def centre_and_bias(camera, pose, radius):
    centre, valid = circle_image_centre(camera, pose, radius)
    return centre, valid, circle_centre_bias(camera, pose, radius)[0]


def camera_with(lens):
    return Camera(600.0, 620.0, 320.0, 240.0, lens, (640, 480))


def centroid_by_area(camera, pose, radius):
    """Every piece of the disc weighed with the area it has in the picture: Gauss by radius."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    r, angle = 0.5 * radius * (nodes + 1.0), 2.0 * np.pi / 64 * np.arange(64)
    flat = np.stack(
        [np.outer(r, np.cos(angle)).ravel(), np.outer(r, np.sin(angle)).ravel()], axis=-1
    )

    pixels, derivatives = map(np.asarray, pixels_and_derivatives(camera, pose, flat))
    stretch = np.linalg.det(derivatives)
    share = np.repeat(weights * r, 64) * stretch
    return share @ pixels / share.sum()


@eqx.filter_jit
def pixels_and_derivatives(camera, pose, flat):
    """Pixels of places in the plane of the circle, and their derivatives by the place."""

    def pixel(places):
        points = jnp.concatenate([places, jnp.zeros_like(places[:, :1])], axis=1)
        return camera.project(SE3(pose.wxyz_xyz[None]).apply(points))[0]

    columns = [
        jax.jvp(pixel, (flat,), (jnp.zeros_like(flat).at[:, k].set(1.0),))[1] for k in (0, 1)
    ]
    return pixel(flat), jnp.stack(columns, axis=-1)


@pytest.mark.parametrize("lens", LENSES, ids=repr)
def test_the_centre_is_that_of_the_region_seen(lens):
    camera = camera_with(lens)
    centre, valid, bias = centre_and_bias(camera, POSE, RADIUS)
    assert bool(valid)
    np.testing.assert_allclose(centre, centroid_by_area(camera, POSE, float(RADIUS)), atol=1e-7)
    assert np.linalg.norm(bias) > 1.0


def test_without_a_lens_it_is_the_centre_of_the_ellipse():
    camera = camera_with(Pinhole())
    # The homography [r1 r2 t] maps the circle's dual conic diag(r^2, r^2, -1) to the image's, and
    # the centre of a conic is the last column of its dual.
    homography = host_matrices(POSE)[:3, [0, 1, 3]]
    dual = homography @ np.diag([float(RADIUS) ** 2, float(RADIUS) ** 2, -1.0]) @ homography.T
    wanted = dual[:2, 2] / dual[2, 2] * [600.0, 620.0] + [320.0, 240.0]
    np.testing.assert_allclose(centre_and_bias(camera, POSE, RADIUS)[0], wanted, atol=1e-10)


def test_the_centroid_of_a_limacon_far_from_the_origin():
    """`r = 1 + a cos(t)` encloses a region whose centroid is known."""
    a, far = 0.4, np.array([1e6, -2e6])
    t = 2.0 * np.pi / 48 * np.arange(48.0)
    unit = np.stack([np.cos(t), np.sin(t)], axis=-1)
    across = np.stack([-np.sin(t), np.cos(t)], axis=-1)
    radius, slope = 1.0 + a * np.cos(t), -a * np.sin(t)
    boundary = far + radius[:, None] * unit
    velocity = slope[:, None] * unit + radius[:, None] * across
    wanted = np.array([(a + a**3 / 4.0) / (1.0 + a**2 / 2.0), 0.0])
    for turn in (boundary, velocity), (boundary[::-1], -velocity[::-1]):
        centroid = jax.jit(region_centroid)(*turn)
        np.testing.assert_allclose(centroid - far, wanted, atol=1e-8)


def test_a_circle_seen_from_straight_above_is_not_shifted():
    above = SE3.from_rotation_and_translation(
        SO3.from_rpy_radians(np.pi, 0.0, 0.4), jnp.array([0.05, 0.02, 0.3])
    )
    _, _, bias = centre_and_bias(camera_with(Pinhole()), above, RADIUS)
    np.testing.assert_allclose(bias, 0.0, atol=1e-12)


def test_derivatives_and_batches():
    """By pose, radius and lens, against differences; a batch is its members."""
    twist = jnp.array([0.01, -0.02, 0.01, 0.1, 0.2, -0.1])

    def centre(step):
        pose = POSE @ SE3.exp(step * twist)
        camera = camera_with(Radial(0.3 + step))
        return circle_image_centre(camera, pose, RADIUS * (1.0 + step))[0]

    @jax.jit
    def value_and_slopes(step):
        value, linear = jax.linearize(centre, step)
        transposed = jax.linear_transpose(linear, step)
        return value, linear(jnp.ones(())), jax.vmap(transposed)(jnp.eye(2))[0]

    _, slope, reverse = value_and_slopes(jnp.zeros(()))
    np.testing.assert_allclose(reverse, slope, rtol=1e-10)
    h = 1e-5
    ends = [np.asarray(value_and_slopes(jnp.asarray(s * h))[0]) for s in (1.0, -1.0)]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2.0 * h), rtol=1e-6)

    steps = np.array([[0.0, 0.1, 0.2], [0.3, 0.4, 0.5]])
    shifts = steps[..., None] * np.asarray(twist)
    poses = host_transforms(host_matrices(POSE) @ host_exponentials(shifts))
    camera, radii = camera_with(Radial(0.3)), jnp.asarray(0.01 * (1.0 + steps))
    together, _, _ = centre_and_bias(camera, poses, radii)
    one, _, _ = centre_and_bias(camera, SE3(poses.wxyz_xyz[1, 2]), radii[1, 2])
    np.testing.assert_allclose(together[1, 2], one, rtol=1e-12)


def test_a_circle_that_is_partly_behind_the_camera_is_not_valid():
    steep = SE3.from_rotation_and_translation(SO3.from_x_radians(1.5), jnp.array([0.0, 0.0, 0.04]))

    def total(radius):
        centre, _ = circle_image_centre(camera_with(Radial(0.3)), steep, radius)
        return jnp.sum(jnp.nan_to_num(centre))

    centre, valid, _ = centre_and_bias(camera_with(Radial(0.3)), steep, RADIUS)
    assert not valid
    assert np.isnan(centre).all()
    assert jax.jit(jax.grad(total))(RADIUS) == 0.0
