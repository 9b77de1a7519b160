"""The motion in a noisy log, against the motion itself."""

import numpy as np
from robot_motion import motion

from smartview_jax.geometry import host_exponentials
from smartview_jax.robots import Trajectory, smoothed_log
from smartview_jax.robots.log_smoothing import JUDGED

TIMES = np.arange(0.0, 4.0, 0.004)


def speeds(poses):
    """Speeds of the tool, m/s."""
    return np.gradient(poses[:, :3, 3], TIMES, axis=0)


def test_the_speed_of_the_noise_is_gone():
    noise = np.random.default_rng(0).normal(size=(len(TIMES), 6)) * np.repeat([3e-4, 5e-4], 3)
    logged = motion(TIMES) @ host_exponentials(noise)
    smoothed = smoothed_log(Trajectory.of(TIMES, logged)).base_from_tool
    errors = smoothed - motion(TIMES)
    # The path bends within a second: a tenth of it or more may be averaged, 25 poses.
    assert np.std(errors[:, :3, 3]) < 3e-4 / 3.0
    assert np.std(errors[:, :3, :3]) < 5e-4 / 3.0
    by_noise = np.std(speeds(logged) - speeds(motion(TIMES)))
    assert np.std(speeds(smoothed) - speeds(motion(TIMES))) < 0.05 * by_noise


def test_a_log_without_noise_stays():
    log = Trajectory.of(TIMES, motion(TIMES))
    np.testing.assert_allclose(smoothed_log(log).base_from_tool, motion(TIMES), atol=1e-8)
    few = Trajectory.of(TIMES[:20], motion(TIMES[:20]))
    assert smoothed_log(few) is few


def test_a_robot_that_rests_most_of_the_time_moves_as_fast():
    """The smoothness is chosen in the second of motion, not in the minute of rest."""
    times = np.arange(0.0, 30.0, 0.01)
    assert len(times) > JUDGED
    actual = motion(1.0 - np.cos(0.5 * np.pi * np.clip(times - 25.0, 0.0, 2.0)))
    poses = actual.copy()
    poses[:, :3, 3] += np.random.default_rng(0).normal(0.0, 1e-4, (len(times), 3))
    smoothed = smoothed_log(Trajectory.of(times, poses)).base_from_tool
    assert np.abs(smoothed - actual)[:, :3, 3].max() < 4e-4
