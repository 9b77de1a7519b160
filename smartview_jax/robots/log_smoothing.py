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
    spline = _SmoothingSpline(times[kept], values[kept])
    errors = [
        np.sum((spline.at(times[left_out], weight) - values[left_out]) ** 2)
        for weight in SMOOTHNESS
    ]
    best = int(np.argmin(errors))
    if best == 0:
        return values
    # All poses count twice as much as the half of them.
    return _SmoothingSpline(times, values).at_knots(2.0 * SMOOTHNESS[best])


class _SmoothingSpline:
    """The natural cubic splines that are near some values, and smooth, for any weight.

    With values y at knots x the spline f minimises

        sum (y - f(x))^2 + weight * integral of f''^2.

    By Reinsch's algorithm: with the second differences `Q^T y` and the integrals R of products of
    hat functions, the second derivatives g at the inner knots are

        (R + weight Q^T Q) g = Q^T y,   f(x) = y - weight Q g.

    SciPy's smoothing spline sets up its equations for every weight again, row by row.

    Reference: Reinsch, Smoothing by spline functions, Numerische Mathematik 10, 1967.
    """

    def __init__(
        self, knots: Float[np.ndarray, "knots"], values: Float[np.ndarray, "knots numbers"]
    ) -> None:
        self._knots, self._values = knots, values
        h = np.diff(knots)
        # The three entries of each column of Q.
        self._first, self._last = 1.0 / h[:-1], 1.0 / h[1:]
        self._middle = -self._first - self._last
        # Symmetric matrices by their diagonals, the main one first.
        self._integrals, self._squares = np.zeros((2, 3, len(h) - 1))
        self._integrals[0], self._integrals[1, :-1] = (h[:-1] + h[1:]) / 3.0, h[1:-1] / 6.0
        self._squares[0] = self._first**2 + self._middle**2 + self._last**2
        self._squares[1, :-1] = self._middle[:-1] * self._first[1:]
        self._squares[1, :-1] += self._last[:-1] * self._middle[1:]
        self._squares[2, :-2] = self._last[:-2] * self._first[2:]

    def at_knots(self, weight: float) -> Float[np.ndarray, "knots numbers"]:
        """Return the spline at its knots."""
        y, entries = self._values, (self._first, self._middle, self._last)
        differences = sum(entry[:, None] * y[k : len(y) - 2 + k] for k, entry in enumerate(entries))
        diagonals = self._integrals + weight * self._squares
        curvatures = solveh_banded(diagonals, differences, lower=True)
        smooth = y.copy()
        for k, entry in enumerate(entries):
            smooth[k : len(y) - 2 + k] -= weight * entry[:, None] * curvatures
        return smooth

    def at(
        self, times: Float[np.ndarray, "times"], weight: float
    ) -> Float[np.ndarray, "times numbers"]:
        """Return the spline at any times between its knots."""
        # Imported here, as in `Trajectory.of`.
        from scipy.interpolate import CubicSpline

        return CubicSpline(self._knots, self.at_knots(weight), bc_type="natural")(times)


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
