"""Fit a chain of tracked poses whose clock is apart from the robot's, with the size of every noise.

The unknowns are the two transforms of the chain and the offset of the clocks. A pair errs by the
tracker's noise, by the robot's, and by the jitter of its time stamp, which moves the target's pose
along the robot's motion: pairs in fast motion tell the offset less well than their speed promises.
The variances maximise the restricted likelihood, in which the chain is linear (Patterson and
Thompson, 1971). All of it is NumPy: small matrices, once for each data set.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize
from scipy.special import chdtri

from .dataset import UNIT_ROTATION, UNIT_TRANSLATION, PoseDataset
from .geometry import (
    host_adjoints,
    host_cross_matrices,
    host_exponentials,
    host_logarithms,
)
from .robots import Trajectory

UNIT_JITTER = 1e-3
"""Unit of the jitter of time stamps, s."""

SMALLEST_PART = 1e-3
"""Smallest standard deviation that is told from none, in units of the noise."""

SPEED_STEP = 1e-4
"""Half the time over which the robot's speed is taken, s."""

WRONG_PROBABILITY = 1e-3
"""A pair is left out if a right one has an error like it less often than this."""

MAX_ROUNDS, TOLERANCE = 20, 1e-3
"""Largest number of rounds, and the change of the offset in its standard deviations that ends
them."""

_Poses = Float[np.ndarray, "views 4 4"]


class TimedChain(NamedTuple):
    """The chain of tracked poses, and the offset between its clocks.

    Attributes:
        camera_from_mount, holder_from_world: transforms as matrices.
        seconds: the offset that is added to a tracked pose's time, s.
    """

    camera_from_mount: Float[np.ndarray, "4 4"]
    holder_from_world: Float[np.ndarray, "4 4"]
    seconds: float


class TimedFit(NamedTuple):
    """The fitted chain with what is known of its errors.

    Attributes:
        chain: the fitted chain.
        std: standard deviation of the offset, s.
        jitter: standard deviation of the time stamps, s.
        robot_noise: standard deviations of the robot's poses by axis, m and rad.
        used: mask of the pairs that were used.
    """

    chain: TimedChain
    std: float
    jitter: float
    robot_noise: tuple[float, float]
    used: Bool[np.ndarray, "views"]


class _Linearised(NamedTuple):
    """The pairs, linear in the unknowns at a chain.

    Attributes:
        errors: measured minus predicted poses: translation (m) and rotation vector (rad).
        by_unknowns: change of the predictions by twists of both transforms, and by the offset.
        parts: covariance of the errors by each noise with a standard deviation of one unit.
    """

    errors: Float[np.ndarray, "views 6"]
    by_unknowns: Float[np.ndarray, "views 6 13"]
    parts: Float[np.ndarray, "parts views 6 6"]

    def of(self, used: Bool[np.ndarray, "views"]) -> "_Linearised":
        """Return some of the pairs."""
        return _Linearised(self.errors[used], self.by_unknowns[used], self.parts[:, used])


def fit_timed_poses(
    data: PoseDataset,
    trajectory: Trajectory,
    times: Float[np.ndarray, "views"],
    start: TimedChain,
    used: Bool[np.ndarray, "views"],
    bounds: tuple[float, float],
) -> TimedFit:
    """Fit the chain and the offset of the clocks to tracked poses.

    Args:
        data: the tracked poses.
        trajectory: poses of the robot over time.
        times: times of the tracked poses by the tracker's clock, s.
        start: a chain near the solution.
        used: pairs that agree with it; which ones do is found again in each round.
        bounds: smallest and largest offset, s.

    Raises:
        ValueError: a robot that hardly moved, so that every offset is as good.
    """
    chain, std, variances = start, np.inf, np.zeros(0)
    limit = chdtri(6, WRONG_PROBABILITY)
    for _ in range(MAX_ROUNDS):
        linear = _linearised(data, trajectory, times, chain)
        variances = _variances(linear.of(used), variances)
        covariance = np.einsum("k,kvij->vij", variances, linear.parts)
        step, std = _solution(linear.of(used), covariance[used], bounds[1] - bounds[0])
        left = linear.errors - linear.by_unknowns @ step
        distances = np.einsum("vi,vij,vj->v", left, np.linalg.inv(covariance), left)
        agree = data.seen & (distances < limit)
        chain = _moved(chain, step, bounds)
        is_same, used = np.array_equal(agree, used), agree
        if is_same and abs(step[-1]) < TOLERANCE * std:
            break
    sizes = np.sqrt(variances)
    robot = float(sizes[-3] * UNIT_TRANSLATION), float(sizes[-2] * UNIT_ROTATION)
    return TimedFit(chain, std, float(sizes[-1] * UNIT_JITTER), robot, used)


