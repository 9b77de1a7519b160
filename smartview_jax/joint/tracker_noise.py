"""Find the ratios of a tracker's noises: of rotation, and in depth, to translation across it.

The noise in depth is along the line of sight or along the optical axis, or equal to the noise in
other directions, whichever has most evidence.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration import Calibration, host_mount_from_holder
from ..dataset import UNIT_ROTATION, UNIT_TRANSLATION, PoseDataset
from ..geometry import host_matrices, host_transforms
from ..robot_errors import RobotPrior
from ..runtime.array_namespace import to_device
from ..runtime.blas_threads import on_one_blas_thread
from ..variance import (
    DEPTH_AXES,
    DepthAxis,
    LinearPairs,
    LogNormalPriors,
    likeliest_variances,
    linear_pairs,
    moved_transforms,
)

UNIT_ROUNDS = 2
"""Rounds in which the chain and the ratios of the tracker's noises are estimated in turn."""


@dataclasses.dataclass(frozen=True)
class TrackerPrior:
    """The log-normal priors on a tracker's noise of translation and on the ratios of its noises.

    A marker whose corners are off by an error e has a position off by about e across the line of
    sight, by e times its distance over its size along it, and a rotation off by e over its size.
    The positions of a motion capture system are as good along the line of sight as across it.

    Attributes:
        translation_median: median noise of translation across the line of sight, m; between a laser
            tracker and a small marker at some metres.
        translation_geometric_std: exp of the standard deviation of its logarithm.
        ratio_median: median ratio of rotation to translation across the line of sight, rad/m; one
            over the size of a marker.
        ratio_geometric_std: exp of the standard deviation of its logarithm.
        depth_median: median ratio of translation along the line of sight to across it; between
            motion capture and a marker at five times its size.
        depth_geometric_std: exp of the standard deviation of its logarithm.
    """

    translation_median: float = UNIT_TRANSLATION
    translation_geometric_std: float = 10.0
    ratio_median: float = UNIT_ROTATION / UNIT_TRANSLATION
    ratio_geometric_std: float = 5.0
    depth_median: float = 2.0
    depth_geometric_std: float = 3.0

    def __post_init__(self) -> None:
        for name in ("translation_median", "ratio_median", "depth_median"):
            if not 0.0 < (value := getattr(self, name)) < np.inf:
                raise ValueError(f"TrackerPrior.{name}: expected a positive number, found {value}")
        for name in ("translation_geometric_std", "ratio_geometric_std", "depth_geometric_std"):
            if not 1.0 < (value := getattr(self, name)) < np.inf:
                raise ValueError(f"TrackerPrior.{name}: expected a factor above 1, found {value}")


@on_one_blas_thread
def with_likeliest_units(
    data: PoseDataset,
    calibration: Calibration,
    scale: bool,
    robot_prior: RobotPrior,
    tracker_prior: TrackerPrior,
) -> PoseDataset:
    """Return the data with the likeliest ratios of the tracker's noises in their covariances.

    They are found with white noise of the robot alone: its systematic errors are smooth, and hardly
    change with the ratios. Whether there is a noise in depth, and along which axis, is decided by
    the evidence.

    Args:
        data: the pairs.
        calibration: near the solution.
        scale: whether the tracker's unit is unknown. If it drifts, that is a noise in depth.
        robot_prior, tracker_prior: on the sizes of the robot's noise, and on the ratios.
    """
    factor = float(calibration.target_scale)
    measured = data.tracked_matrices.copy()
    measured[:, :3, 3] *= factor
    in_metres = dataclasses.replace(data, camera_from_world=host_transforms(measured))
    axes: tuple[DepthAxis, ...] = ("none", *DEPTH_AXES)
    noises = [
        _tracker_noise(in_metres, calibration, axis, scale, robot_prior, tracker_prior)
        for axis in axes
    ]
    covariance = max(noises, key=lambda noise: noise.evidence).covariance
    covariance[:, :3] /= factor
    covariance[:, :, :3] /= factor
    # The fit finds their common size.
    size = UNIT_TRANSLATION**2 / np.diagonal(covariance, axis1=1, axis2=2)[:, :3].mean()
    return dataclasses.replace(data, covariance=to_device(size * covariance))


