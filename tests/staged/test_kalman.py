import dataclasses

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from jaxlie import SE3
from programs import programs_added
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from scipy.stats import chi2, norm

from smartview_jax.cameras import Camera, Fisheye, Radial
from smartview_jax.geometry import (
    host_exponentials,
    host_matrices,
    host_transforms,
    transform_points,
)
from smartview_jax.simulation import paper_calibration, paper_points, random_scene
from smartview_jax.staged import (
    CommonCameraOptions,
    fit_staged,
    kalman_filter,
    kalman_pass,
    outlier_limits,
    pixel_residuals,
)
from smartview_jax.staged.kalman_update import (
    absorb_measurements,
    standard_normal_state,
    whole_covariance,
    whole_mean_and_variances,
)

VIEWS = 8

HELD = CommonCameraOptions(hold_camera=True)


def scene_and_start(seed=0, **options):
    scene = random_scene(seed, VIEWS, **options)
    camera = Camera(2150.0, 2120.0, 315.0, 243.0, Radial(0.25), (640, 480))
    truth = scene.calibration.camera_from_world(scene.base_from_tool)
    nudge = host_exponentials(1e-3 * np.random.default_rng(seed).normal(size=(VIEWS, 6)))
    return scene, camera, host_transforms(nudge @ host_matrices(truth))


@pytest.fixture(scope="module")
def noisy():
    scene, camera, poses = scene_and_start()
    return scene, kalman_filter(
        scene.data.observations, camera, poses, options=CommonCameraOptions(0.15)
    )


class Textbook:
    """A Kalman filter with the dense equations of a textbook, for measurements with unit noise."""

    def __init__(self, views, camera_size, gate=np.inf, dtype=np.longdouble):
        self.mean = np.zeros(camera_size + 6 * views, dtype)
        self.P = np.eye(camera_size + 6 * views, dtype=dtype)
        self.counts = np.zeros(views, int)
        self.camera_size, self.gate = camera_size, gate

    def update(self, row, view):
        """Update with the row `[H_e H_s -z]`, and say whether it passed the gate."""
        H = np.zeros((2, len(self.mean)))
        first = self.camera_size + 6 * view
        H[:, first : first + 6], H[:, : self.camera_size] = row[:, :6], row[:, 6:-1]
        predicted = H @ self.P @ H.T
        S = predicted + np.eye(2)
        innovation = -row[:, -1] - H @ self.mean
        determined = np.trace(predicted) < 25.0 and self.counts[view] >= 4
        inverse = np.array([[S[1, 1], -S[0, 1]], [-S[1, 0], S[0, 0]]])
        inverse /= S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
        if determined and innovation @ inverse @ innovation > self.gate:
            return False
        K = self.P @ H.T @ inverse
        self.mean = self.mean + K @ innovation
        self.P = self.P - K @ (H @ self.P)
        self.P = (self.P + self.P.T) / 2.0
        self.counts[view] += 1
        return True

    def update_all(self, rows, used):
        """Update point by point over all views; return the number of measurements gated out."""
        gated = 0
        for point, view in np.argwhere(used):
            gated += not self.update(rows[point, view], view)
        return gated


def test_many_updates_with_a_gate_are_the_textbook_ones():
    """Three views of 40 points; one in five is an outlier once the poses are known."""
    rng = np.random.default_rng(0)
    points, views, camera_size = 40, 3, 5
    truth = rng.normal(size=camera_size + 6 * views)
    H_e, H_s = rng.normal(size=(points, views, 2, 6)), rng.normal(size=(points, views, 2, 5))
    poses = truth[camera_size:].reshape(views, 6)
    z = 30.0 * (H_s @ truth[:camera_size] + np.einsum("nvij,vj->nvi", H_e, poses))
    outliers = (rng.random((points, views)) < 0.2) & (np.arange(points) > 8)[:, None]
    z = z + rng.normal(size=z.shape) + 50.0 * outliers[..., None]
    rows = np.concatenate([30.0 * H_e, 30.0 * H_s, -z[..., None]], axis=-1)
    used = rng.random((points, views)) < 0.9
    gate = 15.0
    textbook = Textbook(views, camera_size, gate)
    gated = textbook.update_all(rows, used)
    assert 10 < gated < 30
    state = jax.jit(absorb_measurements)(
        standard_normal_state(views, camera_size), rows, used, np.full(views, gate)
    )
    mean, variances = whole_mean_and_variances(state)
    np.testing.assert_allclose(mean, textbook.mean, rtol=1e-9)
    np.testing.assert_allclose(variances, np.diag(textbook.P), rtol=1e-9)
    scale = rng.uniform(1.0, 9.0, size=camera_size)
    maps = rng.normal(size=(views, 6, 6))
    change_of_units = block_diag(np.diag(scale), *maps)
    covariance = change_of_units @ textbook.P @ change_of_units.T
    np.testing.assert_allclose(
        whole_covariance(state, scale, maps), covariance, atol=1e-10 * np.abs(covariance).max()
    )


