"""Poses between those that a robot logged, against the motion itself."""

import numpy as np
import pytest
from robot_motion import motion

from smartview_jax.robots import Trajectory

TIMES = np.arange(0.0, 4.0, 0.05)


def test_between_logged_poses_the_motion_goes_on_smoothly():
    times = np.random.default_rng(0).uniform(0.2, 3.7, 50)
    actual = Trajectory.of(TIMES, motion(TIMES)).at(times)
    # Twenty poses a second: the next derivative, times dt^4 / 384, is below a thousandth of a mm.
    np.testing.assert_allclose(actual, motion(times), atol=1e-6)
    np.testing.assert_allclose(Trajectory.of(TIMES, motion(TIMES)).at(TIMES), motion(TIMES))


def test_what_is_wrong_is_named():
    poses = motion(TIMES)
    with pytest.raises(ValueError, match="expected at least 4 poses, a time for each; found 3"):
        Trajectory.of(TIMES[:3], poses[:3])
    with pytest.raises(ValueError, match="found 5 times and 6 poses"):
        Trajectory.of(TIMES[:5], poses[:6])
    for wrong in (TIMES[4], np.nan):
        times = TIMES.copy()
        times[5] = wrong
        with pytest.raises(ValueError, match=r"time 5 is .* s, not after 0\.2 s"):
            Trajectory.of(times, poses)
    with pytest.raises(ValueError, match=r"5 s is not within the logged times, 0 to 3\.95 s"):
        Trajectory.of(TIMES, poses).at(np.array([1.0, 5.0]))
