"""What robots of one type have in common, and which of them are of another type."""

import inspect
import pickle

import equinox as eqx
import numpy as np
import pytest
from fit_scenes import scene_of

from smartview_jax import fit_joint, fleet_prior, load_estimate
from smartview_jax.fleet.empirical_bayes import _common_sizes, _shares
from smartview_jax.joint import parameter_estimates
from smartview_jax.joint.plausibility import _half_widths_with_last_joint_held
from smartview_jax.robot_errors import RobotError, RobotPrior
from smartview_jax.robots import six_axes
from smartview_jax.runtime.array_namespace import to_device
from smartview_jax.simulation import random_kinematic_errors, six_axis_scene
from smartview_jax.variance import SizesOfErrors

ROBOTS, OUTSIDERS, VIEWS = 9, (2, 7), 5
ZEROS = float(np.deg2rad(0.1))
ERRORS = {"joint_offset": ZEROS, "link_length": 1e-6, "link_twist": 1e-6}


def scene_of_robot(number, scale=1.0, arm_error=None):
    """Five views of a flat board by a robot."""
    scene = six_axis_scene(
        number,
        VIEWS,
        held_out_views=1,
        error_scale=scale,
        error_sigma=ERRORS,
        warp_range=(0.0, 0.0),
        arm_error=arm_error,
    )
    return scene.with_joint_readings


def fit_of(number, scale=1.0, prior=None, arm_error=None):
    """A robot's fit, begun at the truth: only its errors matter here."""
    scene = scene_of_robot(number, scale, arm_error)
    start = scene.calibration.uncorrected
    return fit_joint(scene.data, start, lens="opencv4", gross_errors="keep", robot_prior=prior)


@pytest.fixture(scope="module")
def fits():
    """Fits of robots of one type, and of two whose zeros are twenty times as wrong."""
    return [fit_of(k, 20.0 if k in OUTSIDERS else 1.0) for k in range(ROBOTS)]


def white_noise_alone(fit):
    return sum(one.probability for one in fit.noise_estimate.candidates if "white" in one.name)


def test_the_type_is_found_and_the_next_robot_gains(fits):
    prior = fleet_prior(fits)
    assert prior.outsiders == OUTSIDERS
    # Only four of the six joints have errors.
    size, spread = prior.group_medians["joint_offset"], prior.geometric_std_of("joint_offset")
    assert size / 1.5 < np.sqrt(4 / 6) * ZEROS < size * 1.5
    assert spread < RobotPrior().geometric_std_of("joint_offset")
    assert prior.model in ("joint_offsets", "dh")
    assert pickle.loads(pickle.dumps(prior)) == prior
    assert white_noise_alone(fit_of(ROBOTS, 1.0, prior)) < 0.5 * white_noise_alone(fit_of(ROBOTS))


TYPE_ZEROS = np.deg2rad([0.0, 0.3, -0.2, 0.25, -0.3, 0.0])
"""Zeros that are wrong in all robots of a type alike."""


def error_of(number):
    """A robot's errors: those of its type, and its own, which are a tenth of these."""
    own = random_kinematic_errors(six_axes(), np.random.default_rng(number), 0.2, ERRORS)
    whole = np.array(own.coefficients)
    whole[:6] += TYPE_ZEROS
    return RobotError(own.field, to_device(whole))


@pytest.fixture(scope="module")
def of_type():
    """The prior of a type whose robots have wrong zeros in common, and the next robot's fit."""
    prior = fleet_prior(fit_of(k, arm_error=error_of(k)) for k in range(3))
    return prior, fit_of(5, prior=prior, arm_error=error_of(5))


@pytest.fixture(scope="module")
def alone():
    """The next robot's fit without this prior."""
    return fit_of(5, arm_error=error_of(5))


def test_the_next_robot_has_the_errors_of_its_type(of_type, alone):
    prior, fit = of_type
    mean = prior.common_errors.mean_and_std
    # The zeros of the first and the last joint are the target's pose and the hand-eye transform.
    for joint in (2, 3, 4, 5):
        value, std = mean[f"joint_offset.{joint}"]
        assert abs(value - TYPE_ZEROS[joint - 1]) < 3.0 * std
        assert std < 0.5 * abs(TYPE_ZEROS[joint - 1])
    assert "in common joint_offset.2: 0.005" in str(prior)
    assert pickle.loads(pickle.dumps(prior)) == prior
    zeros = np.asarray(fit.calibration.robot_error.whole.coefficients)[1:5]
    truth = np.asarray(error_of(5).coefficients)[1:5]
    about_zero = np.asarray(alone.calibration.robot_error.coefficients)[1:5]
    missed, without = (np.linalg.norm(found - truth) for found in (zeros, about_zero))
    assert missed < 0.7 * without
    assert missed < 0.2 * np.linalg.norm(truth)


