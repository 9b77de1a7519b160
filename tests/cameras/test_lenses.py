"""What every lens must do; a new one is one more row of `LENSES`."""

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from smartview_jax.cameras import (
    AbstractPerspectiveLens,
    Camera,
    Fisheye,
    OpenCV4,
    OpenCV5,
    OpenCV8,
    Pinhole,
    Radial,
    Weng,
    implicit_inverse,
    lens_by_name,
    lens_name,
)


class Division(AbstractPerspectiveLens):
    """A user's lens: Fitzgibbon's division model, written in one direction only."""

    strength: jax.Array

    def __init__(self, strength=0.0):
        self.strength = jnp.asarray(strength, dtype=float)

    def _ideal(self, distorted):
        return distorted / (1.0 + self.strength * jnp.sum(distorted**2, axis=-1, keepdims=True))

    def undistort_normalised(self, distorted):
        valid = self.strength * jnp.sum(distorted**2, axis=-1) > -1.0
        return self._ideal(distorted), valid

    def distort_normalised(self, ideal):
        return implicit_inverse(self._ideal, ideal, ideal)


# A lens, and the half angle (degrees) of a cone of rays that it can certainly see.
LENSES = {
    "pinhole": (Pinhole(), 80.0),
    "radial, barrel": (Radial(0.3), 75.0),
    "radial, pincushion": (Radial(-0.2), 38.0),
    "radial, none": (Radial(0.0), 80.0),
    "weng": (Weng(0.2, 0.01, -0.02, 0.015, 0.01), 60.0),
    "opencv4": (OpenCV4(-0.28, 0.07, 0.001, -0.0008), 42.0),
    "opencv5": (OpenCV5(0.1, -0.2, 0.002, 0.001, 0.1), 45.0),
    "opencv8": (OpenCV8(0.5, -0.2, 0.001, 0.002, 0.05, 0.6, -0.1, 0.03), 40.0),
    "fisheye": (Fisheye(-0.02, 0.003, -0.001, 0.0001), 100.0),
    "a user's own": (Division(-0.2), 40.0),
}


COUNT = 200
"""Points and pixels of every call: each lens has one program for both directions."""


@eqx.filter_jit
def both_ways(camera, points, pixels):
    """Project points and unproject pixels."""
    return camera.project(points), camera.unproject(pixels)


@eqx.filter_jit
def distorted_with_and_without_the_test(lens, ideal):
    return lens.distort_normalised(ideal)[0], lens.distort_valid(ideal)


def padded(rows):
    """Rows repeated up to the number that every call has."""
    rows = np.asarray(rows, dtype=float)
    return rows[np.arange(COUNT) % len(rows)]


def project(camera, points):
    pixels, valid = both_ways(camera, padded(points), np.zeros((COUNT, 2)))[0]
    return np.asarray(pixels)[: len(points)], np.asarray(valid)[: len(points)]


def unproject(camera, pixels):
    rays, valid = both_ways(camera, np.ones((COUNT, 3)), padded(pixels))[1]
    return np.asarray(rays)[: len(pixels)], np.asarray(valid)[: len(pixels)]


def distort(lens, ideal):
    """Distorted coordinates, by a camera whose pixels are the plane at unit distance."""
    points = np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1)
    return project(Camera(1.0, 1.0, 0.0, 0.0, lens, (640, 480)), points)


def undistort(lens, distorted):
    rays, valid = unproject(Camera(1.0, 1.0, 0.0, 0.0, lens, (640, 480)), distorted)
    return rays[:, :2] / rays[:, 2:], valid


def camera(lens):
    return Camera(800.0, 790.0, 320.5, 239.5, lens, (640, 480))


def rays(half_angle, count=COUNT, seed=0):
    rng = np.random.default_rng(seed)
    theta = np.deg2rad(half_angle) * np.sqrt(rng.random(count))
    phi = rng.uniform(0.0, 2.0 * np.pi, count)
    points = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    return np.stack(points, axis=-1)


@pytest.fixture(params=LENSES, ids=str)
def case(request):
    return LENSES[request.param]


def test_there_and_back_is_the_identity(case):
    lens, half_angle = case
    inside = rays(half_angle)
    inside[0] = [0.0, 0.0, 1.0]
    pixels, valid = project(camera(lens), 3.0 * inside)
    assert np.all(valid)
    back, valid = unproject(camera(lens), pixels)
    assert np.all(valid)
    np.testing.assert_allclose(back, inside, atol=1e-10)


def test_behind_the_camera_is_not_valid(case):
    lens, _ = case
    pixels, valid = project(camera(lens), np.array([[0.0, 0.0, -1.0], [0.1, 0.1, -0.5]]))
    if not isinstance(lens, Fisheye):
        assert not valid.any()
    assert not valid[0]
    assert np.isnan(pixels[~valid]).all()


