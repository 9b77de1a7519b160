"""Touches correct a calibration as far as they predict, and as a least-squares solver does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import smartview_jax as sv
from smartview_jax.engine import Parameters, Step
from smartview_jax.evaluation import stylus_error, touching_pose
from smartview_jax.geometry import host_matrices, host_transforms
from smartview_jax.grasping import correct_by_touches, stylus_orientations, tip_error_factor
from smartview_jax.joint import SavedEstimate

NOISE = sv.Noise(pixel=0.15, translation=1e-4, rotation=1e-4)
MEASUREMENT = 5e-5
TIP = np.array([0.01, -0.02, 0.15])
DOWN = np.diag([1.0, -1.0, -1.0])


def touching(points):
    """Upright touches of points, each turned a little further about the stylus."""
    turns = np.arange(len(points))
    rotations = np.array([sv.geometry.host_exponentials(np.eye(6)[5] * t)[:3, :3] for t in turns])
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, :3] = stylus_orientations(TIP, rotations @ DOWN)
    return host_matrices(touching_pose(TIP, host_transforms(poses).rotation(), points))


TOUCHED = touching(np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.1, 0.1, 0.0]]))
LATER = touching(np.array([[0.05, 0.03, 0.0], [0.02, 0.08, 0.02], [0.0, 0.05, 0.0], [0.1, 0, 0]]))


@pytest.fixture(scope="module")
def estimate():
    scene = sv.simulation.random_scene(0, views=5, pixel_noise=0.15)
    bound = sv.cramer_rao(scene.calibration, scene.data, NOISE)
    return SavedEstimate(
        bound.calibration,
        np.asarray(bound.covariance),
        bound.parameter_names,
        NOISE,
        NOISE.pixel,
        bound.observability,
    )


@pytest.fixture(scope="module")
def touches(estimate):
    return sv.tool_commands(estimate.calibration, TOUCHED, estimate=estimate)


def drawn_truth(estimate, rng):
    """A true calibration as far from the estimate as its covariance says."""
    names = sv.engine.parameter_names(estimate.calibration)
    step = np.zeros(len(names))
    rows = [names.index(name) for name in estimate.parameter_names]
    step[rows] = rng.multivariate_normal(np.zeros(len(rows)), estimate.covariance)
    return retracted(estimate.calibration, jnp.asarray(step))


@jax.jit
def retracted(calibration, step):
    return Parameters(calibration).retract(Step(step, jnp.zeros((0, 6))))[0]


@jax.jit
def missed(calibration, truth, poses, noise):
    return stylus_error(calibration, truth, TIP, poses, noise)


def misses_of(calibration, truth, poses, rng):
    sigmas = np.repeat([NOISE.translation, NOISE.rotation], 3)
    noise = sigmas * rng.standard_normal((len(poses), 6))
    return np.asarray(missed(calibration, truth, host_transforms(poses), noise))


def test_the_tool_s_later_error_falls_as_predicted(estimate, touches):
    rng = np.random.default_rng(0)
    actual, predicted, distances = [], [], []
    for _ in range(60):
        truth = drawn_truth(estimate, rng)
        misses = misses_of(estimate.calibration, truth, TOUCHED, rng)
        misses = misses + MEASUREMENT * rng.standard_normal(misses.shape)
        corrected = correct_by_touches(estimate, touches, TIP, misses, measurement_std=MEASUREMENT)
        later = sv.tool_commands(corrected.calibration, LATER, estimate=corrected)
        factor = tip_error_factor(later, TIP)
        error = misses_of(corrected.calibration, truth, LATER, rng)
        actual.append(error)
        predicted.append(factor)
        stacked = factor.reshape(error.size, -1)
        distances.append(error.ravel() @ np.linalg.solve(stacked @ stacked.T, error.ravel()))
    before = tip_error_factor(sv.tool_commands(estimate.calibration, LATER, estimate=estimate), TIP)
    # Sums over the three axes and over all independent errors, means over touches and draws.
    rms = np.sqrt(np.mean(np.sum(np.square(actual), axis=-1)))
    expected = np.sqrt(np.mean(np.sum(np.square(predicted), axis=(-2, -1))))
    assert rms == pytest.approx(expected, rel=0.1)
    assert expected < 0.8 * np.sqrt(np.mean(np.sum(np.square(before), axis=(-2, -1))))
    # The mean of 60 chi-squares of 12 components is known to 0.63.
    assert np.mean(distances) == pytest.approx(12.0, abs=1.9)


def test_the_correction_is_the_least_squares_answer(estimate, touches):
    """Prior and misses as rows of one system, solved by NumPy."""
    rng = np.random.default_rng(1)
    misses = 2e-4 * rng.standard_normal((4, 2))
    corrected = correct_by_touches(
        estimate, touches, TIP, misses, measurement_std=MEASUREMENT, tip_std=1e-4
    )
    factor = tip_error_factor(touches, TIP)
    by_tip = 1e-4 * touches.world_from_tool[:, :3, :3]
    rows = np.concatenate([factor, by_tip], axis=2)[:, :2].reshape(8, -1) / MEASUREMENT
    system = np.concatenate([np.eye(rows.shape[1]), rows])
    right = np.concatenate([np.zeros(rows.shape[1]), misses.ravel() / MEASUREMENT])
    errors = np.linalg.lstsq(system, right, rcond=None)[0]
    count = touches.parameter_factor.shape[1]
    step = np.asarray(Parameters(estimate.calibration).step_to(corrected.calibration))
    known = sv.engine.parameter_names(estimate.calibration)
    stepped = [known.index(name) for name in touches.parameter_names]
    expected = touches.parameter_factor @ errors[:count]
    np.testing.assert_allclose(step[stepped], expected, rtol=1e-6, atol=1e-12)
    remaining = np.linalg.inv(system.T @ system)[:count, :count]
    names = list(touches.parameter_names)
    at = [corrected.parameter_names.index(name) for name in names]
    full = touches.parameter_factor @ remaining @ touches.parameter_factor.T
    np.testing.assert_allclose(corrected.covariance[np.ix_(at, at)], full, rtol=1e-5, atol=1e-16)
    assert (np.diag(corrected.covariance) <= np.diag(estimate.covariance) * (1 + 1e-9)).all()


def test_a_tip_that_is_not_known_takes_the_blame(estimate, touches):
    """A miss that turns with the tool is the tip's, one that stays in the world the target's."""
    turned = touches.world_from_tool[:, :3, :3] @ np.array([2e-4, 0.0, 0.0])
    exact, doubtful = (
        correct_by_touches(
            estimate, touches, TIP, turned, measurement_std=MEASUREMENT, tip_std=std
        ).calibration
        for std in (0.0, 1e-3)
    )
    start = Parameters(estimate.calibration)
    first, second = (np.linalg.norm(start.step_to(fit)[-7:-4]) for fit in (exact, doubtful))
    assert second < 0.3 * first


def test_what_is_wrong_is_said(estimate, touches):
    exact = sv.tool_commands(estimate.calibration, TOUCHED)
    fine = np.zeros((4, 3))
    for commands, misses, std, message in (
        (exact, fine, 1e-4, "the calibration was taken as exact"),
        (touches, fine[:3], 1e-4, r"for each of 4 touches, found \[\["),
        (touches, fine + np.nan, 1e-4, "finite"),
        (touches, fine, 0.0, "positive measurement_std"),
    ):
        with pytest.raises(ValueError, match=message):
            correct_by_touches(estimate, commands, TIP, misses, measurement_std=std)


def test_misses_that_no_error_explains_are_refused_with_their_cause(estimate, touches):
    """Millimetres given as metres, a touch on another point, another base frame."""
    fine = 1e-4 * np.array([[1.0, 0.5, 0.0], [0.8, 0.5, 0.2], [1.2, 0.4, 0.1], [1.0, 0.7, 0.0]])
    one_wrong, shifted = fine.copy(), fine + np.array([0.03, -0.02, 0.0])
    one_wrong[2, 0] += 0.02
    tilted = fine + 0.02 * np.eye(4, 3)
    for misses, cause in (
        (1e3 * fine, "millimetres given as metres"),
        (one_wrong, "touch 3 contradicts the others: it was on another point"),
        (shifted, r"all touches miss alike, by about \(30.10, -19.95, 0.\d+\) mm"),
        (tilted, "the target's size"),
    ):
        with pytest.raises(ValueError, match=cause):
            correct_by_touches(estimate, touches, TIP, misses, measurement_std=MEASUREMENT)
    correct_by_touches(estimate, touches, TIP, fine, measurement_std=MEASUREMENT)
