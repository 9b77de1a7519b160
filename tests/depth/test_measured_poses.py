"""Poses from measured points: their errors are as stated, and a sensor's bias is found."""

import numpy as np
import pytest
from host_poses import transform_errors
from scipy.spatial.transform import Rotation

import smartview_jax as sv
from smartview_jax.dataset import DepthSensor
from smartview_jax.geometry import host_exponentials
from smartview_jax.simulation import simulate_depth_points

ACROSS, ALONG = 1e-4, 5e-4
COLUMNS, ROWS, SQUARE = 8, 6, 0.03

y, x = np.mgrid[:ROWS, :COLUMNS]
TARGET = np.stack([SQUARE * x, SQUARE * y, 0.0 * x], axis=-1).reshape(-1, 3)
TARGET -= TARGET.mean(axis=0)


TOOL_FROM_CAMERA = host_exponentials(np.array([0.02, -0.05, 0.08, 0.1, -0.1, 1.5]))
BASE_FROM_WORLD = host_exponentials(np.array([0.6, 0.1, 0.0, 0.0, 0.0, 0.4]))


def poses_of(rng, views=12, tilt=0.35, distances=(0.4, 0.8)):
    """The target before the sensor, tilted, at different distances."""
    turns = rng.normal(size=(views, 3)) * [tilt, tilt, 1.0]
    poses = np.tile(np.eye(4), (views, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    poses[:, :2, 3] = rng.uniform(-0.05, 0.05, (views, 2))
    poses[:, 2, 3] = rng.uniform(*distances, views)
    return poses


def measured(rng, poses, scale=1.0, offset=0.0, wrong=0.0):
    """What a sensor with this bias measures, with noise, some points missing, and some wrong."""
    sensor = DepthSensor(scale, offset, 0.0, 0.0, 0.0, ACROSS, ALONG)
    return simulate_depth_points(poses, TARGET, sensor, rng, wrong)


@pytest.fixture(scope="module", params=[0.0, 0.1], ids=["clean", "wrong"])
def trials(request):
    """Truth and result of some draws, with a depth that is 2 % too small and 1 mm."""
    made = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        poses = poses_of(rng)
        points = measured(rng, poses, 1.02, 1e-3, request.param)
        made.append((poses, points, sv.depth.poses_from_points(points, TARGET)))
    return made


def test_bias_and_noise_are_found(trials):
    assert all(found.converged for _, _, found in trials)
    for truth, found in (("scale", 1.02), ("offset", 1e-3)):
        errors = [
            (getattr(t[2].sensor, truth) - found) / getattr(t[2].sensor, f"{truth}_std")
            for t in trials
        ]
        assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.5
    # 2 % within a tenth.
    assert max(abs(t[2].sensor.scale - 1.02) for t in trials) < 0.002
    assert np.mean([t[2].sensor.across_std for t in trials]) == pytest.approx(ACROSS, rel=0.06)
    assert np.mean([t[2].sensor.along_std for t in trials]) == pytest.approx(ALONG, rel=0.08)


def test_noise_does_not_pull_the_scale_where_views_tell_little():
    """Nearly square on, from one distance: derivatives must not share the points' noise."""
    scores = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        poses = poses_of(rng, 15, tilt=0.1, distances=(0.59, 0.61))
        found = sv.depth.poses_from_points(measured(rng, poses, 1.02), TARGET)
        scores.append((found.sensor.scale - 1.02) / found.sensor.scale_std)
    assert abs(np.mean(scores)) < 0.5
    assert np.mean(np.square(scores)) < 1.7


def test_poses_err_as_stated_and_less_than_by_closed_form(trials):
    squares, errors, closed = [], [], []
    for truth, points, found in trials:
        off = transform_errors(found.camera_from_world, truth)
        information = np.linalg.inv(found.whole_covariance)
        squares += np.einsum("vi,vij,vj->v", off, information, off).tolist()
        errors += np.linalg.norm(off[:, 3:], axis=1).tolist()
        for own, pose in zip(found.sensor.corrected(points), truth, strict=True):
            used = np.isfinite(own[:, 0])
            a, b = TARGET[used], own[used]
            turn, _ = Rotation.align_vectors(b - b.mean(axis=0), a - a.mean(axis=0))
            closed.append((turn * Rotation.from_matrix(pose[:3, :3]).inv()).magnitude())
    assert 5.3 < np.mean(squares) < 7.0
    # Along the rays the points are worse, which a closed form with equal weights does not know.
    assert np.mean(errors) < np.mean(closed)


def test_wrong_points_are_left_out(trials):
    for truth, points, found in trials:
        placed = TARGET @ truth[:, :3, :3].swapaxes(1, 2) + truth[:, None, :3, 3]
        seen = np.isfinite(points[..., 0])
        off = np.linalg.norm(np.nan_to_num(found.sensor.corrected(points) - placed), axis=2)
        assert not found.used[off > 0.01].any()
        assert found.used[seen & (off < 1e-3)].mean() > 0.97
        assert np.isnan(found.residuals[~seen]).all()


@pytest.mark.parametrize("along", [0.0, ALONG], ids=["no noise", "noise along the ray alone"])
def test_points_without_noise_leave_a_finite_covariance_and_no_doubt(along):
    """Such points come from simulations, whose pixels are exact."""
    rng = np.random.default_rng(0)
    camera_from_world = poses_of(rng, 14)
    sensor = DepthSensor(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, along)
    points = simulate_depth_points(camera_from_world, TARGET, sensor, rng, 0.0)
    base_from_tool = BASE_FROM_WORLD @ np.linalg.inv(TOOL_FROM_CAMERA @ camera_from_world)
    found = sv.depth.poses_from_points(points, TARGET)
    assert np.linalg.cond(found.covariance).max() < 1e12
    fit = sv.fit_poses(found.dataset(base_from_tool))
    assert np.isfinite(list(fit.std.values())).all()
    assert not [str(w) for w in fit.warnings if "determine" in str(w)]


@pytest.mark.parametrize(
    ("read", "words"),
    [
        (lambda p: p * [1, -1, -1], r"OpenGL's.* give \(x, -y, -z\)"),
        (lambda p: p[..., [2, 0, 1]] * [1, -1, -1], r"body in ROS.* give \(-y, -z, x\)"),
    ],
    ids=["OpenGL", "ROS"],
)
def test_other_axes_of_the_sensor_are_named(read, words):
    rng = np.random.default_rng(3)
    points = measured(rng, poses_of(rng))
    with pytest.raises(ValueError, match=words):
        sv.depth.poses_from_points(read(points), TARGET)


def test_what_is_advised_for_other_axes_is_right():
    """Each advice, taken, gives the points as they were measured."""
    x, y, z = point = np.array([0.1, 0.2, 0.7])
    a, b, c = x, -y, -z
    np.testing.assert_array_equal((a, -b, -c), point)
    a, b, c = z, -x, -y
    np.testing.assert_array_equal((-b, -c, a), point)


def test_without_the_bias_the_hand_eye_transform_would_be_wrong():
    rng = np.random.default_rng(0)
    camera_from_world = poses_of(rng, 14)
    base_from_tool = BASE_FROM_WORLD @ np.linalg.inv(TOOL_FROM_CAMERA @ camera_from_world)
    found = sv.depth.poses_from_points(measured(rng, camera_from_world, 1.02), TARGET)
    fit = sv.fit_poses(found.dataset(base_from_tool))
    error = np.asarray(fit.calibration.camera_from_tool.as_matrix()) @ TOOL_FROM_CAMERA
    std = np.array([fit.std[f"camera_from_tool.translation.{axis}"] for axis in "xyz"])
    assert np.linalg.norm(error[:3, 3]) < 4.0 * np.linalg.norm(std)
    # 2 % of 0.6 m are 12 mm.
    assert np.linalg.norm(error[:3, 3]) < 1e-3


def test_views_with_too_few_points_have_no_pose():
    rng = np.random.default_rng(3)
    points = measured(rng, poses_of(rng, 4))
    points[1, 3:] = np.nan
    # One row of corners leaves the turn about it open.
    points[2, COLUMNS:] = np.nan
    found = sv.depth.poses_from_points(points, TARGET)
    assert np.isnan(found.camera_from_world[:, 0, 0]).tolist() == [False, True, True, False]
    assert not found.used[1:3].any()
    data = found.dataset(np.tile(np.eye(4), (4, 1, 1)), view_ids="abcd")
    reason = "expected 4 measured points or more that are not in one line"
    assert data.masked_views == (("b", reason), ("c", reason))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: 1e3 * p, "the target seems 990 times its size"),
        (lambda p: -p, "expected a depth above 0, found -"),
        (lambda p: p[:, :-1], r"expected shape \(views, 48, 3\) for 48 target points, found"),
        (lambda p: p * np.nan, "expected a view with 4 points or more .* the most in a view are 0"),
    ],
)
def test_what_cannot_be_is_named(change, message):
    rng = np.random.default_rng(0)
    points = measured(rng, poses_of(rng, 3))
    with pytest.raises(ValueError, match=message):
        sv.depth.poses_from_points(change(points), TARGET)
