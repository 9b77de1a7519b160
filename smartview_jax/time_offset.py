"""Estimate the offset of the robot's clock from the camera's, for pictures taken in motion.

A picture with the camera's time stamp t was taken at the time `t + offset` of the robot's clock.
The offset is found in two steps: a search over many offsets for the best agreement of the robot's
and the camera's motion (the closure error of A X = X B, whose camera poses need no robot); then the
joint fit, whose cost with given standard deviations is minus the logarithm of the profile
likelihood of the offset. Poses of a tracker take the place of the pictures in the same way.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.optimize import minimize_scalar

from .calibration import Calibration, host_mount_from_holder
from .cameras import AbstractLens
from .dataset import Dataset, PoseDataset
from .engine import Noise, squared_residuals
from .geometry import as_se3, host_matrices
from .joint import JointFit, fit_joint, fit_poses
from .robots import Trajectory
from .staged import closure_error, fit_staged, relative_motions, views_to_use

COARSE_STEPS = 80
"""Number of intervals into which the range of offsets is divided for the search."""

NOISE_ROUNDS = 2
"""Number of rounds in which offset and standard deviations are estimated in turn."""

OFFSET_TOLERANCE = 1e-6
"""Accuracy of the minimum, s: at 1 m/s the robot moves 0.001 mm in this time."""


class TimeOffset(NamedTuple):
    """The difference between two clocks, which converts a picture's time to the robot's clock.

    Attributes:
        seconds: the offset that is added to a picture's time, s.
        std: its standard deviation, s.
        data: the data set with the poses at the corrected times.
        noise: standard deviations of pixels and poses that the estimate rests on.
    """

    seconds: float
    std: float
    data: Dataset
    noise: Noise

    def __str__(self) -> str:
        """Return the estimate in milliseconds, with its 95 % interval."""
        return (
            f"robot's clock minus camera's: {1e3 * self.seconds:.2f} +- "
            f"{1e3 * 1.96 * self.std:.2f} ms"
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
        ValueError: the numbers of times and views differ, or a time was not logged.
    """
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

    The robot's errors are assumed to be independent between views and of the offset.

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
    data_at = functools.partial(at_time_offset, data, trajectory, times)
    low = max(-max_offset, float(trajectory.times[0] - times.min()))
    high = min(max_offset, float(trajectory.times[-1] - times.max()))
    report(f"time offset: {COARSE_STEPS + 1} from {1e3 * low:.0f} to {1e3 * high:.0f} ms")
    # Of no offset at all, if the log has poses for it.
    used, camera_from_world = _camera_motion(data_at(float(np.clip(0.0, low, high))), lens)
    grid = np.linspace(low, high, COARSE_STEPS + 1)
    scores = [
        _disagreement(data.mount, trajectory.at(times[used] + shift), camera_from_world)
        for shift in grid
    ]
    best = int(np.argmin(scores))
    if best in (0, COARSE_STEPS):
        raise ValueError(
            f"time offset: robot and camera agree best at {1e3 * grid[best]:.0f} ms, the end of "
            f"the range: the offset may be larger, or the poses belong to other pictures"
        )
    seconds, step = float(grid[best]), float(grid[1] - grid[0])
    bounds = (max(seconds - step, low), min(seconds + step, high))
    profile = _first_profile(data_at, seconds, lens)
    # Twice, because standard deviations that were estimated at another offset are too large.
    for _ in range(NOISE_ROUNDS):
        minimum = minimize_scalar(
            profile.cost, bounds=bounds, method="bounded", options={"xatol": OFFSET_TOLERANCE}
        )
        seconds = float(minimum.x)  # pyright: ignore[reportAttributeAccessIssue]
        report(f"time offset: {1e3 * seconds:.2f} ms")
        profile = profile.again(seconds)
    std = standard_deviation(profile, seconds, min(seconds - low, high - seconds))
    return TimeOffset(seconds, std, data_at(seconds), profile.noise)


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


class Profile(NamedTuple):
    """The profile likelihood of an offset for given standard deviations.

    Attributes:
        view_costs: minus the log-likelihood of an offset, maximised over all other parameters, by
            views.
        noise: the standard deviations of pixels and poses.
        again: the same with the standard deviations that are estimated at another offset.
    """

    view_costs: Callable[[float], Float[np.ndarray, "views"]]
    noise: Noise
    again: Callable[[float], "Profile"]

    def cost(self, offset: float) -> float:
        """Return half the sum of squared residuals, in standard deviations."""
        return float(self.view_costs(offset).sum())


def _first_profile(
    data_at: Callable[[float], Dataset], seconds: float, lens: str | AbstractLens
) -> Profile:
    """Return the profile likelihood with the standard deviations at an offset, s."""
    data = data_at(seconds)
    if isinstance(data, PoseDataset):
        return _profile_of_tracked_poses(data_at, seconds)
    staged = fit_staged(data, lens)
    return _profile_of_pictures(data_at, staged.inliers, staged.calibration, seconds)