@pytest.mark.skipif(np.finfo(np.longdouble).eps > 1e-18, reason="no extended precision here")
@pytest.mark.parametrize("hold_camera", [False, True])
def test_a_pass_is_the_textbook_one(hold_camera, monkeypatch):
    """From the wide initial covariance, which costs the dense form nine digits."""
    scene = random_scene(1, VIEWS, outlier_fraction=0.1)
    camera, observations = scene.calibration.camera, scene.data.observations
    poses = scene.calibration.camera_from_world(scene.base_from_tool)
    calls, original = [], kalman_pass._linearised_pass

    def recording(*arguments):
        calls.append(arguments)
        return original(*arguments)

    monkeypatch.setattr(kalman_pass, "_linearised_pass", recording)
    residuals = np.asarray(pixel_residuals(observations, camera, poses))
    # Without the outliers among the first points of the views, before there is a gate.
    early = np.asarray(scene.outliers) & (np.arange(scene.outliers.shape[1]) < 8)
    inliers = np.asarray(observations.visible) & ~early
    settings = kalman_pass.PassSettings(0.15, np.full(len(inliers), 18.0), 1.0, hold_camera)
    result = kalman_pass.run_pass(observations, camera, poses, residuals, inliers, settings)
    ((point, *_),) = calls
    rows, scale = jax.jit(kalman_pass.scaled_measurements)(point)
    n = len(scale)
    textbook = Textbook(len(inliers), n, 18.0)
    gated = textbook.update_all(np.asarray(rows).swapaxes(0, 1) / 0.15, inliers.T)
    assert gated >= 0.9 * np.sum(np.asarray(scene.outliers) & inliers) > 20
    std = np.sqrt(np.diag(textbook.P))
    mean, variances = whole_mean_and_variances(result.distribution)
    np.testing.assert_allclose(mean / std, textbook.mean / std, atol=1e-8)
    np.testing.assert_allclose(np.sqrt(variances), std, rtol=1e-8)
    numbers = np.array(jax.tree.leaves(camera)) + np.asarray(scale) * textbook.mean[:n]
    np.testing.assert_allclose(jax.tree.leaves(result.camera), numbers.astype(float), rtol=1e-10)
    if hold_camera:
        # Exactly the camera that was given: no measurement has changed its initial covariance.
        assert eqx.tree_equal(result.camera, camera, rtol=1e-15, atol=0.0)
        held = result.covariance()[:n, :n] / np.outer(scale, scale)
        np.testing.assert_allclose(held, np.eye(n), atol=1e-12)


@pytest.mark.parametrize(
    "lens", [Radial(0.25), Fisheye(*np.full(4, 0.02))], ids=["radial", "fisheye"]
)
def test_a_pass_has_the_derivatives_of_the_projection(lens):
    """They equal automatic differentiation's, for a step that acts about the centroids."""
    camera = Camera(2150.0, 2120.0, 315.0, 243.0, lens, (640, 480))
    numbers, rebuild = ravel_pytree(camera)
    rng = np.random.default_rng(0)
    in_camera = rng.normal(size=(2, 7, 3)) * 0.05 + [0.0, 0.0, 0.5]
    centroids, pose_scale = in_camera.mean(axis=1), rng.uniform(1.0, 2.0, size=(2, 6))
    unit = np.ones(())

    @jax.jit
    @jax.jacfwd
    def by_step(step):
        poses = SE3.exp(step[len(numbers) :].reshape(2, 6))
        turned = transform_points(poses, jnp.asarray(in_camera - centroids[:, None]))
        return rebuild(numbers + step[: len(numbers)]).project(turned + centroids[:, None])[0]

    expected = np.asarray(by_step(jnp.zeros(len(numbers) + 12)))
    point = kalman_pass.LinearisationPoint(
        camera, in_camera, centroids, np.zeros((2, 7, 2)), unit, pose_scale
    )
    rows, scale = jax.jit(kalman_pass.scaled_measurements)(point)
    rows, scale, actual = np.asarray(rows), np.asarray(scale), np.zeros_like(expected)
    actual[..., : len(numbers)] = rows[..., 6:-1] / scale
    for view in range(2):
        columns = slice(len(numbers) + 6 * view, len(numbers) + 6 * view + 6)
        actual[view, ..., columns] = rows[view, ..., :6] / pose_scale[view]
    np.testing.assert_allclose(actual, expected, atol=1e-12 * np.abs(expected).max())


