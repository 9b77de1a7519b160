import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from jaxlie import SE3
from scipy.optimize import least_squares
from shared_data import shared_pairs

from smartview_jax.cameras import Camera, Radial
from smartview_jax.simulation import paper_calibration, paper_points, random_scene
from smartview_jax.staged import fit_staged, kalman_filter
from smartview_jax.staged.kalman import _Measurement, _measurement_update, pixel_residuals


def scene_and_start(seed=0, **options):
    scene = random_scene(seed, views=6, **options)
    camera = Camera(2150.0, 2120.0, 315.0, 243.0, Radial(0.25), (640, 480))
    truth = scene.calibration.camera_from_world(scene.base_from_tool)
    nudge = 1e-3 * np.random.default_rng(seed).normal(size=(6, 6))
    return scene, camera, SE3.exp(jnp.asarray(nudge)) @ truth


@pytest.fixture(scope="module")
def noisy():
    scene, camera, poses = scene_and_start()
    return scene, kalman_filter(scene.data.observations, camera, poses, pixel_sigma=0.15)


def test_an_update_is_the_textbook_one():
    """One measurement against the dense equations of a Kalman filter."""
    rng = np.random.default_rng(0)
    camera_size, views, view = 5, 3, 1
    n = camera_size + 6 * views
    root = rng.normal(size=(n, n))
    P, mean = root @ root.T + np.eye(n), rng.normal(size=n)
    H_camera, H_pose = rng.normal(size=(2, camera_size)), rng.normal(size=(2, 6))
    z, sigma = rng.normal(size=2), 0.3
    H = np.zeros((2, n))
    H[:, :camera_size], H[:, camera_size + 6 : camera_size + 12] = H_camera, H_pose
    S = H @ P @ H.T + sigma**2 * np.eye(2)
    K = P @ H.T @ np.linalg.inv(S)
    measurement = _Measurement(
        jnp.asarray(z),
        jnp.asarray(H_camera),
        jnp.asarray(H_pose),
        jnp.asarray(view),
        jnp.array(True),
    )
    absorb = _measurement_update(jnp.asarray(sigma), jnp.asarray(jnp.inf), camera_size)
    (found, covariance, seen), accepted = absorb(
        (jnp.asarray(mean), jnp.asarray(P), jnp.zeros(views)), measurement
    )
    np.testing.assert_allclose(found, mean + K @ (z - H @ mean), rtol=1e-10)
    np.testing.assert_allclose(covariance, (np.eye(n) - K @ H) @ P, atol=1e-10 * P.max())
    np.testing.assert_array_equal(seen, [0.0, 1.0, 0.0])
    assert bool(accepted)


def test_without_noise_it_finds_the_truth():
    scene, camera, poses = scene_and_start(pixel_noise=0.0)
    found = kalman_filter(scene.data.observations, camera, poses)
    assert found.converged
    for name in ("alpha_u", "alpha_v", "u0", "v0"):
        truth = float(getattr(scene.calibration.camera, name))
        assert float(getattr(found.camera, name)) == pytest.approx(truth, rel=1e-6)
    assert float(found.camera.lens.k1) == pytest.approx(0.3, rel=1e-6)


@pytest.mark.parametrize(("seed", "off"), [(0, 0.7), (1, 1.4), (2, 2.0)])
def test_one_plane_seen_from_few_sides_is_found_from_far_off(seed, off):
    """Step 1 may take a longer lens from farther off: the pixels hardly tell, yet they do."""
    flat = paper_points((0.0,)) * 3.0 - [0.054, 0.045, 0.0]
    scene = random_scene(seed, 6, flat, tilt=np.deg2rad(20.0), distance=(0.5, 0.7), pixel_noise=0.0)
    truth = scene.calibration.camera
    camera = Camera(off * truth.alpha_u, off * truth.alpha_v, 320.0, 240.0, Radial(0.0), (640, 480))
    seen = scene.calibration.camera_from_world(scene.base_from_tool)
    poses = SE3.from_rotation_and_translation(seen.rotation(), off * seen.translation())
    found = kalman_filter(scene.data.observations, camera, poses)
    assert found.converged, found.message
    for name in ("alpha_u", "alpha_v", "u0", "v0"):
        expected = float(getattr(truth, name))
        assert float(getattr(found.camera, name)) == pytest.approx(expected, rel=1e-6)
    assert bool(found.inliers[scene.data.visible].all())


