"""An arm of six joints by the lengths of its links, and what its camera sees.

Its forward kinematics are SciPy's rotations and plain products of matrices.
"""

import numpy as np
from robot_motions import CAMERA_FROM_MOUNT, HOLDER_FROM_WORLD, transform

from smartview_jax.robots import SerialArm

D = np.array([0.16, 0.0, 0.0, 0.13, 0.10, 0.10])
A = np.array([0.0, -0.42, -0.39, 0.0, 0.0, 0.0])
ALPHA = np.array([90.0, 0.0, 0.0, 90.0, -90.0, 0.0])


def described(d=D, a=A):
    return SerialArm(np.zeros(6), d, a, np.deg2rad(ALPHA))


def readings(views):
    middle = np.deg2rad([10.0, -80.0, 100.0, -110.0, -85.0, 20.0])
    return middle + np.random.default_rng(0).normal(0.0, 0.3, (views, 6))


def camera_poses(joints, mount, noise=1e-4):
    """`camera_from_world` where the arm has these joints, whose poses have a noise in m."""
    rng = np.random.default_rng(1)
    poses = []
    for row in joints:
        tool = np.eye(4)
        for angle, d, a, alpha in zip(row, D, A, ALPHA, strict=True):
            tool = tool @ transform([0, 0, np.rad2deg(angle)], [0, 0, d])
            tool = tool @ transform([0, 0, 0], [a, 0, 0]) @ transform([alpha, 0, 0], [0, 0, 0])
        tool = tool @ transform(rng.normal(0, 0.01, 3), rng.normal(0, noise, 3))
        mount_from_holder = np.linalg.inv(tool) if mount == "eye_in_hand" else tool
        poses.append(CAMERA_FROM_MOUNT @ mount_from_holder @ HOLDER_FROM_WORLD)
    return np.stack(poses)