def test_without_noise_it_finds_the_truth():
    scene, camera, poses = scene_and_start(pixel_noise=0.0)
    fit = kalman_filter(scene.data.observations, camera, poses)
    assert fit.converged
    for name in ("alpha_u", "alpha_v", "u0", "v0"):
        truth = float(getattr(scene.calibration.camera, name))
        assert float(getattr(fit.camera, name)) == pytest.approx(truth, rel=1e-6)
    assert float(fit.camera.lens.k1) == pytest.approx(0.3, rel=1e-6)


@pytest.mark.parametrize(("seed", "off"), [(0, 0.7), (1, 1.4), (2, 2.0)])
def test_one_plane_seen_from_few_sides_is_found_from_far_off(seed, off):
    """Step 1 may take a longer lens from farther off: the pixels hardly tell, yet they do."""
    # Every point twice, so that there are as many as in the other scenes.
    flat = paper_points((0.0, 0.0)) * 3.0 - [0.054, 0.045, 0.0]
    scene = random_scene(
        seed, VIEWS, flat, tilt=np.deg2rad(20.0), distance=(0.5, 0.7), pixel_noise=0.0
    )
    truth = scene.calibration.camera
    camera = Camera(off * truth.alpha_u, off * truth.alpha_v, 320.0, 240.0, Radial(0.0), (640, 480))
    seen = scene.calibration.camera_from_world(scene.base_from_tool)
    poses = SE3.from_rotation_and_translation(seen.rotation(), off * seen.translation())
    fit = kalman_filter(scene.data.observations, camera, poses)
    assert fit.converged, fit.message
    for name in ("alpha_u", "alpha_v", "u0", "v0"):
        expected = float(getattr(truth, name))
        assert float(getattr(fit.camera, name)) == pytest.approx(expected, rel=1e-6)
    assert bool(fit.inliers[scene.data.visible].all())


def test_the_filter_settles_at_the_least_squares_optimum_with_its_covariance(noisy):
    """Against scipy on Eq. 8 under Eq. 9: one camera, free poses."""
    scene, actual = noisy
    observations = scene.data.observations
    numbers, rebuild = ravel_pytree(actual.camera)
    n = len(numbers)

    @jax.jit
    def residuals(step):
        moved = SE3.exp(step[n:].reshape(-1, 6)) @ actual.camera_from_world
        r = pixel_residuals(observations, rebuild(numbers + step[:n]), moved)
        return jnp.where(actual.inliers[..., None], r, 0.0).ravel()

    jacobian = jax.jit(jax.jacfwd(residuals))
    batch = least_squares(
        lambda x: np.asarray(residuals(x)),
        np.zeros(n + 6 * VIEWS),
        jac=lambda x: np.asarray(jacobian(x)),
        x_scale="jac",
        xtol=1e-14,
        ftol=1e-14,
    )
    covariance = np.linalg.inv(batch.jac.T @ batch.jac) * 0.15**2
    std = np.sqrt(np.diag(covariance))
    assert np.abs(batch.x / std).max() < 0.1
    np.testing.assert_allclose(np.sqrt(np.diag(actual.covariance)), std, rtol=0.025)


def test_outliers_are_gated_and_good_points_kept():
    scene = random_scene(1, VIEWS, outlier_fraction=0.1)
    fit = fit_staged(scene.data).step2
    assert fit.converged
    kept_outliers = int(np.asarray(scene.outliers & fit.inliers).sum())
    lost = int(np.asarray(scene.data.visible & ~scene.outliers & ~fit.inliers).sum())
    assert kept_outliers == 0
    assert lost <= 3
    assert float(fit.pixel_sigma) == pytest.approx(0.15, rel=0.1)