class _TrackerNoise(NamedTuple):
    """The covariances of tracked poses, and the logarithm of the evidence for such a tracker."""

    covariance: Float[np.ndarray, "views 6 6"]
    evidence: float


def _tracker_noise(
    data: PoseDataset,
    calibration: Calibration,
    axis: DepthAxis,
    scale: bool,
    robot_prior: RobotPrior,
    tracker_prior: TrackerPrior,
) -> _TrackerNoise:
    """Return the likeliest noise of tracked poses in metres, with a depth axis.

    Args:
        data: the pairs.
        calibration, scale, robot_prior, tracker_prior: as in `with_likeliest_units`.
        axis: of the noise in depth.
    """
    robot = host_matrices(host_mount_from_holder(data.mount, data.base_from_tool))
    camera_from_mount = host_matrices(calibration.camera_from_mount)
    holder_from_world = host_matrices(calibration.holder_from_world)
    variances = np.ones(4 if axis == "none" else 5)
    covariance, evidence = np.zeros((0, 6, 6)), -np.inf
    for _ in range(UNIT_ROUNDS):
        pairs = linear_pairs(data, camera_from_mount, robot, holder_from_world, axis)
        if scale:
            by_scale = np.pad(-data.tracked_matrices[:, :3, 3], ((0, 0), (0, 3)))[:, :, None]
            columns = np.concatenate([pairs.by_unknowns, by_scale], axis=2)
            pairs = pairs._replace(by_unknowns=columns)
        used = pairs.of(data.seen)
        variances, evidence = _likeliest(used, variances, robot_prior, tracker_prior)
        camera_from_mount, holder_from_world = moved_transforms(
            camera_from_mount, holder_from_world, used.solved(variances)
        )
        # The last two are the robot's.
        covariance = np.einsum("k,kvij->vij", variances[:-2], pairs.parts[:-2])
    return _TrackerNoise(covariance, evidence)


def _likeliest(
    pairs: LinearPairs,
    start: Float[np.ndarray, "parts"],
    robot_prior: RobotPrior,
    tracker_prior: TrackerPrior,
) -> tuple[Float[np.ndarray, "parts"], float]:
    """Return the likeliest variances, of a good robot or of a weak one, and the log evidence."""
    units = np.array([UNIT_TRANSLATION, UNIT_ROTATION])
    # The noise across the depth axis is the first part, to which others have ratios; the robot's
    # are the last two. Without a prior on the first part the evidence for no noise is unbounded.
    powers = np.eye(len(pairs.parts))
    powers[1:-2, 0] = -1.0
    depth = (tracker_prior.depth_median, tracker_prior.depth_geometric_std)
    of_tracker = np.log(
        [
            (
                tracker_prior.translation_median / UNIT_TRANSLATION,
                tracker_prior.translation_geometric_std,
            ),
            *([depth] if len(powers) > 4 else []),
            (tracker_prior.ratio_median * units[0] / units[1], tracker_prior.ratio_geometric_std),
        ]
    )
    weak = robot_prior.weak_robot_probability
    weak_medians = robot_prior.weak_translation_median, robot_prior.weak_rotation_median
    found = []
    for medians, probability in (
        (robot_prior.medians(None), 1.0 - weak),
        (np.array(weak_medians), weak),
    ):
        if probability > 0.0:
            means = np.concatenate([of_tracker[:, 0], np.log(medians / units)])
            stds = np.concatenate([of_tracker[:, 1], robot_prior.log_stds(None)])
            best = likeliest_variances(pairs, start, LogNormalPriors(powers, means, stds))
            found.append((best.variances, best.evidence + float(np.log(probability))))
    return max(found, key=lambda candidate: candidate[1])
