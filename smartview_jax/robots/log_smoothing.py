"""Take the noise out of the poses that a robot logged while it moved.

A spline through all poses of a log has the speed of their noise: 0.3 mm in each of 500 poses a
second are 0.3 m/s. A smoothing spline follows the motion instead. It is as smooth as predicts the
odd poses of the log best from the even ones, so that a log without noise stays as it is.
"""

import numpy as np
from jaxtyping import Float
from scipy.linalg import solveh_banded
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
    part = _most_bent(values)
    kept, left_out = slice(part.start, part.stop, 2), slice(part.start + 1, part.stop - 1, 2)
    errors = []
    for weight in SMOOTHNESS:
        numbers, bends = smoothing_spline(times[kept], values[kept], weight)
        predicted = spline_between(times[kept], numbers, bends, times[left_out])
        errors.append(np.sum((predicted - values[left_out]) ** 2))
    best = int(np.argmin(errors))
    if best == 0:
        return values
    # All poses count twice as much as the half of them.
    return smoothing_spline(times, values, 2.0 * SMOOTHNESS[best])[0]


def smoothing_spline(
    times: Float[np.ndarray, "knots"], values: Float[np.ndarray, "knots numbers"], weight: float
) -> tuple[Float[np.ndarray, "knots numbers"], Float[np.ndarray, "knots numbers"]]:
    """Return the natural cubic spline that is near the values and bends little.

    It minimises the sum of squared distances from the values plus the weight times the integral of
    the squared second derivative. SciPy's smoothing spline is the same one, but SciPy sets up its
    equations in a loop over the knots, for each weight again.

    Args:
        times: increasing, at least three.
        values: numbers at these times.
        weight: of the squared second derivative, in the cube of the unit of time.

    Returns:
        The spline's values and its second derivatives at the times.

    References:
        Green and Silverman, Nonparametric Regression and Generalized Linear Models, 1994,
        section 2.3 (Reinsch's algorithm).
    """
    # With the second derivatives g at the inner knots, (R + weight Q^T Q) g = Q^T y and the spline
    # is y - weight Q g. Q^T takes the differences of slopes, R the integrals of g's hat functions.
    h = np.diff(times)
    before, after = 1.0 / h[:-1], 1.0 / h[1:]
    middle = -before - after
    bands = np.zeros((3, len(times) - 2))
    bands[2] = (h[:-1] + h[1:]) / 3.0 + weight * (before**2 + middle**2 + after**2)
    bands[1, 1:] = h[1:-1] / 6.0 + weight * (middle[:-1] * before[1:] + after[:-1] * middle[1:])
    bands[0, 2:] = weight * after[:-2] * before[2:]
    bends = np.zeros_like(values)
    slopes = np.diff(values, axis=0) / h[:, None]
    bends[1:-1] = solveh_banded(bands, np.diff(slopes, axis=0))
    # Nothing bends outside of the first knot and the last one.
    changes = np.pad(np.diff(bends, axis=0) / h[:, None], ((1, 1), (0, 0)))
    return values - weight * np.diff(changes, axis=0), bends


def spline_between(
    times: Float[np.ndarray, "knots"],
    values: Float[np.ndarray, "knots numbers"],
    bends: Float[np.ndarray, "knots numbers"],
    wanted: Float[np.ndarray, "intervals"],
) -> Float[np.ndarray, "intervals numbers"]:
    """Return a cubic spline at one time in each of its first intervals.

    Args:
        times: knots, at least one more than there are wanted times.
        values, bends: the spline and its second derivatives at the knots.
        wanted: times between the first knot and the second, the second and the third, and so on.
    """
    count = len(wanted)
    since = (wanted - times[:count])[:, None]
    until = (times[1 : count + 1] - wanted)[:, None]
    h = since + until
    straight = (since * values[1 : count + 1] + until * values[:count]) / h
    bent = (1.0 + since / h) * bends[1 : count + 1] + (1.0 + until / h) * bends[:count]
    return straight - since * until * bent / 6.0


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
