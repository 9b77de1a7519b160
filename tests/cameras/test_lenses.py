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


# One program for each lens and shape; only one test is about calls without `jit`.
project = eqx.filter_jit(lambda camera, points: camera.project(points))
unproject = eqx.filter_jit(lambda camera, pixels: camera.unproject(pixels))
distort = eqx.filter_jit(lambda lens, ideal: lens.distort_normalised(ideal))
undistort = eqx.filter_jit(lambda lens, distorted: lens.undistort_normalised(distorted))


def camera(lens):
    return Camera(800.0, 790.0, 320.5, 239.5, lens, (640, 480))


def rays(half_angle, count=200, seed=0):
    rng = np.random.default_rng(seed)
    theta = np.deg2rad(half_angle) * np.sqrt(rng.random(count))
    phi = rng.uniform(0.0, 2.0 * np.pi, count)
    points = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    return jnp.asarray(np.stack(points, axis=-1))


@pytest.fixture(params=LENSES, ids=str)
def case(request):
    return LENSES[request.param]


def test_there_and_back_is_the_identity(case):
    lens, half_angle = case
    inside = np.array(rays(half_angle))
    inside[0] = [0.0, 0.0, 1.0]
    pixels, valid = project(camera(lens), jnp.asarray(3.0 * inside))
    assert np.all(valid)
    back, valid = unproject(camera(lens), pixels)
    assert np.all(valid)
    np.testing.assert_allclose(back, inside, atol=1e-10)


def test_behind_the_camera_is_not_valid(case):
    lens, _ = case
    behind = jnp.asarray(np.array([[0.0, 0.0, -1.0], [0.1, 0.1, -0.5]]))
    pixels, valid = map(np.asarray, project(camera(lens), behind))
    if not isinstance(lens, Fisheye):
        assert not valid.any()
    assert not valid[0]
    assert np.isnan(pixels[~valid]).all()


def test_jit_and_vmap_agree_with_the_plain_call(case):
    lens, half_angle = case
    points = rays(half_angle, 20)
    plain, _ = camera(lens).project(points)
    np.testing.assert_allclose(project(camera(lens), points)[0], plain, rtol=1e-12)
    one_by_one = eqx.filter_jit(eqx.filter_vmap(lambda c, p: c.project(p)[0], in_axes=(None, 0)))
    np.testing.assert_allclose(one_by_one(camera(lens), points), plain, rtol=1e-12)


@pytest.mark.parametrize("direction", ["project", "unproject"])
def test_derivatives_forward_reverse_and_by_differences(case, direction):
    lens, half_angle = case
    points = rays(0.8 * half_angle, 5, seed=3)
    where = points if direction == "project" else project(camera(lens), points)[0]
    numbers, rebuild = ravel_pytree((camera(lens), where))

    @jax.jit
    def function(numbers):
        model, place = rebuild(numbers)
        return getattr(model, direction)(place)[0].ravel()

    both = jax.jit(lambda numbers: (jax.jacfwd(function)(numbers), jax.jacrev(function)(numbers)))
    forward, reverse = map(np.asarray, both(numbers))
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-9 * np.abs(forward).max())
    numbers = np.asarray(numbers)
    for column, number in enumerate(numbers):
        step = 1e-5 * max(1.0, abs(number))
        shift = np.zeros(len(numbers))
        shift[column] = step
        ends = [np.asarray(function(jnp.asarray(numbers + s * shift))) for s in (1.0, -1.0)]
        numeric = (ends[0] - ends[1]) / (2.0 * step)
        np.testing.assert_allclose(
            forward[:, column],
            numeric,
            rtol=1e-5,
            atol=1e-6 * np.abs(forward).max(),
            err_msg=f"column {column}",
        )


