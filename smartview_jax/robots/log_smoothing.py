"""Take the noise out of the poses that a robot logged while it moved.

A spline through all poses of a log has the speed of their noise: 0.3 mm in each of 500 poses a
second are 0.3 m/s. A smoothing spline follows the motion instead. It is as smooth as predicts the
odd poses of the log best from the even ones, so that a log without noise stays as it is.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from .trajectory import Trajectory

MIN_SMOOTHED = 40
"""Smallest number of logged poses that tell motion from noise."""

JUDGED = 2000
"""Largest number of successive poses from which the smoothness is chosen."""

SMOOTHNESS = np.logspace(-3.0, 12.0, 31)
"""Weights of the squared second derivative, for times in units of the log's usual interval.

Weights of 1e-3 and 1e12 smooth over a fifth of an interval and over a thousand.
"""


def smoothed_log(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory through the same times, without the noise of the logged poses.

    The noise is taken to be independent between poses. The smoothness is the same over the log, and
    is chosen where the path bends most, so that no motion is taken for noise.

    Args:
        trajectory: the logged poses; one of fewer than `MIN_SMOOTHED` poses is returned as it is.
    """
    if len(trajectory.times) < MIN_SMOOTHED:
        return trajectory
    quaternions = Rotation.from_matrix(trajectory.base_from_tool[:, :3, :3]).as_quat()
    # A quaternion and its negative are the same rotation.
    cosines = np.sum(quaternions[1:] * quaternions[:-1], axis=1)
    quaternions[1:] *= np.cumprod(np.where(cosines < 0.0, -1.0, 1.0))[:, None]
    elapsed = trajectory.times - trajectory.times[0]
    intervals = elapsed / np.median(np.diff(trajectory.times))
    poses = trajectory.base_from_tool.copy()
    poses[:, :3, 3] = _smoothed(intervals, poses[:, :3, 3])
    poses[:, :3, :3] = Rotation.from_quat(_smoothed(intervals, quaternions)).as_matrix()
    return Trajectory.of(trajectory.times, poses)


def _smoothed(
    times: Float[np.ndarray, "logged"], values: Float[np.ndarray, "logged numbers"]
) -> Float[np.ndarray, "logged numbers"]:
    """Return numbers over time without their noise."""
    # Imported here, as in `Trajectory.of`.
    from scipy.interpolate import make_smoothing_spline

    part = _most_bent(values)
    kept, left_out = slice(part.start, part.stop, 2), slice(part.start + 1, part.stop - 1, 2)
    errors = [
        np.sum(
            (
                make_smoothing_spline(times[kept], values[kept], lam=weight)(times[left_out])
                - values[left_out]
            )
            ** 2
        )
        for weight in SMOOTHNESS
    ]
    best = int(np.argmin(errors))
    if best == 0:
        return values
    # All poses count twice as much as the half of them.
    return make_smoothing_spline(times, values, lam=2.0 * SMOOTHNESS[best])(times)


def _most_bent(values: Float[np.ndarray, "logged numbers"]) -> slice:
    """Return the `JUDGED` successive poses in which the path is least straight and uniform."""
    stride = JUDGED // 20
    if len(values) <= JUDGED:
        return slice(0, len(values))
    coarse = values[::stride]
    bend = np.sum((coarse[2:] - 2.0 * coarse[1:-1] + coarse[:-2]) ** 2, axis=1)
    in_window = np.convolve(bend, np.ones(JUDGED // stride - 2), mode="valid")
    start = stride * int(np.argmax(in_window))
    return slice(start, min(start + JUDGED, len(values)))
