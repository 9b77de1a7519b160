"""Poses that lag the pictures are named with the part of the move; other errors are no lag.

The lag is made by SciPy's Slerp and linear positions.
"""

import dataclasses

import numpy as np
import pytest
from robot_motions import (
    CAMERA_FROM_MOUNT,
    HOLDER_FROM_WORLD,
    VIEWS,
    moving_alike,
    transform,
)
from scipy.spatial.transform import Rotation, Slerp

from smartview_jax.data_checks import RobotAndCamera, find_lag, find_shared_fault
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
    assert late.sentence().startswith(
        "the poses lag the pictures by about 4 +- 0.008 % of each move"
    )
    assert early.sentence().startswith(
        "the poses lead the pictures by about 3 +- 0.008 % of each move"
    )
    assert "robot and camera agree to" in late.sentence()
    assert "Read the pose when the arm has settled" in late.sentence()


@pytest.mark.parametrize("noise", [(1e-5, 1e-3), (2e-4, 0.02), (5e-3, 1.0)])
def test_errors_in_single_views_are_no_lag(noise):
    for seed in range(4):
        assert found_lag(0.0, seed, noise=noise) is None


def turning_about_one_point(seed, fraction, at_target):
    """Poses of a robot that only turns, and the camera's, with noise at the target or the tool."""
    rng = np.random.default_rng(seed)
    poses = np.array([transform(turn, [0.4, 0.1, 0.3]) for turn in rng.normal(0.0, 20.0, (14, 3))])
    error = np.array([transform(turn, np.zeros(3)) for turn in rng.normal(0.0, 0.1, (14, 3))])
    measured = CAMERA_FROM_MOUNT @ np.linalg.inv(poses) @ HOLDER_FROM_WORLD
    if at_target:
        measured = measured @ error
        measured[:, :3, 3] += rng.normal(0.0, 2e-4, (14, 3))
        error = np.eye(4)
    return lagging(poses, fraction) @ error, measured


@pytest.mark.parametrize("at_target", [True, False])
def test_a_robot_that_only_turns_shows_its_lag(at_target):
    for seed in range(6):
        for fraction in (0.05, 0.0):
            robot, camera = turning_about_one_point(seed, fraction, at_target)
            lag = find_lag(as_se3(robot), as_se3(camera), EVERY_VIEW, "eye_in_hand")
            if fraction == 0.0:
                assert lag is None
            else:
                assert abs(lag.fraction - fraction) < 4.0 * lag.std
                assert lag.std < 0.1 * fraction


def test_the_stated_deviation_of_a_lag_is_true():
    scores = []
    for seed in range(20):
        lag = found_lag(0.05, seed, noise=(5e-4, 0.1))
        scores.append((lag.fraction - 0.05) / lag.std)
    # The mean square of 20 normal numbers is between 0.4 and 2 in 99 of 100 cases.
    assert 0.4 < np.mean(np.square(scores)) < 2.0


def test_the_noise_counts_where_it_is_made():
    """Rotations are noisy and positions are not: of the tool by the robot, or of the target."""
    # Moves are 0.2 m long, and 14 views give 39 positions after the first.
    expected = 1e-5 / 0.2 / np.sqrt(39.0)
    assert found_lag(0.05, noise=(1e-5, 0.5)).std < 3.0 * expected
    mount_from_holder, camera = moving_alike(noise=(0.0, 0.0))
    rng = np.random.default_rng(0)
    noisy = np.array(
        [transform(turn, rng.normal(0, 1e-5, 3)) for turn in rng.normal(0, 0.5, (14, 3))]
    )
    robot = as_se3(lagging(np.linalg.inv(mount_from_holder), 0.05))
    lag = find_lag(robot, as_se3(camera @ noisy), EVERY_VIEW, "eye_in_hand")
    assert lag.std < 3.0 * expected


def test_an_error_that_is_linear_in_the_pose_is_no_lag():
    """Such an error resembles a lag: half of the variance of a move is the one of its end."""
    for seed in range(8):
        mount_from_holder, camera = moving_alike(seed)
        robot = np.linalg.inv(mount_from_holder)
        robot[:, :3, 3] *= 0.9
        turns = Rotation.from_matrix(robot[:, :3, :3]).as_rotvec()
        robot[:, :3, :3] = Rotation.from_rotvec(0.9 * turns).as_matrix()
        assert find_lag(as_se3(robot), as_se3(camera), EVERY_VIEW, "eye_in_hand") is None


def test_a_lag_is_named_although_some_views_are_wrong():
    mount_from_holder, camera = moving_alike()
    robot = lagging(np.linalg.inv(mount_from_holder), 0.04)
    wrong = [4, 9]
    camera[wrong] = camera[wrong[::-1]]
    agreeing = EVERY_VIEW.copy()
    agreeing[wrong] = False
    poses = RobotAndCamera(as_se3(robot), as_se3(camera), "eye_in_hand", [""] * VIEWS, tracked=True)
    assert find_shared_fault(poses, EVERY_VIEW) is None
    assert find_shared_fault(poses, EVERY_VIEW, agreeing).sentence.startswith(
        "the robot's poses lag the tracked poses by about 4 "
    )


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


def test_the_staged_fit_names_a_lag(scene):
    poses = lagging(host_matrices(scene.data.base_from_tool), 0.05)
    data = dataclasses.replace(scene.data, base_from_tool=as_se3(poses))
    report = fit_staged(data, conventions="report").conventions
    assert "lag the pictures by about 5 +- 0.0" in report.change
    assert report.problems == (report.change,)
