"""Which pictures become views: one of every stop, none of a motion, none in a gap."""

import numpy as np
import pytest

from smartview_jax import MomentChoice
from smartview_jax.recordings.moments import choose_moments, stops, thinned

SECOND = 1_000_000_000


def log(*parts):
    """Stamps and poses of a tool on a line: parts of seconds and metres per second, at 100 Hz."""
    times, places = [0.0], [0.0]
    for seconds, speed in parts:
        for _ in range(round(100 * seconds)):
            times.append(times[-1] + 0.01)
            places.append(places[-1] + 0.01 * speed)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3] = places
    return np.round(np.array(times) * SECOND).astype(np.int64), poses


def found(stamps, poses, choice):
    return [[begin / SECOND, end / SECOND] for begin, end in stops(stamps, poses, choice)]


def test_stops_are_where_the_robot_stands_for_long_enough():
    stamps, poses = log((1.0, 0.0), (0.5, 0.1), (0.3, 0.0), (0.5, 0.1), (2.0, 0.0))
    np.testing.assert_allclose(
        found(stamps, poses, MomentChoice()), [[0, 1], [2.3, 4.3]], atol=0.02
    )
    short = MomentChoice(still_for=0.25)
    np.testing.assert_allclose(
        found(stamps, poses, short), [[0, 1], [1.5, 1.8], [2.3, 4.3]], atol=0.02
    )


def test_a_gap_of_the_log_is_no_evidence_that_the_robot_stands():
    stamps, poses = log((4.0, 0.0))
    kept = (stamps < 1.0 * SECOND) | (stamps > 3.0 * SECOND)
    ends = found(stamps[kept], poses[kept], MomentChoice())
    np.testing.assert_allclose(ends, [[0, 1], [3, 4]], atol=0.02)


@pytest.mark.parametrize("noise", [2e-5, 1e-3])
def test_noise_of_the_readings_is_no_motion_within_the_limits(noise):
    stamps, poses = log((2.0, 0.0))
    poses[:, :3, 3] += np.random.default_rng(0).uniform(-noise, noise, (len(poses), 3))
    assert (len(found(stamps, poses, MomentChoice())) > 0) == (noise < 1e-4)
    assert found(stamps, poses, MomentChoice(position=4 * noise)) == [[0.0, 2.0]]


def test_one_picture_of_every_stop_far_from_motion():
    stamps, poses = log((1.0, 0.0), (0.5, 0.1), (2.0, 0.0), (0.5, 0.1), (0.6, 0.0))
    moments = np.array([0.1, 0.4, 0.7, 1.25, 2.0, 2.6, 3.2, 4.5, 9.0]) * SECOND
    known = moments <= stamps[-1]
    chosen = choose_moments(moments.astype(np.int64), known, stamps, poses, MomentChoice())
    assert chosen.indices.tolist() == [1, 5]
    assert chosen.left_out == {
        "before or after the robot's poses": 1,
        "within 0.25 s of a motion of the robot": 3,
        "of a stop that is a view already": 3,
    }
    assert chosen.notes == ("1 stops of the robot have no picture further than 0.25 s from motion",)


def test_in_motion_a_gap_of_the_log_is_left_out():
    stamps, poses = log((4.0, 0.1))
    poses[:, 1, 3] = 0.05 * np.sin(8.0 * stamps / SECOND)
    kept = (stamps < 1.0 * SECOND) | (stamps > 3.0 * SECOND)
    moments = (np.array([0.2, 0.5, 0.8, 2.0, 3.5]) * SECOND).astype(np.int64)
    known = np.ones(5, dtype=bool)
    choice = MomentChoice(every=1)
    chosen = choose_moments(moments, known, stamps[kept], poses[kept], choice)
    assert chosen.indices.tolist() == [0, 1, 2, 4]
    assert list(chosen.left_out.values()) == [1]


def test_a_long_log_is_thinned_to_steps():
    stamps = np.arange(0, 1000, 3)
    kept = thinned(stamps, 100.0)
    assert kept[0] == 0
    assert kept[-1] == stamps[-1]
    assert len(kept) == 11
    np.testing.assert_array_equal(thinned(stamps, 0.5), stamps)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"every": 0}, "every: expected 1"),
        ({"still_for": 0.0}, "still_for"),
        ({"angle": -1.0}, "angle: expected more than 0"),
    ],
)
def test_rules_that_choose_nothing_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        MomentChoice(**given)
