"""Interpolate the poses that a robot logged while it moved, except in gaps of the log.

The error of an interpolation over some duration is measured in the log itself: windows of this
duration are chosen where the log is complete, interpolated from their ends as in the gap, and
compared with the poses that were logged within.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation, RotationSpline

from ..geometry import PoseLike, as_se3, host_matrices, host_poses

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

MIN_LOGGED_POSES = 4
"""Smallest number of poses that determines a cubic spline."""


class Trajectory(NamedTuple):
    """Poses of the tool over time, interpolated by splines with continuous acceleration.

    Attributes:
        times: times of the poses by the robot's clock, s, increasing.
        base_from_tool: poses.
        rotations, positions: the splines over time.
    """

    times: Float[np.ndarray, "logged"]
    base_from_tool: Float[np.ndarray, "logged 4 4"]
    rotations: RotationSpline
    positions: "CubicSpline"

    @classmethod
    def of(cls, times: Float[np.ndarray, "logged"], base_from_tool: PoseLike) -> "Trajectory":
        """Return a trajectory; a ValueError for too few poses, or times that do not increase."""
        seconds, poses = np.asarray(times, dtype=float), host_matrices(as_se3(base_from_tool))
        if seconds.shape != (len(poses),) or len(poses) < MIN_LOGGED_POSES:
            raise ValueError(
                f"trajectory: expected at least {MIN_LOGGED_POSES} poses, a time for each; found "
                f"{seconds.size} times and {len(poses)} poses"
            )
        # NaN is no increase either.
        if not (np.diff(seconds) > 0.0).all():
            k = int(np.argmin(np.diff(seconds) > 0.0))
            raise ValueError(
                f"trajectory: time {k + 1} is {seconds[k + 1]:.9g} s, not after {seconds[k]:.9g} s"
            )
        # Made once: a search asks for the poses at many times.
        # Imported here: it takes a tenth of a second, and most data have no trajectory.
        from scipy.interpolate import CubicSpline

        rotations = RotationSpline(seconds, Rotation.from_matrix(poses[:, :3, :3]))
        return cls(seconds, poses, rotations, CubicSpline(seconds, poses[:, :3, 3]))

    def outside(self, times: Float[np.ndarray, "views"]) -> Bool[np.ndarray, "views"]:
        """Return which times are before the first or after the last logged one, or NaN."""
        return ~((self.times[0] <= times) & (times <= self.times[-1]))

    def at(self, times: Float[np.ndarray, "views"]) -> Float[np.ndarray, "views 4 4"]:
        """Return the poses at some times; a ValueError for a time outside the log."""
        outside = self.outside(times)
        if outside.any():
            time = times[int(np.argmax(outside))]
            raise ValueError(
                f"trajectory: {time:.9g} s is not within the logged times, {self.times[0]:.9g} to "
                f"{self.times[-1]:.9g} s"
            )
        return host_poses(self.rotations(times).as_matrix(), self.positions(times))


ALLOWED_ERROR = np.array([1e-4, 2e-4])
"""Error of position, m, and angle, rad, that is always acceptable: robots repeat a pose to about
this accuracy."""

MAX_WINDOWS = 200
"""Largest number of windows in which the error is measured."""


def times_in_gaps(
    trajectory: Trajectory, times: Float[np.ndarray, "views"]
) -> Bool[np.ndarray, "views"]:
    """Return which times are in a gap of the log, where the interpolated pose is not reliable.

    A time is in a gap if its interval is longer than usual in this log, the robot moved across it,
    and interpolation over this duration has an error above the limits and above its error at the
    usual interval.

    Args:
        times: times within the log, s.
    """
    logged = trajectory.times
    usual = 2.0 * float(np.median(np.diff(logged)))
    # The error at twice the median interval, where the poses in the middle are logged, is larger
    # than the error at the median interval.
    accepted = np.fmax(ALLOWED_ERROR, _interpolation_error(trajectory, usual, 0.5, usual))
    in_gap = np.zeros(len(times), dtype=bool)
    for k, time in enumerate(times):
        after = int(np.clip(np.searchsorted(logged, time), 1, len(logged) - 1))
        start, duration = logged[after - 1], logged[after] - logged[after - 1]
        if duration <= usual or time in (start, logged[after]):
            continue
        ends = _motion(trajectory, np.array([after - 1]), np.array([after]))[0]
        if (_sizes(ends) <= ALLOWED_ERROR).all():
            continue
        error = _interpolation_error(trajectory, duration, (time - start) / duration, usual)
        # Without a window of this duration the interpolation has no support.
        in_gap[k] = np.isnan(error).any() or (error > accepted).any()
    return in_gap


def _interpolation_error(
    trajectory: Trajectory, duration: float, fraction: float, usual: float
) -> Float[np.ndarray, "2"]:
    """Return the RMS error of position (m) and angle (rad) of interpolation over a duration (s).

    The pose is interpolated at a fraction of the window. The result is NaN if no window without
    gaps, intervals longer than the usual one (s), has motion.
    """
    logged = trajectory.times
    first = np.arange(1, len(logged) - 1)
    last = np.searchsorted(logged, logged[first] + duration)
    inside = last < len(logged) - 1
    first, last = first[inside], last[inside]
    long_before = np.concatenate([[0], np.cumsum(np.diff(logged) > usual)])
    complete = (long_before[last + 1] == long_before[first - 1]) & (last >= first + 2)
    first, last = first[complete], last[complete]
    if not first.size:
        return np.full(2, np.nan)
    # Evenly over the log, so that every run uses the same windows.
    chosen = np.unique(np.linspace(0, len(first) - 1, MAX_WINDOWS).astype(int))
    first, last = first[chosen], last[chosen]
    ends = _motion(trajectory, first, last)
    moved = (_sizes(ends) > ALLOWED_ERROR).any(axis=1)
    if not moved.any():
        return np.full(2, np.nan)
    first, last, ends = first[moved], last[moved], ends[moved]
    query = logged[first] + fraction * (logged[last] - logged[first])
    middle = np.clip(np.searchsorted(logged, query), first + 1, last - 1)
    length = (logged[last] - logged[first])[:, None]
    s = (logged[middle] - logged[first])[:, None] / length
    # A cubic with the ends' poses and speeds, as the spline has in a gap.
    begin_speed = (
        -_motion(trajectory, first, first - 1) / (logged[first] - logged[first - 1])[:, None]
    )
    beyond = _motion(trajectory, first, last + 1) - ends
    end_speed = beyond / (logged[last + 1] - logged[last])[:, None]
    bridged = (
        (s**3 - 2.0 * s**2 + s) * length * begin_speed
        + (3.0 * s**2 - 2.0 * s**3) * ends
        + (s**3 - s**2) * length * end_speed
    )
    missed = _sizes(bridged - _motion(trajectory, first, middle))
    return np.sqrt((missed**2).mean(axis=0))


def _motion(
    trajectory: Trajectory, start: np.ndarray, end: np.ndarray
) -> Float[np.ndarray, "windows 6"]:
    """Return displacement (m) and rotation vector (rad) between logged poses."""
    before, after = trajectory.base_from_tool[start], trajectory.base_from_tool[end]
    turn = Rotation.from_matrix(before[:, :3, :3]).inv() * Rotation.from_matrix(after[:, :3, :3])
    return np.hstack([after[:, :3, 3] - before[:, :3, 3], turn.as_rotvec()])


def _sizes(motion: Float[np.ndarray, "windows 6"]) -> Float[np.ndarray, "windows 2"]:
    """Return length and angle of motions, m and rad."""
    return np.linalg.norm(motion.reshape(-1, 2, 3), axis=2)
