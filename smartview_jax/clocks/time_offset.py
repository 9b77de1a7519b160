"""Estimate the offset of the robot's clock from the camera's, for pictures taken in motion.

A picture with the camera's time stamp t was taken at the time `t + offset` of the robot's clock.
The offset is found in two steps: a search over many offsets for the best agreement of the robot's
and the camera's motion (the closure error of A X = X B, whose camera poses need no robot); then the
joint fit, whose cost with given standard deviations is minus the logarithm of the profile
likelihood of the offset. Poses of a tracker are fitted by `timed_poses`. The noise of the robot's
log is taken out first: a path through it has the speed of the noise, and seems to tell the offset
better than it does.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.optimize import minimize_scalar

from ..calibration import Calibration, host_mount_from_holder
from ..cameras import AbstractLens
from ..data_checks import closure_error, relative_motions, views_to_use
from ..dataset import Dataset, PoseDataset
from ..engine import Noise, squared_residuals
from ..geometry import as_se3, host_matrices
from ..joint import JointFit, fit_joint, start_from_poses
from ..robots import Trajectory, smoothed_log
from ..staged import fit_staged
from .timed_poses import TimedChain, TimedPairs, fit_timed_poses, long_run_variance

COARSE_STEPS = 80
"""Number of intervals into which the range of offsets is divided for the search."""

NOISE_ROUNDS = 2
"""Number of rounds in which offset and standard deviations are estimated in turn."""

START_TOLERANCE = 1e-3
"""Accuracy of the offset from which tracked poses are fitted, s."""

OFFSET_TOLERANCE = 1e-6
"""Accuracy of the minimum, s: at 1 m/s the robot moves 0.001 mm in this time."""


class TimeOffset(NamedTuple):
    """The difference between two clocks, which converts a picture's time to the robot's clock.

    Attributes:
        seconds: the offset that is added to a picture's time, s.
        std: its standard deviation, s.
        data: the data set with the poses at the corrected times.
        noise: standard deviations of pixels and poses that the estimate rests on.
        jitter: standard deviation of the time stamps of tracked poses, s; None for pictures, in
            whose noise it is contained.
        jitter_std: standard deviation of `jitter`, upwards, s; None for pictures.
    """

    seconds: float
    std: float
    data: Dataset
    noise: Noise
    jitter: float | None = None
    jitter_std: float | None = None

    def __str__(self) -> str:
        """Return the estimates in milliseconds, with the offset's 95 % interval."""
        text = (
            f"robot's clock minus camera's: {1e3 * self.seconds:.2f} +- "
            f"{1e3 * 1.96 * self.std:.2f} ms"
        )
        if self.jitter is None or self.jitter_std is None:
            return text
        return (
            f"{text}; jitter of the time stamps {1e3 * self.jitter:.2g} ms (standard deviation, "
            f"itself +- {1e3 * self.jitter_std:.2g} ms)"
        )


def at_time_offset(
    data: Dataset,
    trajectory: Trajectory,
    picture_times: Float[np.ndarray, "views"],
    seconds: float,
) -> Dataset:
    """Return a data set with the robot's poses at the pictures' corrected times.

    Args:
        data: pictures, whose poses are replaced.
        trajectory: poses that the robot logged.
        picture_times: times of the pictures by the camera's clock, s.
        seconds: offset to add to these times, s.

    Raises:
        ValueError: the numbers of times and views differ, a time was not logged, or two arms.
    """
    if data.hands is not None:
        raise ValueError("data: expected the poses of one arm, found two arms")
    times = np.asarray(picture_times, dtype=float)
    if times.shape != (data.view_count,):
        raise ValueError(
            f"picture_times: expected {data.view_count} times, one for each view; "
            f"found {times.size}"
        )
    return dataclasses.replace(data, base_from_tool=as_se3(trajectory.at(times + seconds)))