@pytest.mark.parametrize("name", ["radial, pincushion", "a user's own"])
def test_jit_and_vmap_agree_with_the_plain_call(name):
    """For both ways to solve for a lens: its own iteration, and `implicit_inverse`."""
    lens, half_angle = LENSES[name]
    points = rays(half_angle, 8)
    plain, _ = camera(lens).project(jnp.asarray(points))
    np.testing.assert_allclose(project(camera(lens), points)[0], plain, rtol=1e-12)
    one_by_one = eqx.filter_jit(eqx.filter_vmap(lambda c, p: c.project(p)[0], in_axes=(None, 0)))
    np.testing.assert_allclose(one_by_one(camera(lens), points), plain, rtol=1e-12)


INSIDE = 5
"""Points at which derivatives are compared; at those after them they need only be finite."""


@eqx.filter_jit
def derivatives(model, points, pixels, steps):
    """Derivatives by camera, points and pixels: forward, reverse, and by central differences."""
    numbers, rebuild = ravel_pytree((model, points, pixels))

    def function(numbers):
        model, points, pixels = rebuild(numbers)
        projected, valid = model.project(points)
        seen = jnp.where(valid[:, None], projected, 0.0)
        return jnp.concatenate([seen.ravel(), model.unproject(pixels)[0].ravel()])

    shifts = jnp.concatenate([jnp.diag(steps), -jnp.diag(steps)])
    above, below = jnp.split(jax.lax.map(lambda shift: function(numbers + shift), shifts), 2)
    numeric = (above - below).T / (2.0 * steps)[None]
    # Both directions from one linear map, so that it is compiled once.
    value, linear = jax.linearize(function, numbers)
    transposed = jax.linear_transpose(linear, numbers)
    forward = jax.vmap(linear, out_axes=1)(jnp.eye(len(numbers)))
    return forward, jax.vmap(transposed)(jnp.eye(len(value)))[0], numeric


# OpenCV's three lenses differ in their coefficients alone, which OpenCV's own pixels test.
@pytest.mark.parametrize("name", [name for name in LENSES if name not in ("opencv4", "opencv5")])
def test_derivatives_forward_reverse_and_by_differences(name):
    """And of points that are masked they are finite."""
    lens, half_angle = LENSES[name]
    points = rays(0.8 * half_angle, INSIDE, seed=3)
    pixels, _ = project(camera(lens), points)
    # 179 degrees off the axis, on it, and exactly behind.
    outside = [[0.0, 0.0, 1.0], [0.01, 0.0, -1.0], [0.0, 0.0, -1.0], [1e3, 0.0, 1e-9]]
    points = np.concatenate([points, outside])
    numbers = np.asarray(ravel_pytree((camera(lens), points, pixels))[0])
    steps = 1e-5 * np.maximum(1.0, np.abs(numbers))
    forward, reverse, numeric = map(np.asarray, derivatives(camera(lens), points, pixels, steps))
    assert np.isfinite(reverse).all()
    # Projection and back-projection have derivatives of different sizes.
    first = 2 * len(points)
    for rows in (slice(0, 2 * INSIDE), slice(first, None)):
        size = np.abs(forward[rows]).max()
        np.testing.assert_allclose(forward[rows], reverse[rows], rtol=1e-9, atol=1e-9 * size)
        for column in range(len(numbers)):
            np.testing.assert_allclose(
                forward[rows, column],
                numeric[rows, column],
                rtol=1e-5,
                atol=1e-6 * size,
                err_msg=f"column {column}",
            )


@pytest.mark.parametrize("name", ["opencv4", "opencv5", "opencv8"])
def test_opencv_lenses_agree_with_opencv(name):
    lens, half_angle = LENSES[name]
    model = camera(lens)
    points = rays(half_angle)
    matrix = np.array([[800.0, 0.0, 320.5], [0.0, 790.0, 239.5], [0.0, 0.0, 1.0]])
    coefficients = np.array(jax.tree.leaves(lens))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, coefficients)
    np.testing.assert_allclose(project(model, points)[0], expected[:, 0], atol=1e-9)


def test_the_fisheye_agrees_with_opencv():
    lens, _ = LENSES["fisheye"]
    points = rays(80.0)
    matrix = np.array([[800.0, 0.0, 320.5], [0.0, 790.0, 239.5], [0.0, 0.0, 1.0]])
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(jax.tree.leaves(lens))
    )
    model = camera(lens)
    np.testing.assert_allclose(project(model, points)[0], expected[:, 0], atol=1e-9)


