"""Joints that count otherwise than the arm's description says are named; good ones never.

The true poses are made by SciPy's rotations and plain products of matrices.
"""

import numpy as np
import pytest
from described_arm import ALPHA, A, D, camera_poses, described, readings

from smartview_jax.data_checks import joint_problem
from smartview_jax.geometry import as_se3
from smartview_jax.robots import SerialArm

VIEWS = 12
EVERY_VIEW = np.ones(VIEWS, dtype=bool)
ARM = described()


def seen(joints, noise=1e-4):
    """What a camera on the hand sees of the arm with these joints."""
    return as_se3(camera_poses(joints, "eye_in_hand", noise))


def reversed_third(joints):
    joints[:, 2] *= -1.0
    return joints


def other_zero(joints):
    joints[:, 1] += np.pi / 2.0
    return joints


def fifth_in_degrees(joints):
    joints[:, 4] = np.rad2deg(joints[:, 4])
    return joints


def third_from_the_horizontal(joints):
    """As Fanuc's third joint, whose reading does not change when the second turns."""
    joints[:, 2] -= joints[:, 1]
    return joints


def sorted_by_name(joints):
    """Elbow, shoulder lift, shoulder pan: the order of ROS."""
    return joints[:, [2, 1, 0, 3, 4, 5]]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (reversed_third, "but do if joint 3 counts the other way round"),
        (other_zero, "but do if the zero of joint 2 is +90 degrees off"),
        (sorted_by_name, "but do if joints 1 and 3 stand in each other's column"),
        (fifth_in_degrees, "the readings of joint 5 are degrees where the others are radians"),
        (third_from_the_horizontal, "joint 3 turns by its own reading plus the one of joint 2"),
        (np.rad2deg, "but do if the readings are degrees, not radians"),
        (np.deg2rad, "but do if the readings are radians, not degrees"),
    ],
)
def test_readings_that_are_not_the_arms_are_named(wrong, words):
    camera = seen(readings(VIEWS))
    text = joint_problem(wrong(readings(VIEWS)), ARM, camera, "eye_in_hand", EVERY_VIEW)
    assert words in text
    assert "; or" not in text


def test_parameters_of_the_other_convention_are_named():
    arm = SerialArm(np.zeros(6), D, A, np.deg2rad(ALPHA), convention="modified")
    text = joint_problem(readings(VIEWS), arm, seen(readings(VIEWS)), "eye_in_hand", EVERY_VIEW)
    assert "state convention: standard" in text


def test_nothing_is_named_of_good_joints_or_of_poses_of_something_else():
    joints = readings(VIEWS)
    assert joint_problem(joints, ARM, seen(joints), "eye_in_hand", EVERY_VIEW) == ""
    others = np.random.default_rng(3).uniform(-2.0, 2.0, (VIEWS, 6))
    assert joint_problem(joints, ARM, seen(others), "eye_in_hand", EVERY_VIEW) == ""