def test_it_settles_at_the_least_squares_optimum_with_its_covariance(noisy):
    """Against scipy on Eq. 8 under Eq. 9: one camera, free poses."""
    scene, found = noisy
    observations = scene.data.observations
    numbers, rebuild = ravel_pytree(found.camera)
    n = len(numbers)

    @jax.jit
    def residuals(step):
        moved = SE3.exp(step[n:].reshape(-1, 6)) @ found.camera_from_world
        r = pixel_residuals(observations, rebuild(numbers + step[:n]), moved)
        return jnp.where(found.inliers[..., None], r, 0.0).ravel()

    jacobian = jax.jit(jax.jacfwd(residuals))
    batch = least_squares(
        lambda x: np.asarray(residuals(x)),
        np.zeros(n + 36),
        jac=lambda x: np.asarray(jacobian(x)),
        x_scale="jac",
        xtol=1e-14,
        ftol=1e-14,
    )
    covariance = np.linalg.inv(batch.jac.T @ batch.jac) * 0.15**2
    std = np.sqrt(np.diag(covariance))
    assert np.abs(batch.x / std).max() < 0.1
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), std, rtol=0.025)


def test_outliers_are_gated_and_good_points_kept():
    scene = random_scene(1, views=6, outlier_fraction=0.1)
    found = fit_staged(scene.data).step2
    assert found.converged
    kept_outliers = int(np.asarray(scene.outliers & found.inliers).sum())
    lost = int(np.asarray(scene.data.visible & ~scene.outliers & ~found.inliers).sum())
    assert kept_outliers == 0
    assert lost <= 3
    assert float(found.pixel_sigma) == pytest.approx(0.15, rel=0.1)


def test_a_known_camera_is_held(noisy):
    scene, found = noisy
    held = kalman_filter(
        scene.data.observations,
        scene.calibration.camera,
        found.camera_from_world,
        hold_camera=True,
    )
    assert eqx.tree_equal(held.camera, scene.calibration.camera, rtol=1e-9, atol=1e-9)
    assert held.converged


def test_hidden_points_and_views_change_nothing(noisy):
    """What is not visible is poisoned and must not be read."""
    scene, _ = noisy
    observations = scene.data.observations
    hidden = observations.visible.at[5].set(False)
    poisoned = eqx.tree_at(
        lambda o: (o.visible, o.pixels),
        observations,
        (hidden, jnp.where(hidden[..., None], observations.pixels, jnp.nan)),
    )
    camera = paper_calibration().camera
    poses = scene.calibration.camera_from_world(scene.base_from_tool)
    found = kalman_filter(poisoned, camera, poses)
    assert found.converged
    assert np.isfinite(found.covariance).all()
    np.testing.assert_allclose(found.camera_from_world.wxyz_xyz[5], poses.wxyz_xyz[5], atol=1e-9)


def test_real_data_agree_with_opencv():
    data, _ = shared_pairs("rct_circle10x10")
    # A sigma this large gates nothing: OpenCV uses every point.
    found = fit_staged(data, "opencv4", pixel_sigma=1.0).step2
    points = [np.asarray(p, dtype=np.float32) for p in data.points]
    pixels = [np.asarray(p, dtype=np.float32) for p in data.pixels]
    rms, K, _, _, _ = cv2.calibrateCamera(
        points, pixels, (640, 480), None, None, flags=cv2.CALIB_FIX_K3
    )
    assert float(found.rms) == pytest.approx(rms, rel=0.01)
    assert float(found.camera.alpha_u) == pytest.approx(K[0, 0], rel=1e-3)
    assert float(found.camera.v0) == pytest.approx(K[1, 2], abs=0.5)
