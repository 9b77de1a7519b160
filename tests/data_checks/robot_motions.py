"""Poses of a robot and of its camera, by SciPy's rotations and plain products of matrices."""

import numpy as np
from scipy.spatial.transform import Rotation

VIEWS = 14
UNCHANGED = np.eye(4)


def transform(turn, shift):
    """A homogeneous matrix from a rotation vector, degrees, and a position, m."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(turn, degrees=True).as_matrix()
    matrix[:3, 3] = shift
    return matrix


CAMERA_FROM_MOUNT = transform([10.0, -20.0, 95.0], [0.02, 0.05, -0.1])
HOLDER_FROM_WORLD = transform([180.0, 0.0, 30.0], [0.4, 0.1, 0.6])


def moving_alike(
    seed=0, knock=UNCHANGED, push=UNCHANGED, noise=(2e-4, 0.02), views=VIEWS, errs_at="mount"
):
    """The robot's `mount_from_holder` and `camera_from_world`, `(views, 4, 4)` each.

    Args:
        seed: of NumPy's generator.
        knock: motion of the camera on its mount in each view.
        push: motion of the target on its holder in each view.
        noise: errors of the robot, m and degrees.
        views: number of views.
        errs_at: where the robot's errors are independent, "mount" or "holder": its hand, which
            holds the camera or the target.
    """
    rng = np.random.default_rng(seed)
    robot, error = np.empty((2, views, 4, 4))
    for view in range(views):
        robot[view] = transform(rng.normal(0.0, 20.0, 3), rng.normal(0.0, 0.1, 3))
        error[view] = transform(rng.normal(0.0, noise[1], 3), rng.normal(0.0, noise[0], 3))
    moved = error @ robot if errs_at == "mount" else robot @ error
    return robot, CAMERA_FROM_MOUNT @ knock @ moved @ push @ HOLDER_FROM_WORLD


def mirrored(camera, axis=0):
    """The camera's poses, `(..., 4, 4)`, with pictures mirrored left to right (0) or upside down.

    A mirrored view of a flat target is a view of it from behind.
    """
    mirror, behind = np.ones(4), np.array([1.0, 1.0, -1.0, 1.0])
    mirror[axis] = -1.0
    return np.diag(mirror) @ camera @ np.diag(behind)
