"""Joints that count otherwise than the arm's description says are named; good ones never.

The true poses are made by SciPy's rotations and plain products of matrices.
"""

import numpy as np
import pytest
from robot_motions import CAMERA_FROM_MOUNT, HOLDER_FROM_WORLD, transform

from smartview_jax.data_checks import joint_problem
from smartview_jax.geometry import as_se3
from smartview_jax.robots import SerialArm

VIEWS = 12
EVERY_VIEW = np.ones(VIEWS, dtype=bool)
D = np.array([0.16, 0.0, 0.0, 0.13, 0.10, 0.10])
A = np.array([0.0, -0.42, -0.39, 0.0, 0.0, 0.0])
ALPHA = np.array([90.0, 0.0, 0.0, 90.0, -90.0, 0.0])
ARM = SerialArm(np.zeros(6), D, A, np.deg2rad(ALPHA))


def readings():
    middle = np.deg2rad([10.0, -80.0, 100.0, -110.0, -85.0, 20.0])
    return middle + np.random.default_rng(0).normal(0.0, 0.3, (VIEWS, 6))


def seen(joints, noise=1e-4):
    """What the camera sees of an arm with these joints."""
    rng = np.random.default_rng(1)
    poses = []
    for row in joints:
        pose = np.eye(4)
        for angle, d, a, alpha in zip(row, D, A, ALPHA, strict=True):
            pose = pose @ transform([0, 0, np.rad2deg(angle)], [0, 0, d])
            pose = pose @ transform([0, 0, 0], [a, 0, 0]) @ transform([alpha, 0, 0], [0, 0, 0])
        pose = pose @ transform(rng.normal(0, 0.01, 3), rng.normal(0, noise, 3))
        poses.append(CAMERA_FROM_MOUNT @ np.linalg.inv(pose) @ HOLDER_FROM_WORLD)
    return as_se3(np.stack(poses))


def reversed_third(joints):
    joints[:, 2] *= -1.0
    return joints


def other_zero(joints):
    joints[:, 1] += np.pi / 2.0
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
        (np.rad2deg, "but do if the readings are degrees, not radians"),
        (np.deg2rad, "but do if the readings are radians, not degrees"),
    ],
)
def test_readings_that_are_not_the_arms_are_named(wrong, words):
    camera = seen(readings())
    text = joint_problem(wrong(readings()), ARM, camera, "eye_in_hand", EVERY_VIEW)
    assert words in text
    assert "; or" not in text


def test_parameters_of_the_other_convention_are_named():
    arm = SerialArm(np.zeros(6), D, A, np.deg2rad(ALPHA), convention="modified")
    text = joint_problem(readings(), arm, seen(readings()), "eye_in_hand", EVERY_VIEW)
    assert "state convention: standard" in text


def test_nothing_is_named_of_good_joints_or_of_poses_of_something_else():
    joints = readings()
    assert joint_problem(joints, ARM, seen(joints), "eye_in_hand", EVERY_VIEW) == ""
    others = np.random.default_rng(3).uniform(-2.0, 2.0, (VIEWS, 6))
    assert joint_problem(joints, ARM, seen(others), "eye_in_hand", EVERY_VIEW) == ""