def _profile_of_pictures(
    data_at: Callable[[float], Dataset],
    inliers: Bool[Array, "views points"],
    start: Calibration,
    seconds: float,
) -> Profile:
    """Return the profile likelihood of pictures, with the standard deviations at an offset, s.

    All fits use the same observations, so that their costs are comparable.
    """
    fit = fit_joint(data_at(seconds), start, inliers=inliers, field=None)

    def again(offset: float) -> Profile:
        return _profile_of_pictures(data_at, inliers, fit.calibration, offset)

    assert fit.noise is not None
    return _profile(data_at, inliers, fit, fit.noise, again)


def _profile_of_tracked_poses(data_at: Callable[[float], Dataset], seconds: float) -> Profile:
    """Return the profile likelihood of tracked poses, with the standard deviations at an offset, s.

    Wrong pairs, and the ratio of the tracker's noises, are found at each offset: at a wrong one,
    pairs in fast motion contradict the others.
    """
    data = data_at(seconds)
    assert isinstance(data, PoseDataset)
    fit = fit_poses(data, field=None)

    def in_units(offset: float) -> Dataset:
        moved = data_at(offset)
        assert isinstance(moved, PoseDataset)
        if data.states_covariance:
            return moved.times_covariance(fit.pixel_sigma**2)
        return moved.with_units(*fit.tracker_noise)

    def again(offset: float) -> Profile:
        return _profile_of_tracked_poses(data_at, offset)

    assert fit.noise is not None
    # In units of the tracker's noise its standard deviation is one.
    noise = dataclasses.replace(fit.noise, pixel=1.0, white_pixel=None)
    return _profile(in_units, fit.inliers, fit, noise, again)


def _profile(
    data_at: Callable[[float], Dataset],
    inliers: Bool[Array, "views points"],
    fit: JointFit,
    noise: Noise,
    again: Callable[[float], Profile],
) -> Profile:
    """Return the profile likelihood with given standard deviations, whose fits start at a fit."""
    fixed = () if fit.fits_camera else ("camera",)

    def view_costs(offset: float) -> Float[np.ndarray, "views"]:
        """Return half the squared residuals of each view, in standard deviations."""
        solved = fit_joint(
            data_at(offset),
            fit.calibration,
            inliers=inliers,
            noise=noise,
            field=None,
            fixed=fixed,
            gross_errors="keep",
        )
        chain = solved.solution.chain
        seen = np.asarray(solved.problem.observations.visible)
        squares = np.where(seen, squared_residuals(solved.problem, chain), 0.0).sum(axis=1)
        corrections = np.asarray(solved.pose_corrections).reshape(-1, 2, 3)
        in_sigmas = corrections / np.array([noise.translation, noise.rotation])[:, None]
        return 0.5 * (squares + np.sum(in_sigmas**2, axis=(1, 2)))

    return Profile(view_costs, noise, again)


def standard_deviation(profile: Profile, seconds: float, max_width: float) -> float:
    """Return the standard deviation of the maximum of the likelihood.

    The curvature alone is right if the robot's errors are as the model says. Jitter of the time
    stamps errs most where the robot is fast, and slow changes are alike in successive views; what
    the views' slopes at the maximum then vary by is larger than the curvature (White, 1980; Newey
    and West, 1987), and the larger of the two counts.
    """
    least_cost = profile.cost(seconds)

    def around(width: float) -> tuple[float, Float[np.ndarray, "views"]]:
        """Return the curvature of the cost, and each view's slope, over an interval."""
        after, before = (profile.view_costs(seconds + shift) for shift in (width, -width))
        curvature = float(after.sum() - 2.0 * least_cost + before.sum()) / width**2
        if not curvature > 0.0:
            raise ValueError("time offset: not determined, because the robot hardly moved")
        return curvature, (after - before) / (2.0 * width)

    # The width at which the cost rises by one half, first from a small step, then from that width.
    curvature, _ = around(min(1e-4, max_width))
    curvature, slopes = around(min(1.0 / np.sqrt(curvature), max_width))
    return float(max(1.0 / np.sqrt(curvature), np.sqrt(long_run_variance(slopes)) / curvature))


def long_run_variance(slopes: Float[np.ndarray, "views"]) -> float:
    """Return the variance of the sum of a series whose neighbours may be correlated.

    Reference: Newey and West, "A simple, positive semi-definite, heteroskedasticity and
    autocorrelation consistent covariance matrix", 1987.
    """
    deviations = slopes - slopes.mean()
    count = len(deviations)
    lags = int(np.ceil(count ** (1.0 / 3.0)))
    covariances = [deviations[lag:] @ deviations[: count - lag] for lag in range(1, lags + 1)]
    weights = 1.0 - np.arange(1, lags + 1) / (lags + 1.0)
    return float(deviations @ deviations + 2.0 * (weights @ covariances))