def estimate_time_offset(
    data: Dataset,
    trajectory: Trajectory,
    picture_times: Float[np.ndarray, "views"],
    lens: str | AbstractLens = "opencv4",
    *,
    max_offset: float = 0.5,
    progress: Callable[[str], None] | None = None,
) -> TimeOffset:
    """Estimate the difference between the robot's clock and the camera's, with its uncertainty.

    The robot's errors are assumed to be independent between views and of the offset. Noise of the
    log is smoothed away (`robots.smoothed_log`), also in the poses of the result.

    Args:
        data: pictures, or a `PoseDataset` of tracked poses, that were taken in motion; the
            robot's poses in it are not used.
        trajectory: poses that the robot logged.
        picture_times: times of the pictures or tracked poses by the camera's clock, s.
        lens: the lens model; tracked poses have none.
        max_offset: largest size of the offset, s.
        progress: called with a line of text for each stage.

    Raises:
        ValueError: pictures outside the logged times, poses that fit no offset, an offset at the
            end of the range, or a robot that hardly moved; and the errors of `fit_staged`, or of
            `fit_poses`.

    For example:

        >>> path = sv.robots.Trajectory.of(np.linspace(0.0, 14.0, 8), scene.base_from_tool)
        >>> logged = np.arange(0.0, 14.0, 0.02)
        >>> log = sv.robots.Trajectory.of(logged, path.at(logged))
        >>> times = np.arange(1.0, 13.0, 0.5)
        >>> moving = sv.simulation.simulate(truth, path.at(times), points).data
        >>> late = times - 0.035  # the camera's clock is 35 ms behind the robot's
        >>> print(sv.estimate_time_offset(moving, log, late, "radial"))  # doctest: +SKIP
        robot's clock minus camera's: 35.00 +- 0.15 ms
    """
    report = progress or (lambda _: None)
    times = np.asarray(picture_times, dtype=float)
    trajectory = smoothed_log(trajectory)
    data_at = functools.partial(at_time_offset, data, trajectory, times)
    low = max(-max_offset, float(trajectory.times[0] - times.min()))
    high = min(max_offset, float(trajectory.times[-1] - times.max()))
    report(f"time offset: {COARSE_STEPS + 1} from {1e3 * low:.0f} to {1e3 * high:.0f} ms")
    # Of no offset at all, if the log has poses for it.
    used, camera_from_world = _camera_motion(data_at(float(np.clip(0.0, low, high))), lens)
    grid = np.linspace(low, high, COARSE_STEPS + 1)

    def score(shift: float) -> float:
        return _disagreement(data.mount, trajectory.at(times[used] + shift), camera_from_world)

    scores = [score(shift) for shift in grid]
    best = int(np.argmin(scores))
    if best in (0, COARSE_STEPS):
        raise ValueError(
            f"time offset: robot and camera agree best at {1e3 * grid[best]:.0f} ms, the end of "
            f"the range: the offset may be larger, or the poses belong to other pictures"
        )
    seconds, step = float(grid[best]), float(grid[1] - grid[0])
    bounds = (max(seconds - step, low), min(seconds + step, high))
    if isinstance(data, PoseDataset):
        seconds = _minimum(score, bounds, START_TOLERANCE)
        start, agree, *_ = start_from_poses(cast(PoseDataset, data_at(seconds)))
        chain = TimedChain(
            host_matrices(start.camera_from_mount), host_matrices(start.holder_from_world), seconds
        )
        pairs = TimedPairs(data, trajectory, times)
        fit = fit_timed_poses(pairs, chain, agree, (low, high))
        seconds = fit.chain.seconds
        # In units of the tracker's noise its standard deviation is one.
        noise = Noise(1.0, *fit.robot_noise)
        return TimeOffset(seconds, fit.std, data_at(seconds), noise, fit.jitter, fit.jitter_std)
    staged = fit_staged(data_at(seconds), lens)
    profile = _Profile.of(data_at, staged.inliers, staged.calibration, seconds)
    # Twice, because standard deviations that were estimated at another offset are too large.
    for _ in range(NOISE_ROUNDS):
        seconds = _minimum(profile.cost, bounds, OFFSET_TOLERANCE)
        report(f"time offset: {1e3 * seconds:.2f} ms")
        profile = _Profile.of(data_at, staged.inliers, profile.fit.calibration, seconds)
    std = standard_deviation(profile.view_costs, seconds, min(seconds - low, high - seconds))
    return TimeOffset(seconds, std, data_at(seconds), profile.noise)


def _minimum(
    function: Callable[[float], float], bounds: tuple[float, float], tolerance: float
) -> float:
    """Return where a function of one number is least within bounds."""
    solution = minimize_scalar(
        function, bounds=bounds, method="bounded", options={"xatol": tolerance}
    )
    return float(solution.x)  # pyright: ignore[reportAttributeAccessIssue]


