"""Poses that lag the pictures are named with the part of the move; other errors are no lag.

The lag is made by SciPy's Slerp and linear positions.
"""

import dataclasses

import numpy as np
import pytest
from robot_motions import VIEWS, moving_alike
from scipy.spatial.transform import Rotation, Slerp

from smartview_jax.data_checks import find_lag
from smartview_jax.geometry import as_se3, host_matrices
from smartview_jax.staged import fit_staged

EVERY_VIEW = np.ones(VIEWS, dtype=bool)


def lagging(poses, fraction):
    """The poses between the previous one and their own, or their own and the next one."""
    times = np.arange(len(poses), dtype=float)
    asked = np.clip(times - fraction, 0.0, times[-1])
    logged = np.tile(np.eye(4), (len(poses), 1, 1))
    logged[:, :3, :3] = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(asked).as_matrix()
    for axis in range(3):
        logged[:, axis, 3] = np.interp(asked, times, poses[:, axis, 3])
    return logged


def found_lag(fraction, seed=0, mount="eye_in_hand", used=EVERY_VIEW, **options):
    """The lag that is found in a robot's motions with a lag."""
    mount_from_holder, camera = moving_alike(seed, **options)
    robot = np.linalg.inv(mount_from_holder) if mount == "eye_in_hand" else mount_from_holder
    return find_lag(as_se3(lagging(robot, fraction)), as_se3(camera), used, mount)


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize("fraction", [0.04, -0.03])
def test_a_lag_is_found_with_its_size(mount, fraction):
    lag = found_lag(fraction, mount=mount)
    assert lag.fraction == pytest.approx(fraction, abs=5e-4)
    assert lag.score < 0.1 * lag.given_score


def test_the_words_say_which_way_how_far_and_what_it_explains():
    late, early = found_lag(0.04), found_lag(-0.03)
    assert late.sentence.startswith("the poses lag the pictures by about 4 % of each move")
    assert early.sentence.startswith("the poses lead the pictures by about 3 % of each move")
    assert "robot and camera agree to" in late.sentence
    assert "Read the pose when the arm has settled" in late.sentence


@pytest.mark.parametrize("noise", [(1e-5, 1e-3), (2e-4, 0.02), (5e-3, 1.0)])
def test_errors_in_single_views_are_no_lag(noise):
    for seed in range(4):
        assert found_lag(0.0, seed, noise=noise) is None


def test_a_pose_without_a_picture_is_on_the_way_too():
    some = EVERY_VIEW.copy()
    some[[3, 8]] = False
    assert found_lag(0.05, used=some).fraction == pytest.approx(0.05, abs=5e-4)
    few = np.arange(VIEWS) < 5
    assert found_lag(0.05, used=few) is None


def test_a_target_of_another_size_hides_no_lag():
    mount_from_holder, camera = moving_alike()
    robot = lagging(np.linalg.inv(mount_from_holder), 0.04)
    robot[:, :3, 3] /= 1.3
    lag = find_lag(as_se3(robot), as_se3(camera), EVERY_VIEW, "eye_in_hand", length_ratio=1.3)
    assert lag.fraction == pytest.approx(0.04, abs=5e-4)


def test_the_staged_fit_names_it(scene):
    poses = lagging(host_matrices(scene.data.base_from_tool), 0.05)
    data = dataclasses.replace(scene.data, base_from_tool=as_se3(poses))
    report = fit_staged(data, conventions="report").conventions
    assert "lag the pictures by about 5 % of each move" in report.change
    assert report.problems == (report.change,)
