"""Pairs of a robot pose and a tracked pose, simulated with noise of both."""

import numpy as np
from host_poses import transform_errors

from benchmarks.transform_errors import stated_covariance
from smartview_jax.dataset import PoseDataset
from smartview_jax.geometry import host_exponentials

VIEWS = 16
MOUNT = host_exponentials(np.array([0.03, -0.06, 0.08, 0.5, -0.3, 1.0]))
WORLD = host_exponentials(np.array([0.5, 0.1, 0.05, 0.2, 0.1, 2.0]))
TRACKER, ROBOT = (5e-4, 2e-3), (1e-4, 2e-4)
"""Standard deviations by axis, m and rad."""


def turned(vectors):
    """Transforms that only rotate."""
    return host_exponentials(np.concatenate([np.zeros_like(vectors), vectors], axis=1))


def tracked(seed, views=VIEWS, mount="eye_in_hand", scale=1.0, turns=None):
    """Robot poses and tracked poses of a marker at half a metre.

    Args:
        seed: of motion and noise.
        views: number of pairs.
        mount: of the camera.
        scale: metres per unit of the tracker.
        turns: rotation vectors of the camera; by default random.
    """
    rng = np.random.default_rng(seed)
    seen = turned(rng.uniform(-0.6, 0.6, (views, 3)) if turns is None else turns)
    seen[:, :3, 3] = np.column_stack(
        [rng.uniform(-0.1, 0.1, (views, 2)), rng.uniform(0.4, 0.7, views)]
    )
    mount_from_holder = np.linalg.inv(MOUNT) @ seen @ np.linalg.inv(WORLD)
    robot = mount_from_holder if mount == "eye_to_hand" else np.linalg.inv(mount_from_holder)
    robot = robot @ host_exponentials(rng.normal(size=(views, 6)) * np.repeat(ROBOT, 3))
    measured = turned(rng.normal(0.0, TRACKER[1], (views, 3)))
    measured[:, :3, :3] = measured[:, :3, :3] @ seen[:, :3, :3]
    measured[:, :3, 3] = (seen[:, :3, 3] + rng.normal(0.0, TRACKER[0], (views, 3))) / scale
    return robot, measured


def data_of(seed, **given):
    """The same as a data set."""
    return PoseDataset.from_poses(*tracked(seed, **given), given.get("mount", "eye_in_hand"))


def mount_error(fit):
    """Errors of the mount: translation, m, and a rotation vector in the camera's axes, rad."""
    return transform_errors(fit.calibration.camera_from_mount, MOUNT)


def mount_covariance(fit):
    """The covariance that a fit states for them."""
    return stated_covariance(fit, fit.calibration.transform_names[0])
