import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from standard_scene import POINTS, VIEWS
from starts import nudged

from smartview_jax import Noise, fit_joint
from smartview_jax.engine import PoseDirections
from smartview_jax.evaluation import (
    expected_reprojection_errors,
    fit_folds,
    predicted_error,
    reprojection_errors,
)
from smartview_jax.geometry import as_se3, host_exponentials, host_matrices
from smartview_jax.simulation import random_scene, simulate

NOISE = Noise(pixel=0.15, translation=2e-4, rotation=5e-4)


@functools.cache
def noisy_scene(seed):
    return random_scene(seed, VIEWS, POINTS, translation_noise=2e-4, rotation_noise=5e-4)


def fit(data, **options):
    return fit_joint(data, nudged(TRUTH), noise=NOISE, **options)


TRUTH = noisy_scene(0).calibration


@pytest.fixture(scope="module")
def fitted():
    return fit(noisy_scene(0).data)


def test_a_fit_whose_model_is_true_is_as_far_off_as_it_expects():
    """Over fits to few views, where the parameters' own errors are no small part."""
    poses = noisy_scene(1000).base_from_tool
    squares = []
    for seed in range(8):
        found = fit(noisy_scene(seed).data.mask_views(range(6, VIEWS)))
        unseen = simulate(TRUTH, poses, POINTS, 100 + seed, 0.15, 2e-4, 5e-4).data
        both = (
            expected_reprojection_errors(found, unseen),
            reprojection_errors(found.calibration, unseen),
        )
        squares.append([one.rms**2 for one in (*both, reprojection_errors(TRUTH, unseen))])
    predicted, realised, exact = np.sqrt(np.mean(squares, axis=0))
    assert realised / predicted == pytest.approx(1.0, abs=0.15)
    assert predicted > 1.08 * exact


def test_the_robots_noise_is_that_of_a_simulation(fitted):
    """The part that poses have in the expected square, against poses that err."""
    poses = noisy_scene(3).base_from_tool
    drawn = [simulate(TRUTH, poses, POINTS, seed, 0.0, 2e-4, 5e-4).data for seed in range(40)]
    squares = np.stack([reprojection_errors(TRUTH, data).px ** 2 for data in drawn])
    exact = dataclasses.replace(fitted, calibration=TRUTH)
    still = dataclasses.replace(exact, noise=Noise(0.15, 1e-12, 1e-12))
    data = drawn[0]
    by_poses = [expected_reprojection_errors(f, data).px ** 2 for f in (exact, still)]
    share = np.nanmean(squares) / np.nanmean(by_poses[0] - by_poses[1])
    assert share == pytest.approx(1.0, abs=0.15)


def test_noise_along_the_tool_moves_pixels_as_in_a_simulation(fitted):
    """A millimetre along the tool moves them less than a millimetre across it."""
    sigmas = np.array([5e-5, 5e-5, 1e-3, 5e-5, 5e-5, 5e-5])
    directions = PoseDirections.of(np.diag(sigmas**2), np.zeros((6, 6)))
    poses = noisy_scene(3).base_from_tool
    data = simulate(TRUTH, poses, POINTS, 0, 0.0).data
    rng, squares = np.random.default_rng(0), []
    for _ in range(40):
        errors = host_exponentials(sigmas * rng.standard_normal((VIEWS, 6)))
        reported = as_se3(host_matrices(data.base_from_tool) @ errors)
        erring = dataclasses.replace(data, base_from_tool=reported)
        squares.append(reprojection_errors(TRUTH, erring).px ** 2)
    exact = dataclasses.replace(fitted, calibration=TRUTH)
    still = dataclasses.replace(exact, noise=Noise(0.15, 1e-12, 1e-12))
    along = dataclasses.replace(exact.noise, directions=directions)
    by_direction = dataclasses.replace(exact, noise=along)
    expected = [expected_reprojection_errors(f, data).px ** 2 for f in (by_direction, still)]
    share = np.nanmean(squares) / np.nanmean(expected[0] - expected[1])
    assert share == pytest.approx(1.0, abs=0.15)


def test_pixels_that_err_together_move_a_views_pose_alone(fitted):
    """The effective sigma acts through a pose's six columns, the white one on all pixels."""
    data, calibration = noisy_scene(0).data, fitted.calibration
    pose = SE3(calibration.camera_from_world(data.base_from_tool).wxyz_xyz[2])
    seen = np.asarray(data.visible[2])

    def pixels(twist):
        return calibration.camera.project((SE3.exp(twist) @ pose) @ data.points[2])[0][seen]

    columns = np.asarray(jax.jit(jax.jacfwd(pixels))(jnp.zeros(6))).reshape(-1, 6)
    onto = columns @ np.linalg.pinv(columns)
    pixel = 0.2**2 * np.eye(len(onto)) + (0.9**2 - 0.2**2) * onto
    noises = [Noise(0.9, 2e-4, 5e-4, white_pixel=0.2), Noise(0.2, 2e-4, 5e-4)]
    both, white = (
        expected_reprojection_errors(
            dataclasses.replace(fitted, noise=n, pixel_sigma=0.2), data
        ).px[2]
        for n in noises
    )
    expected = (np.trace(pixel) - 2.0 * 0.2**2 * seen.sum()) / seen.sum()
    assert np.mean(both[seen] ** 2 - white[seen] ** 2) == pytest.approx(expected, rel=1e-9)


def test_every_fold_states_what_it_expects_of_the_views_it_never_saw():
    data = noisy_scene(0).data
    found = predicted_error(fit_folds(data, fit, 4), data)
    assert found.predicted.folds == found.actual.folds
    assert 0.4 < found.rms_ratio < 2.5
    square = [np.nansum(side.errors.px**2) for side in found]
    assert found.rms_ratio == pytest.approx(np.sqrt(square[1] / square[0]))


def test_a_fit_that_claims_too_little_noise_is_found_out():
    data = noisy_scene(0).data
    boast = Noise(0.15, 1e-6, 1e-6)
    found = predicted_error(
        fit_folds(data, lambda d: fit_joint(d, nudged(TRUTH), noise=boast), 4), data
    )
    assert found.rms_ratio > 2.5


def test_what_is_open_expects_nothing(fitted):
    data = noisy_scene(0).data
    anywhere = dataclasses.replace(fitted, noise=Noise(0.15, np.inf, 5e-4))
    with pytest.raises(ValueError, match="nothing can be predicted"):
        expected_reprojection_errors(anywhere, data)
    found = predicted_error(fit_folds(data, lambda _: anywhere, 4), data)
    assert [fold for fold, _ in found.predicted.failures] == [0, 1, 2, 3]
    assert found.actual.failures == ()
    assert np.isnan(found.rms_ratio)


def test_points_that_cannot_be_seen_or_predicted_are_marked_as_deviations_are(fitted):
    data = noisy_scene(0).data
    found, px = (
        expected_reprojection_errors(fitted, data),
        reprojection_errors(fitted.calibration, data).px,
    )
    np.testing.assert_array_equal(np.isnan(found.px), np.isnan(px))
