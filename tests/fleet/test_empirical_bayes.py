"""What robots of one type have in common, and which of them are of another type."""

import pickle

import numpy as np
import pytest
from fit_scenes import scene_of

from smartview_jax import fit_joint, fleet_prior
from smartview_jax.fleet.empirical_bayes import _common_sizes, _shares
from smartview_jax.robot_errors import RobotPrior
from smartview_jax.simulation import six_axis_scene
from smartview_jax.variance import SizesOfErrors

ROBOTS, OUTSIDERS, VIEWS = 9, (2, 7), 5
ZEROS = float(np.deg2rad(0.1))
ERRORS = {"joint_offset": ZEROS, "link_length": 1e-6, "link_twist": 1e-6}


def fit_of(number, scale=1.0, prior=None):
    """A robot's fit, begun at the truth: only the sizes of its errors matter here."""
    scene = six_axis_scene(
        number,
        VIEWS,
        held_out_views=1,
        error_scale=scale,
        error_sigma=ERRORS,
        warp_range=(0.0, 0.0),
    ).with_joint_readings
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


def test_fits_without_anything_in_common_are_named(fits):
    with pytest.raises(ValueError, match="expected at least two fits, found 1"):
        fleet_prior(fits[:1])
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