# Where a lens folds, worked by hand, as (lens, ideal radius of the fold, distorted radius there).
FOLDS = {
    # r' = r - r^3 / 3 peaks at r = 1, r' = 2/3.
    "radial": (Radial(-1.0 / 3.0), 2.0 / 3.0, 1.0),
    "weng": (Weng(-1.0 / 3.0), 2.0 / 3.0, 1.0),
    # OpenCV's direction: the distorted radius r (1 - r^2 / 3) peaks at r = 1.
    "opencv4": (OpenCV4(-1.0 / 3.0), 1.0, 2.0 / 3.0),
    # r (1 + s - s^2): 1 + 3 s - 5 s^2 = 0 at s = (3 + sqrt(29)) / 10.
    "opencv4, two terms": (OpenCV4(1.0, -1.0), 0.9156872, 0.9156872 * 1.1353776),
    # r (1 - 0.6 s) / (1 - 0.2 s) peaks where 1 - 1.6 s + 0.12 s^2 = 0: s = 0.6573967.
    "opencv8": (OpenCV8(-0.6, 0.0, 0.0, 0.0, 0.0, -0.2), 0.8108, 0.8108 * 0.60559 / 0.86852),
}


@pytest.mark.parametrize("name", ["opencv4", "opencv8", "a user's own"])
def test_valid_points_are_distorted_alike_without_the_test_of_validity(name):
    lens, half_angle = LENSES[name]
    points = rays(half_angle)
    tested, untested = distorted_with_and_without_the_test(lens, points[:, :2] / points[:, 2:])
    np.testing.assert_allclose(untested, tested, rtol=1e-12)


@pytest.mark.parametrize("name", FOLDS)
def test_beyond_the_fold_nothing_is_valid(name):
    lens, ideal, distorted = FOLDS[name]
    direction = np.array([0.6, 0.8])
    factors, expected = np.array([[0.995], [1.005], [1.5], [4.0]]), [True, False, False, False]
    plane, valid = distort(lens, factors * ideal * direction)
    np.testing.assert_array_equal(valid, expected, "distort")
    back, valid = undistort(lens, factors * distorted * direction)
    np.testing.assert_array_equal(valid, expected, "undistort")
    again, _ = distort(lens, back[:1])
    np.testing.assert_allclose(again[0], 0.995 * distorted * direction, atol=1e-9)
    again, _ = undistort(lens, plane[:1])
    np.testing.assert_allclose(again[0], 0.995 * ideal * direction, atol=1e-9)


def test_the_fisheye_ends_where_its_polynomial_turns():
    # theta (1 - theta^2 / 3) peaks at theta = 1.
    lens = Fisheye(-1.0 / 3.0)
    angles = np.array([0.995, 1.005, 2.5])
    points = np.stack([np.sin(angles), 0.0 * angles, np.cos(angles)], axis=1)
    np.testing.assert_array_equal(project(camera(lens), points)[1], [True, False, False])
    edges = np.array([[0.66, 0.0], [0.67, 0.0]])
    np.testing.assert_array_equal(undistort(lens, edges)[1], [True, False])


@pytest.mark.parametrize("k1", [-0.3, -1e-3, 1e-9, 0.3, 50.0])
def test_the_papers_lens_is_solved_to_the_last_digits(k1):
    """Against numpy's polynomial roots, up to a hair's breadth from the fold."""
    limit = 2.0 / (3.0 * np.sqrt(-3.0 * k1)) if k1 < 0 else 3.0
    ideals = np.linspace(1e-6, min(limit, 3.0) * (1.0 - 1e-6), 40)
    solved, valid = distort(Radial(k1), np.stack([ideals, 0.0 * ideals], axis=1))
    assert valid.all()
    residuals = solved[:, 0] + k1 * solved[:, 0] ** 3 - ideals
    assert (np.abs(residuals) < 1e-14 * np.maximum(1.0, ideals)).all()
    for ideal, actual in zip(ideals, solved[:, 0], strict=True):
        roots = np.roots([k1, 0.0, 1.0, -ideal])
        real = roots[np.abs(roots.imag) < 1e-7].real
        expected = real[np.argmin(np.abs(real - ideal))] if k1 >= 0 else min(real[real > 0])
        np.testing.assert_allclose(actual, expected, rtol=1e-5)


def test_radial_is_weng_with_k1_alone():
    points = rays(30.0)
    for k1 in (0.3, -0.2):
        np.testing.assert_allclose(
            project(camera(Radial(k1)), points)[0],
            project(camera(Weng(k1)), points)[0],
            rtol=1e-12,
        )


def test_lenses_by_name():
    for name in ("pinhole", "radial", "weng", "opencv4", "opencv5", "opencv8", "fisheye"):
        lens = lens_by_name(name)
        assert lens_name(lens) == name
        points = rays(30.0)
        if name != "fisheye":
            np.testing.assert_allclose(
                project(camera(lens), points)[0], project(camera(Pinhole()), points)[0], rtol=1e-12
            )
    own = Division(0.1)
    assert lens_by_name(own) is own
    assert lens_name(own) == "Division"
    with pytest.raises(ValueError, match=r"pinhole, radial, .*found 'magnifying glass'"):
        lens_by_name("magnifying glass")