def test_views_that_fit_worse_keep_their_points(noisy):
    """Two views of 0.4 px noise among 0.15 px, as of a target of slightly another shape."""
    scene, actual = noisy
    pixels = np.array(scene.data.pixels)
    pixels[[2, 5]] += np.random.default_rng(0).normal(0.0, 0.37, pixels[[2, 5]].shape)
    blurred = dataclasses.replace(scene.data, pixels=jnp.asarray(pixels))
    fit = kalman_filter(blurred.observations, actual.camera, actual.camera_from_world)
    assert np.sum(np.asarray(blurred.visible & ~fit.inliers)) <= 1


def test_each_view_is_judged_by_its_own_noise_where_that_is_larger():
    """Of Gaussian residuals, with the quantile of chi-square as the gate."""
    stds, rng = np.array([1.0, 1.0, 2.0, 50.0, 0.1]), np.random.default_rng(0)
    residuals = stds[:, None, None] * rng.normal(size=(5, 4000, 2))
    every_point = np.ones((5, 4000), dtype=bool)
    quantile = chi2.ppf(0.9999, 2)
    limits = outlier_limits(residuals, every_point, 1.0, CommonCameraOptions())
    # Most points of the fourth view are wrong.
    expected = quantile * np.array([1.0, 1.0, 2.0, 3.0, 1.0]) ** 2
    np.testing.assert_allclose(limits, expected, rtol=0.06)
    known = outlier_limits(residuals, every_point, 1.0, CommonCameraOptions(pixel_sigma=1.0))
    np.testing.assert_allclose(known, quantile, rtol=1e-6)


def test_a_limit_stays_while_the_noise_of_its_view_changes_by_chance():
    """Limits of 4,000 views with the same noise scatter about it by their standard error."""
    residuals = 2.0 * np.random.default_rng(0).normal(size=(4000, 61, 2))
    every_point, options = np.ones(residuals.shape[:2], dtype=bool), CommonCameraOptions()
    true = np.full(4000, 4.0 * chi2.ppf(0.9999, 2))
    limits = outlier_limits(residuals, every_point, 1.0, options, true)
    assert np.mean(limits == true) == pytest.approx(norm.cdf(1.0) - norm.cdf(-1.0), abs=0.02)
    new = outlier_limits(residuals, every_point, 1.0, options)
    np.testing.assert_array_equal(limits[limits != true], new[limits != true])


def test_a_point_at_the_limit_is_not_rejected_and_readmitted_for_ever():
    """In this scene its view has a larger limit without it, and a smaller one with it."""
    scene, camera, poses = scene_and_start(102)
    fit = kalman_filter(scene.data.observations, camera, poses)
    assert fit.converged, fit.message
    assert fit.passes < 10


def test_a_known_camera_is_held(noisy):
    scene, actual = noisy
    held = kalman_filter(
        scene.data.observations,
        scene.calibration.camera,
        actual.camera_from_world,
        options=HELD,
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
    fit = kalman_filter(poisoned, camera, poses)
    assert fit.converged
    assert np.isfinite(fit.covariance).all()
    np.testing.assert_allclose(fit.camera_from_world.wxyz_xyz[5], poses.wxyz_xyz[5], atol=1e-9)


def test_real_data_agree_with_opencv(circles):
    data, _, fit = circles
    # The sigma of that fit is so large that it gates nothing: OpenCV uses every point.
    actual = fit.step2
    points = [np.asarray(p, dtype=np.float32) for p in data.points]
    pixels = [np.asarray(p, dtype=np.float32) for p in data.pixels]
    rms, K, _, _, _ = cv2.calibrateCamera(
        points, pixels, (640, 480), None, None, flags=cv2.CALIB_FIX_K3
    )
    assert float(actual.rms) == pytest.approx(rms, rel=0.01)
    assert float(actual.camera.alpha_u) == pytest.approx(K[0, 0], rel=1e-3)
    assert float(actual.camera.v0) == pytest.approx(K[1, 2], abs=0.5)


def test_the_filter_compiles_two_programs():
    """Both serve a known camera too; every operation on the host is NumPy's.

    No other test has as many points, so that no program is there yet.
    """
    scene, camera, poses = scene_and_start(7, points=paper_points((0.0,))[:41])
    start = jax.tree.map(np.asarray, (scene.data.observations, camera, poses))
    with programs_added() as built:
        kalman_filter(*start)
        kalman_filter(*start, options=HELD)
    assert len(built) == 2