def test_masked_points_leave_the_gradient_finite(case):
    lens, half_angle = case
    # 179 degrees off the axis, on it, and exactly behind.
    outside = [[0.0, 0.0, 1.0], [0.01, 0.0, -1.0], [0.0, 0.0, -1.0], [1e3, 0.0, 1e-9]]
    points = jnp.asarray(np.concatenate([rays(half_angle, 5), outside]))

    def total(model, points):
        pixels, valid = model.project(points)
        return jnp.sum(jnp.where(valid[..., None], pixels, 0.0))

    gradient = eqx.filter_jit(jax.grad(total, argnums=(0, 1)))(camera(lens), points)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("name", ["opencv4", "opencv5", "opencv8"])
def test_opencv_lenses_agree_with_opencv(name):
    lens, half_angle = LENSES[name]
    model = camera(lens)
    points = np.asarray(rays(half_angle))
    matrix = np.array([[800.0, 0.0, 320.5], [0.0, 790.0, 239.5], [0.0, 0.0, 1.0]])
    coefficients = np.array(jax.tree.leaves(lens))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, coefficients)
    np.testing.assert_allclose(project(model, jnp.asarray(points))[0], expected[:, 0], atol=1e-9)


def test_the_fisheye_agrees_with_opencv():
    lens, _ = LENSES["fisheye"]
    points = np.asarray(rays(80.0))
    matrix = np.array([[800.0, 0.0, 320.5], [0.0, 790.0, 239.5], [0.0, 0.0, 1.0]])
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(jax.tree.leaves(lens))
    )
    model = camera(lens)
    np.testing.assert_allclose(project(model, jnp.asarray(points))[0], expected[:, 0], atol=1e-9)


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


@pytest.mark.parametrize("name", FOLDS)
def test_beyond_the_fold_nothing_is_valid(name):
    lens, ideal, distorted = FOLDS[name]
    direction = np.array([0.6, 0.8])
    for factor, expected in ((0.995, True), (1.005, False), (1.5, False), (4.0, False)):
        plane, valid = distort(lens, jnp.asarray(factor * ideal * direction))
        assert bool(valid) == expected, f"distort at {factor} of the fold"
        back, valid = undistort(lens, jnp.asarray(factor * distorted * direction))
        assert bool(valid) == expected, f"undistort at {factor} of the fold"
        if expected:
            there, _ = distort(lens, back)
            np.testing.assert_allclose(there, factor * distorted * direction, atol=1e-9)
            back, _ = undistort(lens, plane)
            np.testing.assert_allclose(back, factor * ideal * direction, atol=1e-9)


def test_the_fisheye_ends_where_its_polynomial_turns():
    # theta (1 - theta^2 / 3) peaks at theta = 1.
    lens = Fisheye(-1.0 / 3.0)
    for angle, expected in ((0.995, True), (1.005, False), (2.5, False)):
        point = jnp.array([np.sin(angle), 0.0, np.cos(angle)])
        assert bool(lens.distort(point)[1]) == expected
    assert bool(lens.undistort(jnp.array([0.66, 0.0]))[1])
    assert not bool(lens.undistort(jnp.array([0.67, 0.0]))[1])


@pytest.mark.parametrize("k1", [-0.3, -1e-3, 1e-9, 0.3, 50.0])
def test_the_papers_lens_is_solved_to_the_last_digits(k1):
    """Against numpy's polynomial roots, up to a hair's breadth from the fold."""
    limit = 2.0 / (3.0 * np.sqrt(-3.0 * k1)) if k1 < 0 else 3.0
    for ideal in np.linspace(1e-6, min(limit, 3.0) * (1.0 - 1e-6), 40):
        roots = np.roots([k1, 0.0, 1.0, -ideal])
        real = roots[np.abs(roots.imag) < 1e-7].real
        expected = real[np.argmin(np.abs(real - ideal))] if k1 >= 0 else min(real[real > 0])
        found, valid = map(np.asarray, distort(Radial(k1), np.array([ideal, 0.0])))
        assert valid
        residual = found[0] + k1 * found[0] ** 3 - ideal
        assert abs(float(residual)) < 1e-14 * max(1.0, ideal)
        np.testing.assert_allclose(found[0], expected, rtol=1e-5)


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
