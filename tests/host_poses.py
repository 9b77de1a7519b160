"""Poses on the host, where no program has to be compiled for every operation."""

import cv2
import numpy as np
from jaxlie import SE3

from benchmarks.transform_errors import transform_errors as errors_of_matrices
from smartview_jax.geometry import as_se3, host_logarithms, host_matrices, host_transforms


def motion_between(first, second) -> np.ndarray:
    """Tangents `(*views, 6)` that lead from the first poses to the second, translation first."""
    first, second = (host_matrices(as_se3(poses)) for poses in (first, second))
    return host_logarithms(np.linalg.inv(first) @ second)


def transform_errors(found, truth) -> np.ndarray:
    """Differences of translations, and of rotations after them as vectors, `(*views, 6)`."""
    found, truth = (host_matrices(as_se3(poses)) for poses in (found, truth))
    return errors_of_matrices(found, truth)


def opencv_poses(data, K: np.ndarray, distortion=None) -> SE3:
    """The camera's pose in every view of a data set, as OpenCV finds it from the visible points."""
    poses = np.tile(np.eye(4), (len(data.points), 1, 1))
    for pose, points, pixels, visible in zip(
        poses, *map(np.asarray, (data.points, data.pixels, data.visible)), strict=True
    ):
        _, turn, shift = cv2.solvePnP(points[visible], pixels[visible], K, distortion)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    return host_transforms(poses)
