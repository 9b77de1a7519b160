"""The clock of a tracker, from simulated streams: errors against what is stated."""

import functools

import numpy as np
import pytest
from scipy.special import chdtri
from tracked_scene import MOUNT, WORLD, turned

from smartview_jax.clocks.timed_poses import (
    TimedChain,
    TimedPairs,
    fit_timed_poses,
    long_run_variance,
)
from smartview_jax.dataset import PoseDataset
from smartview_jax.geometry import host_exponentials
from smartview_jax.robots import Trajectory, smoothed_log

OFFSET, DRAWS, PAIRS = 0.035, 20, 60
LOG_NOISE, TRACKER = (3e-4, 5e-4), (5e-4, 1e-3)
LOG_TIMES = np.arange(0.0, 12.0, 0.004)


def seen(times):
    """Poses of a marker before a camera that moves by a decimetre a second."""
    turns = 0.4 * np.sin(times[:, None] * [0.7, 1.0, 0.5] + [0.0, 1.0, 2.0])
    poses = turned(turns)
    ways = np.sin(times[:, None] * [0.9, 0.6, 0.8] + [3.0, 4.0, 5.0])
    poses[:, :3, 3] = [0.0, 0.0, 0.5] + 0.1 * ways
    return poses


def robot(times, mount):
    mount_from_holder = np.linalg.inv(MOUNT) @ seen(times) @ np.linalg.inv(WORLD)
    return mount_from_holder if mount == "eye_to_hand" else np.linalg.inv(mount_from_holder)


@functools.cache
def log_of(mount):
    """A log of 250 poses a second, whose noise has half a metre a second."""
    noise = np.random.default_rng(0).normal(size=(len(LOG_TIMES), 6)) * np.repeat(LOG_NOISE, 3)
    return smoothed_log(
        Trajectory.of(LOG_TIMES, robot(LOG_TIMES, mount) @ host_exponentials(noise))
    )


def fitted(log, seed, mount="eye_in_hand", jitter=0.0, wrong=0):
    """The fit to tracked poses that are drawn at random."""
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(0.5, 11.5, PAIRS))
    errors = rng.normal(size=(PAIRS, 6)) * np.repeat(TRACKER, 3)
    measured = seen(times)
    measured[:, :3, :3] = turned(errors[:, 3:])[:, :3, :3] @ measured[:, :3, :3]
    measured[:, :3, 3] += errors[:, :3]
    measured[:wrong] = measured[:wrong] @ host_exponentials(rng.normal(0.0, 0.1, (wrong, 6)))
    stamps = times - OFFSET + rng.normal(0.0, jitter, PAIRS)
    data = PoseDataset.from_poses(robot(times, mount), measured, mount)
    start = TimedChain(MOUNT, WORLD, OFFSET + 0.005)
    pairs = TimedPairs(data, log, stamps)
    return fit_timed_poses(pairs, start, np.arange(PAIRS) >= wrong, (-0.2, 0.2))


def assert_honest(fits):
    squares = [((fit.chain.seconds - OFFSET) / fit.std) ** 2 for fit in fits]
    low, high = chdtri(len(fits), [0.999, 0.001]) / len(fits)
    assert low < np.mean(squares) < high


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
def test_the_offset_is_as_uncertain_as_stated(mount):
    log = log_of(mount)
    fits = [fitted(log, seed, mount) for seed in range(DRAWS)]
    assert_honest(fits)
    # One pair tells it to 1 mm over 0.1 m/s or so, 60 pairs eight times as well.
    assert 0.2e-3 < np.median([fit.std for fit in fits]) < 1.5e-3
    assert all(fit.jitter < 3e-3 for fit in fits)
    assert all(0.1e-3 < fit.jitter_std < 3e-3 for fit in fits)


def test_jitter_of_time_stamps_is_found_and_widens_the_interval():
    log = log_of("eye_in_hand")
    fits = [fitted(log, seed, jitter=0.01) for seed in range(DRAWS)]
    assert_honest(fits)
    assert np.median([fit.jitter for fit in fits]) == pytest.approx(0.01, rel=0.1)
    # Of n normal numbers the standard deviation is known to one part in sqrt(2 n).
    stated = np.median([fit.jitter_std for fit in fits])
    assert stated == pytest.approx(0.01 / np.sqrt(2.0 * PAIRS), rel=0.25)
    # Without any other noise the offset would be known as well as a mean of 60 stamps.
    assert min(fit.std for fit in fits) > 0.8 * 0.01 / np.sqrt(PAIRS)


def test_wrong_pairs_are_left_out_and_right_ones_taken_back():
    log = log_of("eye_in_hand")
    fit = fitted(log, 0, wrong=10)
    assert not fit.used[:10].any()
    assert fit.used[10:].sum() >= PAIRS - 11
    assert abs(fit.chain.seconds - OFFSET) < 3.0 * fit.std


def test_errors_that_are_alike_in_neighbours_widen_the_interval():
    """The variance of sums of an autoregressive series, against sums of many such series."""
    rng, persistence = np.random.default_rng(0), 0.6
    series = np.zeros((400, 300))
    for k in range(1, 400):
        series[k] = persistence * series[k - 1] + rng.normal(size=300)
    series = series[100:]
    stated = np.mean([long_run_variance(one) for one in series.T])
    true = np.var(series.sum(axis=0))
    independent = np.sum(np.var(series, axis=1))
    assert 0.65 * true < stated < 1.05 * true
    assert independent < 0.35 * true
    noise = rng.normal(size=(60, 500))
    assert np.mean([long_run_variance(one) for one in noise.T]) == pytest.approx(60, rel=0.1)