def _camera_motion(
    data: Dataset, lens: str | AbstractLens
) -> tuple[Int[np.ndarray, "used"], Float[np.ndarray, "used 4 4"]]:
    """Return the indices of the views to use, and the poses of the camera that need no robot."""
    if isinstance(data, PoseDataset):
        used = data.usable_views()
        return used, data.tracked_matrices[used]
    # Convention errors are only reported, because poses from the wrong time would raise them.
    staged = fit_staged(data, lens, conventions="report")
    used = views_to_use(data)
    return used, host_matrices(staged.step2.camera_from_world)[used]


def _disagreement(
    mount: str,
    base_from_tool: Float[np.ndarray, "views 4 4"],
    camera_from_world: Float[np.ndarray, "views 4 4"],
) -> float:
    """Return how much the motions of robot and camera disagree in rotation and translation."""
    robot = host_matrices(host_mount_from_holder(mount, as_se3(base_from_tool)))
    return closure_error(relative_motions(robot, camera_from_world)).score


class _Profile(NamedTuple):
    """The profile likelihood of an offset for pictures, with given standard deviations.

    All fits use the same observations, so that their costs are comparable.

    Attributes:
        data_at: returns the data set at an offset, s.
        inliers: the observations that are used.
        fit: a joint fit at some offset, with the standard deviations; all others start from it.
    """

    data_at: Callable[[float], Dataset]
    inliers: Bool[Array, "views points"]
    fit: JointFit

    @classmethod
    def of(
        cls,
        data_at: Callable[[float], Dataset],
        inliers: Bool[Array, "views points"],
        start: Calibration,
        seconds: float,
    ) -> "_Profile":
        """Return the profile with the standard deviations that are estimated at an offset, s."""
        fit = fit_joint(data_at(seconds), start, inliers=inliers, field=None)
        return cls(data_at, inliers, fit)

    @property
    def noise(self) -> Noise:
        """The standard deviations of pixels and poses."""
        assert self.fit.noise is not None
        return self.fit.noise

    def cost(self, offset: float) -> float:
        """Return minus the log-likelihood of an offset, maximised over all other parameters."""
        return float(self.view_costs(offset).sum())

    def view_costs(self, offset: float) -> Float[np.ndarray, "views"]:
        """Return half the squared residuals of each view, in standard deviations."""
        solved = fit_joint(
            self.data_at(offset),
            self.fit.calibration,
            inliers=self.inliers,
            noise=self.noise,
            field=None,
            fixed=() if self.fit.fits_camera else ("camera",),
            gross_errors="keep",
        )
        chain = solved.solution.chain
        seen = np.asarray(solved.problem.observations.visible)
        squares = np.where(seen, squared_residuals(solved.problem, chain), 0.0).sum(axis=1)
        corrections = np.asarray(solved.pose_corrections).reshape(-1, 2, 3)
        sizes = np.array([self.noise.translation, self.noise.rotation])
        in_sigmas = corrections / sizes[:, None]
        return 0.5 * (squares + np.sum(in_sigmas**2, axis=(1, 2)))


def standard_deviation(
    view_costs: Callable[[float], Float[np.ndarray, "views"]], seconds: float, max_width: float
) -> float:
    """Return the standard deviation of the maximum of the likelihood.

    The curvature alone is right if the robot's errors are as the model says. Jitter of the time
    stamps errs most where the robot is fast, and slow changes are alike in successive views; what
    the views' slopes at the maximum then vary by is larger than the curvature (White, 1980; Newey
    and West, 1987), and the larger of the two counts.
    """
    least_cost = view_costs(seconds).sum()

    def around(width: float) -> tuple[float, Float[np.ndarray, "views"]]:
        """Return the curvature of the cost, and each view's slope, over an interval."""
        after, before = (view_costs(seconds + shift) for shift in (width, -width))
        curvature = float(after.sum() - 2.0 * least_cost + before.sum()) / width**2
        if not curvature > 0.0:
            raise ValueError("time offset: not determined, because the robot hardly moved")
        return curvature, (after - before) / (2.0 * width)

    # The width at which the cost rises by one half, first from a small step, then from that width.
    curvature, _ = around(min(1e-4, max_width))
    curvature, slopes = around(min(1.0 / np.sqrt(curvature), max_width))
    return float(max(1.0 / np.sqrt(curvature), np.sqrt(long_run_variance(slopes)) / curvature))
