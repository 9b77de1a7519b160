"""Trackers that add up motions, such as visual odometry: their drift, and what is said of it."""

import numpy as np
import pytest
from tracked_scene import VIEWS, mount_covariance, mount_error, tracked

import smartview_jax as sv
from smartview_jax.dataset import PoseDataset
from smartview_jax.engine import step_names
from smartview_jax.evaluation import mean_nees, nees
from smartview_jax.geometry import host_exponentials
from smartview_jax.joint import TrackerPrior

STEPS = (2e-3, 3e-3)
"""Standard deviations by axis of the error that is new in a view, m and rad."""


def odometry(seed, scale=1.0):
    """Robot poses, and poses of a camera that adds up its motions."""
    robot, measured = tracked(seed)
    rng = np.random.default_rng([seed, 1])
    new = host_exponentials(rng.normal(size=(VIEWS, 6)) * np.repeat(STEPS, 3))
    added = measured.copy()
    for view in range(1, VIEWS):
        motion = measured[view] @ np.linalg.inv(measured[view - 1])
        added[view] = new[view] @ motion @ added[view - 1]
    added[:, :3, 3] /= scale
    return robot, added


def fit_of(seed, **given):
    return sv.fit_poses(PoseDataset.from_poses(*odometry(seed)), field=None, **given)


@pytest.fixture(scope="module")
def fits():
    return [fit_of(seed) for seed in range(3)]


def test_the_covariance_allows_for_the_drift(fits):
    errors = np.array([mount_error(fit) for fit in fits])
    covariances = np.array([mount_covariance(fit) for fit in fits])
    for fit, covariance in zip(fits, covariances, strict=True):
        stds = [fit.std[name] for name in step_names(fit.calibration.transform_names[0])]
        np.testing.assert_allclose(stds, np.sqrt(np.diagonal(covariance)), rtol=1e-9)
    scores = nees(errors, covariances)
    assert mean_nees(scores, 6).is_consistent
    steady = fit_of(0, tracker_prior=TrackerPrior(drift_probability=0.0))
    assert steady.drift is None
    assert not any("drifts" in text for text in steady.warnings)


def test_the_drift_is_said_with_its_size(fits):
    for fit in fits:
        assert fit.drift is not None
        np.testing.assert_allclose(fit.drift.steps, STEPS, rtol=0.6)
        assert fit.warnings[0].startswith("the tracker drifts: by up to ")
        assert "if the pairs are in the order in which they were measured" in str(fit)
        assert ", drifting by +- " in fit.described_noise


def test_pairs_out_of_order_have_no_drift():
    robot, measured = odometry(0)
    order = np.random.default_rng(0).permutation(VIEWS)
    fit = sv.fit_poses(PoseDataset.from_poses(robot[order], measured[order]), field=None)
    assert fit.drift is None


def test_a_drifting_camera_without_a_unit():
    fit = sv.fit_poses(PoseDataset.from_poses(*odometry(2, scale=2.5)), scale=True, field=None)
    assert fit.drift is not None
    std = fit.std["target_scale"]
    assert abs(np.log(float(fit.calibration.target_scale) / 2.5)) < 3.0 * std
    assert 1e-3 < std < 0.1


def test_a_unit_of_the_trackers_own_is_not_taken_for_a_drift(fits):
    data = PoseDataset.from_poses(*odometry(2, scale=2.5))
    fit = sv.fit_poses(data, field=None)
    asked = sv.fit_poses(data, scale=True, field=None)
    np.testing.assert_allclose(mount_error(fit), mount_error(asked), atol=1e-9)
    (text,) = set(fit.warnings) - set(asked.warnings)
    assert text.startswith("the tracker's unit of length is its own, 2.")
    assert all(float(metres.calibration.target_scale) == 1.0 for metres in fits)


def test_a_steady_tracker_in_another_unit_is_left_to_the_joint_fit():
    robot, measured = tracked(3)
    measured[:, :3, 3] /= 1.5
    fit = sv.fit_poses(PoseDataset.from_poses(robot, measured), field=None)
    assert any("of its stated size" in text for text in fit.warnings)


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"drift_probability": 1.0}, "drift_probability: expected at least 0 and less than 1"),
        ({"drift_median": 0.0}, "drift_median: expected a positive number, found 0.0"),
        ({"drift_geometric_std": 1.0}, "drift_geometric_std: expected a factor above 1"),
    ],
)
def test_wrong_priors_are_named(given, match):
    with pytest.raises(ValueError, match=match):
        TrackerPrior(**given)
