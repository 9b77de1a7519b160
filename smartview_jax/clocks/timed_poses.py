"""Fit a chain of tracked poses whose clock is apart from the robot's, with the size of every noise.

The unknowns are the two transforms of the chain and the offset of the clocks. A pair errs by the
tracker's noise, by the robot's, and by the jitter of its time stamp, which moves the target's pose
along the robot's motion: pairs in fast motion tell the offset less well than their speed promises.
The variances are the likeliest ones (`variance.pose_variances`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtri

from ..calibration import mount_from_holder_matrices
from ..dataset import UNIT_ROTATION, UNIT_TRANSLATION, PoseDataset
from ..robots import Trajectory
from ..runtime.blas_threads import on_one_blas_thread
from ..variance import (
    DEPTH_AXES,
    DepthAxis,
    LikeliestVariances,
    LinearPairs,
    Poses,
    likeliest_variances,
    linear_pairs,
    moved_transforms,
    pose_differences,
)

UNIT_JITTER = 1e-3
"""Unit of the jitter of time stamps, s."""

SPEED_STEP = 1e-4
"""Half the time over which the robot's speed is taken, s."""

WRONG_PROBABILITY = 1e-3
"""A pair is left out if a right one has an error like it less often than this."""

MAX_ROUNDS, TOLERANCE = 20, 1e-3
"""Largest number of rounds, and the change of the offset in its standard deviations that ends
them."""


class TimedChain(NamedTuple):
    """The chain of tracked poses, and the offset between its clocks.

    Attributes:
        camera_from_mount, holder_from_world: transforms as matrices.
        seconds: the offset that is added to a tracked pose's time, s.
    """

    camera_from_mount: Float[np.ndarray, "4 4"]
    holder_from_world: Float[np.ndarray, "4 4"]
    seconds: float


class TimedPairs(NamedTuple):
    """Tracked poses with their time stamps, and the log of the robot that moved meanwhile.

    Attributes:
        data: the tracked poses.
        trajectory: poses of the robot over time.
        times: times of the tracked poses by the tracker's clock, s.
    """

    data: PoseDataset
    trajectory: Trajectory
    times: Float[np.ndarray, "views"]

    def linearised(self, axis: DepthAxis, chain: TimedChain) -> LinearPairs:
        """Return the pairs, linear in the chain and the offset; the last noise is the jitter."""
        transforms = chain.camera_from_mount, chain.holder_from_world
        poses = self._mount_from_holder(chain.seconds)
        pairs = linear_pairs(self.data, transforms[0], poses, transforms[1], axis)
        before, after = (
            transforms[0] @ self._mount_from_holder(chain.seconds + change) @ transforms[1]
            for change in (-SPEED_STEP, SPEED_STEP)
        )
        speed = pose_differences(after, before)[:, :, None] / (2.0 * SPEED_STEP)
        by_jitter = UNIT_JITTER**2 * speed * speed.swapaxes(1, 2)
        return LinearPairs(
            pairs.errors,
            np.concatenate([pairs.by_unknowns, speed], axis=2),
            np.concatenate([pairs.parts, by_jitter[None]]),
        )

    def _mount_from_holder(self, offset: float) -> Poses:
        """Return the robot's part of the chain at the time of each tracked pose."""
        seconds = np.clip(self.times + offset, *self.trajectory.times[[0, -1]])
        return mount_from_holder_matrices(self.data.mount, self.trajectory.at(seconds))


class TimedFit(NamedTuple):
    """The fitted chain with what is known of its errors.

    Attributes:
        chain: the fitted chain.
        std: standard deviation of the offset, s.
        jitter: standard deviation of the time stamps, s.
        jitter_std: standard deviation of `jitter`, upwards, s.
        robot_noise: standard deviations of the robot's poses by axis, m and rad.
        used: mask of the pairs that were used.
        deviance: -2 log of the likelihood of the noises.
    """

    chain: TimedChain
    std: float
    jitter: float
    jitter_std: float
    robot_noise: tuple[float, float]
    used: Bool[np.ndarray, "views"]
    deviance: float


