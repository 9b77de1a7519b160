"""Interpolate the poses that a robot logged while it moved."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation, RotationSpline

from ..geometry import PoseLike, as_se3, host_matrices

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
        """Return a trajectory after checking it.

        Raises:
            ValueError: too few poses, or times that do not increase.
        """
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
        """Return the poses at some times, which must be within the logged times.

        Raises:
            ValueError: a time before the first or after the last logged one.
        """
        outside = self.outside(times)
        if outside.any():
            time = times[int(np.argmax(outside))]
            raise ValueError(
                f"trajectory: {time:.9g} s is not within the logged times, {self.times[0]:.9g} to "
                f"{self.times[-1]:.9g} s"
            )
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        poses[:, :3, :3] = self.rotations(times).as_matrix()
        poses[:, :3, 3] = self.positions(times)
        return poses
