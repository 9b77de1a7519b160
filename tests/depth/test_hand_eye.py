"""The hand-eye transform from a depth sensor: each view counts by its own covariance."""

import dataclasses
import re

import jax.numpy as jnp
import numpy as np
import pytest
from host_poses import transform_errors
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import smartview_jax as sv
from benchmarks.transform_errors import stated_covariance
from smartview_jax.dataset import DepthSensor, PoseDataset
from smartview_jax.evaluation import mean_nees, nees
from smartview_jax.geometry import host_exponentials, host_matrices, host_transformed
from smartview_jax.joint import start_from_poses
from smartview_jax.simulation import simulate_depth_points

VIEWS = 12
SENSOR = DepthSensor(1.02, 1e-3, 0.0, 0.0, 0.0, 1e-4, 5e-4)
ROBOT = np.repeat([5e-5, 1e-4], 3)
"""Standard deviations of reported poses, m and rad."""

y, x = np.mgrid[:6, :8]
TARGET = np.stack([0.03 * x, 0.03 * y, 0.0 * x], axis=-1).reshape(-1, 3) - [0.105, 0.075, 0.0]
CAMERA_FROM_TOOL = np.linalg.inv(host_exponentials(np.array([0.02, -0.05, 0.08, 0.1, -0.1, 1.5])))
BASE_FROM_WORLD = host_exponentials(np.array([0.6, 0.1, 0.0, 0.0, 0.0, 0.4]))


