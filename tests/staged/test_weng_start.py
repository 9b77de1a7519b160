import numpy as np
import pytest
from host_poses import motion_between
from jaxlie import SE3
from numpy_camera import project_radial

from smartview_jax.cameras import Camera, Radial
from smartview_jax.dataset import coplanar, extents
from smartview_jax.geometry import host_exponentials, host_matrices
from smartview_jax.simulation import look_at_from_above
from smartview_jax.staged.weng_start import linear_start, planar_start

SIZE = (640, 480)
POSE = host_matrices(look_at_from_above(np.zeros(3), 0.2, 0.4, 1.0, 0.3))


def seen(camera, points, count):
    """Pixels of the first points; all other pixels are far off, and must not be read."""
    numbers = np.array([camera.alpha_u, camera.alpha_v, camera.u0, camera.v0, camera.lens.k1])
    pixels = project_radial(numbers, points @ POSE[:3, :3].T + POSE[:3, 3])
    visible = np.arange(len(points)) < count
    return np.where(visible[:, None], pixels, 1e6)[None], visible[None]


def pose_error(start, which=0):
    return motion_between(SE3(np.asarray(start.poses.wxyz_xyz)[0, which]), POSE)


def test_the_linear_start_is_exact_without_distortion():
    rng = np.random.default_rng(5)
    points = rng.uniform([-0.02, -0.02, 0.0], [0.02, 0.02, 0.02], (8, 3))
    camera = Camera(2133.0, 2050.0, 330.0, 250.0, Radial(0.0), SIZE)
    start = linear_start(points[None], *seen(camera, points, 7))
    actual = np.ravel(start.intrinsics)
    np.testing.assert_allclose(actual, [2133.0, 2050.0, 330.0, 250.0, 0.0], rtol=1e-6)
    np.testing.assert_allclose(pose_error(start), 0.0, atol=1e-7)


def test_the_planar_start_is_exact_without_distortion():
    rng = np.random.default_rng(6)
    lean = host_exponentials(np.array([0.0, 0.0, 0.0, 0.5, -0.3, 0.3]))
    flat = rng.uniform(-0.02, 0.02, (6, 3)) * [1.0, 1.0, 0.0]
    points = flat @ lean[:3, :3].T
    camera = Camera(2133.0, 2133.0, 319.5, 239.5, Radial(0.0), SIZE)
    pixels, visible = seen(camera, points, 5)
    centre = np.array([319.5, 239.5])
    start = planar_start(points[None], pixels, visible, centre, 640.0)
    assert start.intrinsics.alpha_u[0] == pytest.approx(2133.0, rel=1e-6)
    np.testing.assert_allclose(pose_error(start), 0.0, atol=1e-7)
    # The other pose is the plane tilted the other way about the line of sight.
    assert np.linalg.norm(pose_error(start, 1)[3:]) > 0.1


def test_planes_are_told_from_solids_by_the_visible_points_alone():
    rng = np.random.default_rng(7)
    flat = rng.uniform(-1.0, 1.0, (20, 3)) * [1.0, 1.0, 0.0]
    pose = host_exponentials(np.array([3.0, 1.0, -2.0, 0.7, 0.2, -1.0]))
    turned = flat @ pose[:3, :3].T + pose[:3, 3]
    thick = turned + 0.01 * rng.standard_normal((20, 3))
    bumpy = turned.copy()
    bumpy[7] += 1.0
    points = np.stack([turned, thick, bumpy, bumpy])
    visible = np.ones((4, 20), dtype=bool)
    visible[3, 7] = False
    flags = coplanar(extents(points, visible))
    np.testing.assert_array_equal(flags, [True, False, False, True])
