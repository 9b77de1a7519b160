"""A motion of a robot that is known at every time."""

import numpy as np
from scipy.spatial.transform import Rotation


def motion(times):
    """A smooth motion: 0.2 m and half a radian to and fro, about another axis at every time."""
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    vectors = 0.5 * np.stack([np.sin(times), np.cos(1.3 * times), 0.3 * times], axis=-1)
    poses[:, :3, :3] = Rotation.from_rotvec(vectors).as_matrix()
    poses[:, :3, 3] = 0.2 * np.stack([np.sin(1.1 * times), np.cos(times), times], axis=-1)
    return poses