def scene(seed, farthest=1.5):
    """Robot poses and measured points: from near to far (m), and of some far views few points."""
    rng = np.random.default_rng(seed)
    seen = np.tile(np.eye(4), (VIEWS, 1, 1))
    turns = rng.normal(size=(VIEWS, 3)) * [0.35, 0.35, 1.0]
    seen[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    seen[:, :2, 3] = rng.uniform(-0.05, 0.05, (VIEWS, 2))
    seen[:, 2, 3] = rng.uniform(0.3, farthest, VIEWS)
    robot = BASE_FROM_WORLD @ np.linalg.inv(seen) @ CAMERA_FROM_TOOL
    points = simulate_depth_points(seen, TARGET, SENSOR, rng)
    if farthest > 1.0:
        # A corner of the target in every third view.
        points[::3, (x >= 3).ravel() | (y >= 3).ravel()] = np.nan
    return robot @ host_exponentials(ROBOT * rng.normal(size=(VIEWS, 6))), points


def error_and_covariance(fit):
    """Of the hand-eye transform: translation, m, and rotation vector in the camera's axes, rad."""
    error = transform_errors(fit.calibration.camera_from_tool, CAMERA_FROM_TOOL)
    return error, stated_covariance(fit, "camera_from_tool")


@pytest.fixture(scope="module")
def trials():
    """Robot poses, what was measured, the poses of the target, and the fit, of some draws."""
    made = []
    for seed in range(6):
        robot, points = scene(seed)
        measured = sv.depth.poses_from_points(points, TARGET)
        made.append((robot, points, measured, sv.fit_poses(measured.dataset(robot), field=None)))
    return made


def test_the_optimum_is_the_least_squares_of_all_points(trials):
    """By SciPy, with the sensor's bias and the standard deviations that were found."""
    robot, points, measured, fit = trials[0]
    sensor = measured.sensor
    camera, world = map(
        host_matrices, (fit.calibration.camera_from_tool, fit.calibration.base_from_world)
    )
    corrected = sensor.corrected(points)
    rays = points / np.linalg.norm(points, axis=2, keepdims=True)
    sigmas = np.repeat([fit.noise.translation, fit.noise.rotation], 3)

    def residuals(parameters):
        moved = robot @ host_exponentials(sigmas * parameters[12:].reshape(VIEWS, 6))
        chain = host_exponentials(1e-3 * parameters[:6]) @ camera @ np.linalg.inv(moved)
        chain = chain @ world @ host_exponentials(1e-3 * parameters[6:12])
        # A wrong depth scale is one with a wrong size of the target: the robot's motion may say so.
        chain[:, :3, 3] /= float(fit.calibration.target_scale)
        off = np.where(measured.used[..., None], corrected - host_transformed(chain, TARGET), 0.0)
        off = np.where(np.isfinite(off), off, 0.0)
        along = np.sum(off * np.nan_to_num(rays), axis=2, keepdims=True)
        across = (off - along * np.nan_to_num(rays)) / sensor.across_std
        data = np.concatenate([across.ravel(), along.ravel() / sensor.along_std])
        return np.concatenate([data / fit.pixel_sigma, parameters[12:]])

    best = least_squares(residuals, np.zeros(12 + 6 * VIEWS))
    std = 1e-3 * np.sqrt(np.diagonal(np.linalg.inv(best.jac.T @ best.jac)))[:6]
    # The points' axes, and the fit's own steps, are of first order: a few hundredths.
    assert np.abs(1e-3 * best.x[:6] / std).max() < 0.05


def test_the_covariance_of_the_hand_eye_transform_is_true(trials):
    errors, covariances = map(
        np.array, zip(*(error_and_covariance(t[3]) for t in trials), strict=True)
    )
    assert mean_nees(nees(errors, covariances), 6).is_consistent


def test_an_unknown_offset_is_an_error_that_no_view_reveals(trials):
    """All depths too large by d put the camera too far back by d, on top of all other errors."""
    robot, _, measured, _ = trials[0]
    moved = np.zeros((VIEWS, 6, 2))
    moved[:, 2, 1] = 1.0
    unsure = dataclasses.replace(measured.sensor, scale_std=1e-9, offset_std=1e-3, correlation=0.0)
    data = dataclasses.replace(
        measured.dataset(robot), sensor=unsure, sensor_changes=jnp.asarray(moved)
    )
    known = dataclasses.replace(data, sensor=None)
    std, std_known = (sv.fit_poses(d, field=None).std for d in (data, known))
    z = "camera_from_tool.translation.z"
    assert std[z] == pytest.approx(np.hypot(std_known[z], 1e-3), rel=0.02)
    # The other numbers do not depend on it.
    for name in ("camera_from_tool.translation.x", "base_from_world.translation.z"):
        assert std[name] == pytest.approx(std_known[name], rel=0.05)


def test_the_distance_of_the_points_is_told_by_view(trials):
    """Of two directions across the ray and one along it, less what a pose takes of few points."""
    for robot, _, measured, _ in trials[:2]:
        data = measured.dataset(robot)
        expected = np.sqrt(2.0 * SENSOR.across_std**2 + SENSOR.along_std**2)
        whole = np.arange(VIEWS) % 3 > 0
        np.testing.assert_allclose(data.point_rms[whole], expected, rtol=0.3)
        assert np.sqrt(np.mean(np.square(data.point_rms[whole]))) == pytest.approx(
            expected, rel=0.1
        )
        part = data.select([2, 5])
        np.testing.assert_array_equal(part.point_rms, data.point_rms[np.array([2, 5])])


def test_the_sensor_is_said_with_the_fit(trials):
    _, _, measured, fit = trials[0]
    assert fit.sensor is measured.sensor
    assert f"depth sensor: depths times {fit.sensor.scale:.5f} +- " in str(fit)
    assert "mm across the line of sight" in fit._repr_html_()


def test_wrong_covariances_are_named(trials):
    robot, _, measured, _ = trials[0]
    data = PoseDataset.from_poses(robot, measured.camera_from_world)
    wrong = measured.covariance.copy()
    wrong[3, 0, 0] *= -1.0
    skew = measured.covariance.copy()
    skew[2, 0, 1] += 1e-6 * np.sqrt(skew[2, 0, 0] * skew[2, 1, 1])
    for covariance, message in (
        (wrong[:2], r"covariance: expected shape \(12, 6, 6\), found \(2, 6, 6\)"),
        (wrong, "covariance: view 3: expected a symmetric, positive definite matrix"),
        (0.0 * wrong, "covariance: view 0: expected a symmetric, positive definite"),
        (skew, "covariance: view 2: expected a symmetric, positive definite"),
    ):
        with pytest.raises(ValueError, match=message):
            data.with_covariance(covariance)
    stated = data.with_covariance(measured.covariance)
    with pytest.raises(ValueError, match="tracker_prior: the data set states the covariance"):
        sv.fit_poses(stated, tracker_prior=sv.joint.TrackerPrior())


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        ([0.005 * (k >= 6) for k in range(VIEWS)], "from view 6 on, .* the camera had been moved"),
        ([0.012 * k / (VIEWS - 1) for k in range(VIEWS)], "as if the camera crept on the tool"),
    ],
    ids=["a step", "a drift"],
)
def test_a_mount_that_gives_way_is_named(steps, words):
    """A depth sensor does not drift by itself, as trackers do."""
    robot, points = scene(2, 0.7)
    moved = points + np.array(steps)[:, None, None] * [1.0, 0.0, 0.0]
    measured = sv.depth.poses_from_points(moved, TARGET)
    doubts = start_from_poses(measured.dataset(robot)).ambiguities
    assert [text for text in doubts if re.search(words, text)]
    steady = sv.depth.poses_from_points(points, TARGET).dataset(robot)
    assert start_from_poses(steady).ambiguities == ()


def test_a_mount_that_moved_too_far_leaves_no_calibration():
    robot, points = scene(2, 0.7)
    after = (np.arange(VIEWS) >= 6)[:, None, None]
    measured = sv.depth.poses_from_points(points + after * [0.1, 0.0, 0.0], TARGET)
    with pytest.raises(ValueError, match=r"from view 6 on, .* the camera had been moved"):
        start_from_poses(measured.dataset(robot))
