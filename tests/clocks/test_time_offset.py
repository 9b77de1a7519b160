"""The clock of a robot that moves while pictures are taken, found from simulated pictures."""

import jax.numpy as jnp
import numpy as np
import pytest
from fit_scenes import POINTS
from jaxlie import SE3
from moving_camera import circling_commands

import smartview_jax as sv
from smartview_jax.clocks.time_offset import at_time_offset, standard_deviation
from smartview_jax.dataset import PoseDataset
from smartview_jax.evaluation import reprojection_errors
from smartview_jax.geometry import as_se3, host_matrices
from smartview_jax.robots import Trajectory
from smartview_jax.simulation import paper_calibration, simulate

OFFSET = 0.035
LOG_TIMES = 1000.0 + np.arange(0.0, 20.0, 0.02)


def simulated(seed, views=15):
    """A camera that circles over the target at some centimetres a second; 0.1 mm of robot noise."""
    rng, calibration = np.random.default_rng(seed), paper_calibration()
    phases = rng.uniform(0.0, 6.0, 4)

    def commands(times):
        return circling_commands(times - LOG_TIMES[0], POINTS, phases)

    times = np.sort(rng.uniform(LOG_TIMES[0] + 1.0, LOG_TIMES[-1] - 1.0, views))
    errors = rng.normal(size=(views, 6)) * np.repeat([1e-4, 2e-4], 3)
    actual = commands(times) @ SE3.exp(jnp.asarray(errors))
    data = simulate(calibration, actual, POINTS, pixel_noise=0.12, seed=seed).data
    return data, Trajectory.of(LOG_TIMES, commands(LOG_TIMES)), times - OFFSET


@pytest.fixture(scope="module")
def scene():
    return simulated(0)


@pytest.fixture(scope="module")
def found(scene):
    data, trajectory, times = scene
    return sv.estimate_time_offset(data, trajectory, times, "radial", max_offset=0.3)


def test_the_offset_is_found_within_its_uncertainty(found):
    assert abs(found.seconds - OFFSET) < 3.0 * found.std
    # The camera moves at 5 cm/s on average: 0.1 mm of robot noise are 2 ms in each of 15 views.
    assert 0.2e-3 < found.std < 1.0e-3
    assert str(found).startswith("robot's clock minus camera's: 3")


def test_the_poses_at_the_corrected_times_calibrate_better(scene, found):
    data, trajectory, times = scene
    rms = []
    for one in (at_time_offset(data, trajectory, times, 0.0), found.data):
        fit = sv.fit_staged(one, "radial", conventions="report")
        rms.append(reprojection_errors(fit.calibration, one).rms)
    # What is left is the robot's own 0.1 mm and 0.2 mrad.
    assert rms[1] < 0.7 * rms[0]


@pytest.fixture(scope="module")
def tracked():
    """A marker at half a metre, seen to 0.3 mm and 0.1 degrees by a camera on a moving arm."""
    rng, calibration = np.random.default_rng(0), paper_calibration()
    times = np.sort(rng.uniform(LOG_TIMES[0] + 1.0, LOG_TIMES[-1] - 1.0, 15))

    def commands(seconds):
        return circling_commands(seconds - LOG_TIMES[0], POINTS)

    errors = rng.normal(size=(15, 6)) * np.repeat([3e-4, 2e-3], 3)
    measured = SE3.exp(jnp.asarray(errors)) @ calibration.camera_from_world(commands(times))
    data = PoseDataset.from_poses(commands(times), measured)
    return data, Trajectory.of(LOG_TIMES, commands(LOG_TIMES)), times - OFFSET


def test_tracked_poses_tell_the_offset_too(tracked):
    found = sv.estimate_time_offset(*tracked, max_offset=0.3)
    assert abs(found.seconds - OFFSET) < 3.0 * found.std
    # At 5 cm/s 0.3 mm are 6 ms, and 15 pairs tell the offset four times as well.
    assert found.std < 3e-3
    assert isinstance(found.data, PoseDataset)


def test_a_camera_next_to_the_robot_gives_the_same_offset(tracked):
    """Of a robot that carries the target by the same motion: all its poses are inverted."""
    data, trajectory, times = tracked
    on_hand = sv.estimate_time_offset(*tracked, max_offset=0.3)
    poses = data.base_from_tool.inverse(), as_se3(data.tracked_matrices)
    next_to_arm = PoseDataset.from_poses(*poses, mount="eye_to_hand")
    inverse = Trajectory.of(trajectory.times, np.linalg.inv(trajectory.base_from_tool))
    other = sv.estimate_time_offset(next_to_arm, inverse, times, max_offset=0.3)
    assert other.seconds == pytest.approx(on_hand.seconds, abs=0.5 * on_hand.std)


@pytest.mark.parametrize("scatter", [0.0, 1.0, 4.0])
def test_views_that_contradict_each_other_widen_the_interval(scatter):
    """Four views: each tells an offset to 0.2 s, and all tell different ones."""
    own = scatter * np.array([1.0, -1.0, -1.0, 1.0])
    # Newey and West's weights of the two lags are 2/3 and 1/3.
    long_run = 4.0 + 2.0 * (2.0 / 3.0 * -1.0 + 1.0 / 3.0 * -2.0)
    expected = max(0.1, scatter * np.sqrt(long_run) / 4.0)
    found = standard_deviation(lambda offset: 0.5 * ((offset - own) / 0.2) ** 2, 0.0, 10.0)
    assert found == pytest.approx(expected)


def test_what_cannot_be_found_is_said(tracked):
    data, trajectory, times = tracked
    with pytest.raises(ValueError, match="picture_times: expected 15 times, one for each view"):
        sv.estimate_time_offset(data, trajectory, times[:-1])
    with pytest.raises(ValueError, match="not within the logged times"):
        sv.estimate_time_offset(data, trajectory, times + 50.0)
    with pytest.raises(ValueError, match=r"agree best at .* ms, the end of the range"):
        sv.estimate_time_offset(data, trajectory, times + 1.5, max_offset=0.5)
    # One pose throughout: every offset is as good as any other.
    still = np.broadcast_to(host_matrices(as_se3(trajectory.base_from_tool[:1])), (1000, 4, 4))
    no_offset = r"hardly moved|did not move|the end of the range|do not move alike"
    with pytest.raises(ValueError, match=no_offset):
        sv.estimate_time_offset(data, Trajectory.of(LOG_TIMES, still), times, "radial")


def test_the_jitter_of_time_stamps_is_printed_with_its_deviation(found):
    assert "jitter" not in str(found)
    text = str(found._replace(seconds=0.035, std=1e-4, jitter=2.1e-3, jitter_std=3e-4))
    assert text == (
        "robot's clock minus camera's: 35.00 +- 0.20 ms; jitter of the time stamps 2.1 ms "
        "(standard deviation, itself +- 0.3 ms)"
    )