def _linearised(
    data: PoseDataset,
    trajectory: Trajectory,
    times: Float[np.ndarray, "views"],
    chain: TimedChain,
) -> _Linearised:
    """Return the pairs, linear in the unknowns at a chain."""
    is_in_hand = data.mount == "eye_in_hand"

    def mount_from_holder(seconds: float) -> _Poses:
        robot = trajectory.at(np.clip(times + seconds, trajectory.times[0], trajectory.times[-1]))
        return np.linalg.inv(robot) if is_in_hand else robot

    before, at, after = (
        chain.camera_from_mount
        @ mount_from_holder(chain.seconds + change)
        @ chain.holder_from_world
        for change in (-SPEED_STEP, 0.0, SPEED_STEP)
    )
    measured = data.tracked_matrices
    # A twist in the camera's frame moves a translation t by v + w x t.
    by_twist = np.tile(np.eye(6), (len(times), 1, 1))
    by_twist[:, :3, 3:] = -host_cross_matrices(at[:, :3, 3])
    by_holder = by_twist @ host_adjoints(at @ np.linalg.inv(chain.holder_from_world))
    # The robot errs at its tool, which is the mount of a camera on the hand, and else the holder.
    by_tool = by_twist @ host_adjoints(chain.camera_from_mount) if is_in_hand else by_holder
    speed = (_differences(after, at) - _differences(before, at)) / (2.0 * SPEED_STEP)
    assert data.covariance is not None
    tracker = np.asarray(data.covariance)
    halves = np.array([np.r_[np.ones(3), np.zeros(3)], np.r_[np.zeros(3), np.ones(3)]])
    units = UNIT_TRANSLATION, UNIT_ROTATION
    by_tracker = (
        [tracker]
        if data.states_covariance
        else [
            np.tile(np.diag(unit**2 * half), (len(times), 1, 1))
            for unit, half in zip(units, halves, strict=True)
        ]
    )
    by_robot = [
        unit**2 * (by_tool * half) @ by_tool.swapaxes(1, 2)
        for unit, half in zip(units, halves, strict=True)
    ]
    by_jitter = UNIT_JITTER**2 * speed[:, :, None] * speed[:, None]
    return _Linearised(
        _differences(measured, at),
        np.concatenate([by_twist, by_holder, speed[:, :, None]], axis=2),
        np.stack([*by_tracker, *by_robot, by_jitter]),
    )


def _differences(poses: _Poses, others: _Poses) -> Float[np.ndarray, "views 6"]:
    """Return differences of translations, m, and the rotation vectors between poses."""
    turns = np.tile(np.eye(4), (len(poses), 1, 1))
    turns[:, :3, :3] = poses[:, :3, :3] @ others[:, :3, :3].swapaxes(1, 2)
    return np.concatenate(
        [poses[:, :3, 3] - others[:, :3, 3], host_logarithms(turns)[:, 3:]], axis=1
    )


def _variances(
    linear: _Linearised, start: Float[np.ndarray, "parts"]
) -> Float[np.ndarray, "parts"]:
    """Return the variances of all noises that maximise the restricted likelihood."""
    # Of the unknowns only the space that they span matters.
    columns = linear.by_unknowns / np.linalg.norm(linear.by_unknowns, axis=(0, 1))

    def deviance(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        """Return -2 log of the restricted likelihood, and its slopes by log variances."""
        covariance = np.einsum("k,kvij->vij", np.exp(logarithms), linear.parts)
        information = np.linalg.inv(covariance)
        weighted = information @ columns
        normal = np.einsum("vip,viq->pq", columns, weighted)
        inverse = np.linalg.inv(normal)
        solved = inverse @ np.einsum("vip,vi->p", weighted, linear.errors)
        residuals = linear.errors - columns @ solved
        whitened = np.einsum("vij,vj->vi", information, residuals)
        value = (
            np.linalg.slogdet(covariance)[1].sum()
            + np.linalg.slogdet(normal)[1]
            + np.sum(residuals * whitened)
        )
        # By each part V: tr(P V) - r' S^-1 V S^-1 r, with P = S^-1 - S^-1 J (J' S^-1 J)^-1 J' S^-1.
        projected = information - weighted @ inverse @ weighted.swapaxes(1, 2)
        slopes = np.einsum("vij,kvji->k", projected, linear.parts) - np.einsum(
            "vi,kvij,vj->k", whitened, linear.parts, whitened
        )
        return float(value), np.exp(logarithms) * slopes

    count, widest = len(linear.parts), -2.0 * np.log(SMALLEST_PART)
    begin = np.log(start) if len(start) else np.zeros(count)
    best = minimize(
        deviance, begin, jac=True, method="L-BFGS-B", bounds=[(-widest, widest)] * count
    )
    return np.exp(best.x)


def _solution(
    linear: _Linearised,
    covariance: Float[np.ndarray, "used 6 6"],
    largest: float,
) -> tuple[Float[np.ndarray, "13"], float]:
    """Return the step of the unknowns, and the standard deviation of the offset.

    Errors that change slowly are alike in successive pairs. Where the pairs' influences on the
    offset then vary by more than the noises say, they count.

    Args:
        linear: the pairs.
        covariance: of their errors.
        largest: largest standard deviation of the offset that tells anything, s.

    Raises:
        ValueError: the offset is not determined.
    """
    weighted = np.linalg.inv(covariance) @ linear.by_unknowns
    normal = np.einsum("vip,viq->pq", linear.by_unknowns, weighted)
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(normal), np.finfo(float).tiny))
    # Transforms may be undetermined, as by turns about one axis, where the offset is not.
    inverse = np.linalg.pinv(normal * np.outer(scale, scale), hermitian=True)
    inverse *= np.outer(scale, scale)
    step = inverse @ np.einsum("vip,vi->p", weighted, linear.errors)
    residuals = linear.errors - linear.by_unknowns @ step
    influences = np.einsum("vip,vi->vp", weighted, residuals) @ inverse[-1]
    std = float(np.sqrt(max(inverse[-1, -1], long_run_variance(influences))))
    if not 0.0 < std < largest:
        raise ValueError("time offset: not determined, because the robot hardly moved")
    return step, std


def _moved(
    chain: TimedChain, step: Float[np.ndarray, "13"], bounds: tuple[float, float]
) -> TimedChain:
    """Return a chain changed by a step of its unknowns, its offset within bounds."""
    by_mount, by_holder = host_exponentials(step[:12].reshape(2, 6))
    return TimedChain(
        by_mount @ chain.camera_from_mount,
        by_holder @ chain.holder_from_world,
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