@on_one_blas_thread
def fit_timed_poses(
    pairs: TimedPairs,
    start: TimedChain,
    used: Bool[np.ndarray, "views"],
    bounds: tuple[float, float],
) -> TimedFit:
    """Fit the chain and the offset of the clocks to tracked poses.

    Args:
        pairs: the tracked poses and the robot's.
        start: a chain near the solution.
        used: pairs that agree with it; which ones do is found again in each round.
        bounds: smallest and largest offset, s.

    Raises:
        ValueError: a robot that hardly moved, so that every offset is as good.
    """
    fits = [
        _fit_along(axis, pairs, start, used, bounds)
        for axis in DEPTH_AXES[: 1 if pairs.data.states_covariance else None]
    ]
    # Of as many pairs as the other the likelier one, else the one that explains more of them.
    return min(fits, key=lambda fit: (-int(fit.used.sum()), fit.deviance))


def _fit_along(
    axis: DepthAxis,
    pairs: TimedPairs,
    start: TimedChain,
    used: Bool[np.ndarray, "views"],
    bounds: tuple[float, float],
) -> TimedFit:
    """Return the fit with a tracker's depth axis; see `fit_timed_poses`."""
    chain, std, likeliest = start, np.inf, None
    limit = chdtri(6, WRONG_PROBABILITY)
    for _ in range(MAX_ROUNDS):
        linear = pairs.linearised(axis, chain)
        begin = np.ones(len(linear.parts)) if likeliest is None else likeliest.variances
        likeliest = likeliest_variances(linear.of(used), begin)
        variances = likeliest.variances
        covariance = np.einsum("k,kvij->vij", variances, linear.parts)
        step, std = _solution(linear.of(used), variances, bounds[1] - bounds[0])
        residuals = linear.errors - linear.by_unknowns @ step
        distances = np.einsum("vi,vij,vj->v", residuals, np.linalg.inv(covariance), residuals)
        agree = pairs.data.seen & (distances < limit)
        chain = _moved(chain, step, bounds)
        is_same, used = np.array_equal(agree, used), agree
        if is_same and abs(step[-1]) < TOLERANCE * std:
            break
    assert likeliest is not None
    sizes = np.sqrt(likeliest.variances)
    robot = float(sizes[-3] * UNIT_TRANSLATION), float(sizes[-2] * UNIT_ROTATION)
    jitter, jitter_std = UNIT_JITTER * sizes[-1], UNIT_JITTER * _last_std(likeliest)
    return TimedFit(chain, std, float(jitter), jitter_std, robot, used, likeliest.deviance)


def _last_std(likeliest: LikeliestVariances) -> float:
    """Return the standard deviation of the last noise's standard deviation, upwards, in units."""
    # Of the variances, whose information does not vanish with them: I_log = 4 s s' I_variance.
    variances = likeliest.variances
    information = likeliest.information / (4.0 * np.outer(variances, variances))
    size = 1.0 / np.sqrt(np.diagonal(information))
    scaled = np.linalg.pinv(np.outer(size, size) * information, hermitian=True)
    variance_std = size[-1] * np.sqrt(scaled[-1, -1])
    return float(np.sqrt(variances[-1] + variance_std) - np.sqrt(variances[-1]))


def _solution(
    linear: LinearPairs,
    variances: Float[np.ndarray, "parts"],
    largest: float,
) -> tuple[Float[np.ndarray, "13"], float]:
    """Return the step of the unknowns, and the standard deviation of the offset.

    Errors that change slowly are alike in successive pairs. Where the pairs' influences on the
    offset then vary by more than the noises say, they count.

    Args:
        linear: the pairs.
        variances: of their noises.
        largest: largest standard deviation of the offset that tells anything, s.

    Raises:
        ValueError: the offset is not determined.
    """
    step, inverse = linear.solved(variances), linear.inverse(variances)
    residuals = linear.errors - linear.by_unknowns @ step
    influences = np.einsum("vpi,vi->vp", linear.information(variances), residuals) @ inverse[-1]
    std = float(np.sqrt(max(inverse[-1, -1], long_run_variance(influences))))
    if not 0.0 < std < largest:
        raise ValueError("time offset: not determined, because the robot hardly moved")
    return step, std


def _moved(
    chain: TimedChain, step: Float[np.ndarray, "13"], bounds: tuple[float, float]
) -> TimedChain:
    """Return a chain changed by a step of its unknowns, its offset within bounds."""
    transforms = moved_transforms(chain.camera_from_mount, chain.holder_from_world, step)
    return TimedChain(
        *transforms,
        float(np.clip(chain.seconds + step[-1], *bounds)),
    )


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