def test_a_fit_about_its_type_is_printed_and_read_again(of_type, tmp_path):
    _, fit = of_type
    fit.save(tmp_path / "calibration.yaml")
    again = load_estimate(tmp_path / "calibration.yaml")
    assert eqx.tree_equal(again.calibration.robot_error, fit.calibration.robot_error)
    assert again.parameter_names == fit.parameter_names
    estimates = {estimate.name: estimate for estimate in parameter_estimates(fit)}
    zero = estimates["robot_error.joint_offset.2"]
    # The whole error, in degrees, not what the robot deviates from its type.
    assert zero.value == pytest.approx(0.3, abs=0.1)
    assert abs(zero.value - np.rad2deg(error_of(5).coefficients[1])) < 2.0 * zero.half_width
    assert not any("common_error" in name for name in estimates)


def test_the_zero_of_the_last_joint_is_named_with_what_its_type_leaves_open(of_type):
    """No robot tells it, and so it is a part of what is uncertain of the type."""
    _, fit = of_type
    held = _half_widths_with_last_joint_held(fit)
    assert min(held[name] / fit.confidence_half_width(name) for name in held) < 0.8


def test_robots_of_a_type_are_known_by_fits_about_it(of_type, alone):
    """What views say does not depend on the prior of their fit."""
    prior, fit = of_type
    evidence = fit.noise_estimate.robot_evidence
    about_zero = alone.noise_estimate.robot_evidence
    assert evidence.names == about_zero.names
    found, expected = (e.sizes(prior.model, prior) for e in (evidence, about_zero))
    np.testing.assert_allclose(found.sigmas.vector[:3], expected.sigmas.vector[:3], rtol=0.05)


def test_fits_without_anything_in_common_are_named(fits):
    with pytest.raises(ValueError, match="expected at least two fits, found 1"):
        fleet_prior(fits[:1])
    with pytest.raises(TypeError, match=r"fits\[1\]: expected JointFit, found .*fit.json"):
        inspect.unwrap(fleet_prior)([fits[0], "fit.json"])
    scene = scene_of(0)
    given = fit_joint(scene.data, scene.calibration, noise="trusted")
    with pytest.raises(ValueError, match=r"fits\[1\]: expected a fit with noise='estimated'"):
        fleet_prior([fits[0], given])
    without_joints = fit_joint(scene.data, scene.calibration, gross_errors="keep")
    with pytest.raises(
        ValueError, match=r"fits\[1\]: its models .* are white, position, pose, but"
    ):
        fleet_prior([fits[0], without_joints])


def test_sizes_that_are_drawn_are_found_again():
    rng = np.random.default_rng(0)
    mean, spread, general = np.array([-1.0, 2.0, 0.5]), np.array([0.3, 0.3, 0.6]), np.zeros(3)
    sizes = []
    for _ in range(400):
        root = rng.normal(size=(3, 3)) * [1.0, 3.0, 2.0]
        information = root @ root.T
        vector = information @ (mean + spread * rng.normal(size=3)) + root @ rng.normal(size=3)
        sizes.append(SizesOfErrors(information, vector, 0.0))
    # A robot whose views tell nothing, and one of another type, which does not count.
    sizes += [
        SizesOfErrors(np.zeros((3, 3)), np.zeros(3), 0.0),
        SizesOfErrors(1e3 * np.eye(3), 1e4 * np.ones(3), 0.0),
    ]
    members = np.append(np.ones(401), 0.0)
    found, std = _common_sizes(sizes, members, general, np.ones(3))
    np.testing.assert_allclose(found, mean, atol=0.12)
    np.testing.assert_allclose(std, spread, rtol=0.25)
    # Nothing is known but what holds for any robot.
    nothing, std = _common_sizes(sizes[400:401], np.ones(1), general, np.ones(3))
    np.testing.assert_allclose(nothing, general, atol=1e-12)
    assert (std >= 1.0).all()


def test_shares_are_those_of_robots_that_can_be_told_apart():
    logs = np.where(np.arange(10)[None] < [[7], [0]], 0.0, -50.0)
    logs[1, 7:] = 0.0
    shares, probabilities = _shares(logs)
    np.testing.assert_allclose(shares, [7.5 / 11, 3.5 / 11])
    np.testing.assert_array_equal(probabilities[0] > 0.5, np.arange(10) < 7)
