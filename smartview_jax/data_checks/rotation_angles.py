"""Compare the rotation angles of robot and camera between pairs of views.

The angle of a motion is the same in every frame, so this needs no hand-eye transform.
"""

import numpy as np
from jaxtyping import Float, Int

from ..geometry import host_pairwise_rotation_angles
from .closure import Poses

MAX_COMPARED_VIEWS = 200
"""Largest number of views with which the rotation angles of every view are compared."""


def compared_views(used: np.ndarray) -> Int[np.ndarray, "compared"]:
    """Return the used views with which every view is compared: all, or a sample of many.

    The sample is drawn at random, always alike: mistakes such as a pose that is repeated every
    third time have a period, which views at equal distances could share.
    """
    indices = np.flatnonzero(used)
    if len(indices) <= MAX_COMPARED_VIEWS:
        return indices
    return np.sort(np.random.default_rng(0).permutation(indices)[:MAX_COMPARED_VIEWS])


def angle_differences(
    robot: Poses, camera: Poses, used: np.ndarray, compared: np.ndarray
) -> Float[np.ndarray, "views compared"]:
    """Return the differences of robot and camera rotation angles, rad; NaN for unused views.

    The angle is the same in every frame, so this needs no hand-eye transform.
    """
    inverse_robot, camera = np.linalg.inv(_replace_nonfinite(robot)), _replace_nonfinite(camera)
    robot_angles, camera_angles = (
        host_pairwise_rotation_angles(poses, poses[compared]) for poses in (inverse_robot, camera)
    )
    unused = ~used[:, None] | (np.arange(len(used))[:, None] == compared)
    return np.where(unused, np.nan, np.abs(robot_angles - camera_angles))


def median_rotation_angles(
    robot: Poses, camera: Poses, compared: np.ndarray
) -> tuple[float, float]:
    """Return the median rotation angle between two views, of robot and of camera, rad."""
    upper = np.triu_indices(len(compared), 1)
    angles = [host_pairwise_rotation_angles(p[compared], p[compared]) for p in (robot, camera)]
    robot_angle, camera_angle = (float(np.median(pairs[upper])) for pairs in angles)
    return robot_angle, camera_angle


def suspicious_views(angles: Float[np.ndarray, "views compared"]) -> tuple[tuple[int, str], ...]:
    """Return views whose rotation angles disagree with most others, which agree with each other."""
    used = np.isfinite(angles).any(axis=1)
    median_differences = np.zeros(len(angles))
    median_differences[used] = np.nanmedian(angles[used], axis=1)
    # Relative to the typical view, because an inaccurate robot makes all views differ.
    limit = max(6.0 * float(np.median(median_differences[used])), np.deg2rad(3.0))
    degrees = np.rad2deg(median_differences)
    return tuple(
        (
            int(view),
            f"its rotation differs from the robot's by {degrees[view]:.1f} degrees (median over "
            "the other views): is this picture paired with the right pose?",
        )
        for view in np.flatnonzero(median_differences > limit)
    )


def _replace_nonfinite(poses: Poses) -> Poses:
    """Return the poses with the identity in place of poses that are not finite."""
    return np.where(np.isfinite(poses).all(axis=(1, 2), keepdims=True), poses, np.eye(4))
