"""Find the ratios of a tracker's noises: of rotation, and in depth, to translation across it.

The noise in depth is along the line of sight or along the optical axis, or equal to the noise in
other directions, whichever has most evidence.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..calibration import Calibration
from ..dataset import UNIT_ROTATION, UNIT_TRANSLATION, PoseDataset
from ..geometry import host_logarithms, host_matrices, host_transforms
from ..robot_errors import RobotPrior
from ..runtime.array_namespace import to_device
from ..runtime.blas_threads import on_one_blas_thread
from ..variance import (
    DEPTH_AXES,
    DepthAxis,
    LikeliestVariances,
    LinearPairs,
    LogNormalPriors,
    averaged_covariance,
    likeliest_variances,
    linear_pairs,
    moved_transforms,
    serial_correlation,
)
from .chain_covariance import in_named_parameters

UNIT_ROUNDS = 2
"""Rounds in which the chain and the ratios of the tracker's noises are estimated in turn."""


MIN_HYPOTHESIS_PROBABILITY = 0.01
"""Probability below which a hypothesis on the noise is left out of the covariance."""


@dataclasses.dataclass(frozen=True)
class TrackerPrior:
    """The log-normal priors on a tracker's noise of translation and on the ratios of its noises.

    A marker whose corners are off by an error e has a position off by about e across the line of
    sight, by e times its distance over its size along it, and a rotation off by e over its size.
    The positions of a motion capture system are as good along the line of sight as across it.

    A tracker that adds up motions, as visual odometry does, drifts: the errors of its poses grow
    from one view to the next. It errs by about one percent of the path, and turns by the error over
    the distance of the scene.

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
        drift_probability: probability of a tracker that drifts; with 0 none does.
        drift_median: median error of translation that is new in a view of one that drifts, m.
        drift_ratio_median: median ratio of rotation to translation in it, rad/m; its logarithm is
            as uncertain as the one of `ratio_median`.
        drift_scale_median: median relative error of scale that is new in a view, where the
            tracker's unit is unknown.
        drift_geometric_std: exp of the standard deviation of the logarithms of errors that are new.
    """

    translation_median: float = UNIT_TRANSLATION
    translation_geometric_std: float = 10.0
    ratio_median: float = UNIT_ROTATION / UNIT_TRANSLATION
    ratio_geometric_std: float = 5.0
    depth_median: float = 2.0
    depth_geometric_std: float = 3.0
    drift_probability: float = 0.1
    drift_median: float = 3e-4
    drift_ratio_median: float = 1.0
    drift_scale_median: float = 1e-3
    drift_geometric_std: float = 10.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            name, value = field.name, getattr(self, field.name)
            if name.endswith("_median") and not 0.0 < value < np.inf:
                raise ValueError(f"TrackerPrior.{name}: expected a positive number, found {value}")
            if name.endswith("_geometric_std") and not 1.0 < value < np.inf:
                raise ValueError(f"TrackerPrior.{name}: expected a factor above 1, found {value}")
        if not 0.0 <= self.drift_probability < 1.0:
            raise ValueError(
                "TrackerPrior.drift_probability: expected at least 0 and less than 1, found "
                f"{self.drift_probability}"
            )


class NoiseHypothesis(NamedTuple):
    """A depth axis of the tracker's noise and a good or a weak robot, with the likeliest sizes.

    Attributes:
        axis: axis of the tracker's noise in depth.
        likeliest: the likeliest variances, with the pairs that tell them.
        evidence: logarithm of the evidence, with the prior probability of the robot.
        robot_medians: medians of the prior on the robot's noise.
        transforms: transforms of the chain about which the pairs are linear.
    """

    axis: DepthAxis
    likeliest: LikeliestVariances
    evidence: float
    robot_medians: Float[np.ndarray, "2"]
    transforms: tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]]

    @property
    def variances(self) -> Float[np.ndarray, "parts"]:
        """The variances of all noises, in the order of `LinearPairs.parts`."""
        return self.likeliest.variances

    @property
    def step(self) -> Float[np.ndarray, "unknowns"]:
        """The step of the unknowns from `transforms` to the best chain."""
        return self.likeliest.pairs.solved(self.variances)

    @property
    def log_density(self) -> float:
        """The logarithm of the density of the poses, m and rad, whatever their chain is."""
        return self.evidence + self.likeliest.log_density_over_evidence

    def offset_from(self, other: "NoiseHypothesis") -> Float[np.ndarray, "unknowns"]:
        """Return the step of the unknowns from the transforms of another hypothesis to these."""
        steps = host_logarithms(np.stack(self.transforms) @ np.linalg.inv(other.transforms))
        return np.pad(steps.ravel(), (0, self.likeliest.pairs.by_unknowns.shape[2] - 12))


class TrackerNoise(NamedTuple):
    """The white noise of a tracker.

    Attributes:
        best: the likeliest hypothesis on the noise.
        covariance: covariance of the tracked poses by this noise, m and rad.
        correlation: correlation of successive errors, in its standard deviations.
        hypotheses: all hypotheses that were compared, the best among them.
    """

    best: NoiseHypothesis
    covariance: Float[np.ndarray, "views 6 6"]
    correlation: float
    hypotheses: tuple[NoiseHypothesis, ...]

    @on_one_blas_thread
    def chain_covariance(self) -> Float[np.ndarray, "unknowns unknowns"]:
        """Return the covariance of the chain over all noises, not for the likeliest alone.

        It is in the order of the names of both transforms and of the scale's logarithm, if that is
        unknown.
        """
        evidence = np.array([hypothesis.evidence for hypothesis in self.hypotheses])
        probabilities = np.exp(evidence - np.logaddexp.reduce(evidence))
        step = self.best.step
        likely = probabilities >= MIN_HYPOTHESIS_PROBABILITY
        probabilities = np.where(likely, probabilities, 0.0) / probabilities[likely].sum()
        covariance = np.zeros((len(step), len(step)))
        for k in np.flatnonzero(likely):
            hypothesis = self.hypotheses[k]
            about = step - hypothesis.offset_from(self.best)
            covariance += probabilities[k] * averaged_covariance(hypothesis.likeliest, about)
        return in_named_parameters(covariance, *self.best.transforms)


class TrackedChain(NamedTuple):
    """Tracked poses, and what is known of their chain and of the errors.

    Attributes:
        data: the pairs in the order in which they were measured.
        calibration: near the solution.
        scale: whether the tracker's unit is unknown. If it drifts, that is a noise in depth.
        robot_prior, tracker_prior: on the sizes of the robot's noise, and on the tracker's.
    """

    data: PoseDataset
    calibration: Calibration
    scale: bool
    robot_prior: RobotPrior
    tracker_prior: TrackerPrior

    @property
    def transforms(self) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]]:
        """The matrices `camera_from_mount` and `holder_from_world`."""
        chain = self.calibration.camera_from_mount, self.calibration.holder_from_world
        return host_matrices(chain[0]), host_matrices(chain[1])


@on_one_blas_thread
def likeliest_noise(chain: TrackedChain) -> TrackerNoise:
    """Return the likeliest noise of a tracker.

    It is found with white noise of the robot alone: its systematic errors are smooth, and hardly
    change the ratios. Whether there is a noise in depth, and along which axis, is decided by the
    evidence.
    """
    axes: tuple[DepthAxis, ...] = ("none", *DEPTH_AXES)
    factor = float(chain.calibration.target_scale)
    measured = chain._replace(data=in_metres(chain.data, factor))
    noises = [_tracker_noise(measured, axis) for axis in axes]
    best = max(noises, key=lambda noise: noise.best.evidence)
    return best._replace(hypotheses=tuple(h for noise in noises for h in noise.hypotheses))


def in_metres(data: PoseDataset, factor: float) -> PoseDataset:
    """Return the data set with translations in metres, for a unit of `factor` metres."""
    return dataclasses.replace(data, camera_from_world=measured_in_metres(data, factor))


def measured_in_metres(data: PoseDataset, factor: float) -> SE3:
    """Return the tracked poses with translations in metres, for a unit of `factor` metres."""
    measured = data.tracked_matrices.copy()
    measured[:, :3, 3] *= factor
    return host_transforms(measured)


def with_noise(
    data: PoseDataset, covariance: Float[np.ndarray, "views 6 6"], factor: float
) -> PoseDataset:
    """Return the data set with covariances up to a common size, which the fit finds.

    Args:
        data: with translations in units of `factor` metres.
        covariance: m and rad.
        factor: see above.
    """
    scaled = in_tracker_units(covariance, factor)
    size = UNIT_TRANSLATION**2 / np.diagonal(scaled, axis1=1, axis2=2)[:, :3].mean()
    return dataclasses.replace(data, covariance=to_device(size * scaled))


def in_tracker_units(
    covariance: Float[np.ndarray, "views 6 6"], factor: float
) -> Float[np.ndarray, "views 6 6"]:
    """Return covariances in m and rad for translations in units of `factor` metres."""
    scaled = covariance.copy()
    scaled[:, :3] /= factor
    scaled[:, :, :3] /= factor
    return scaled


def scaled_pairs(
    data: PoseDataset,
    camera_from_mount: Float[np.ndarray, "4 4"],
    holder_from_world: Float[np.ndarray, "4 4"],
    axis: DepthAxis,
    scale: bool,
) -> LinearPairs:
    """Return the pairs, linear in the chain and, if it is unknown, in the logarithm of the scale.

    Args:
        data: with translations in metres.
        camera_from_mount, holder_from_world: transforms of the chain.
        axis: of the tracker's noise in depth.
        scale: whether the unit is unknown.
    """
    robot = host_matrices(data.mount_from_holder)
    pairs = linear_pairs(data, camera_from_mount, robot, holder_from_world, axis)
    if not scale:
        return pairs
    # The predictions in the tracker's units, which have no noise: with the measured ones the scale
    # would be too small, as the slope of a line is if its abscissas have noise.
    predicted = (camera_from_mount @ robot @ holder_from_world)[:, :3, 3]
    by_scale = np.pad(-predicted, ((0, 0), (0, 3)))[:, :, None]
    return pairs._replace(by_unknowns=np.concatenate([pairs.by_unknowns, by_scale], axis=2))


def _tracker_noise(chain: TrackedChain, axis: DepthAxis) -> TrackerNoise:
    """Return the likeliest noise of tracked poses in metres, with a depth axis."""
    pairs, hypotheses, best = _round(chain, axis, None)
    for _ in range(UNIT_ROUNDS - 1):
        pairs, hypotheses, best = _round(chain, axis, best)
    # The last two are the robot's.
    covariance = np.einsum("k,kvij->vij", best.variances[:-2], pairs.parts[:-2])
    correlation = serial_correlation(best.likeliest.pairs, best.variances)
    return TrackerNoise(best, covariance, correlation, hypotheses)


def _round(
    chain: TrackedChain, axis: DepthAxis, last: NoiseHypothesis | None
) -> tuple[LinearPairs, tuple[NoiseHypothesis, ...], NoiseHypothesis]:
    """Return the pairs, linear about the best chain of the last round, the hypotheses, the best."""
    transforms = chain.transforms if last is None else moved_transforms(*last.transforms, last.step)
    pairs = scaled_pairs(chain.data, *transforms, axis, chain.scale)
    start = np.ones(len(pairs.parts)) if last is None else last.variances
    hypotheses = _hypotheses(chain, axis, pairs.of(chain.data.seen), start, transforms)
    return pairs, hypotheses, max(hypotheses, key=lambda hypothesis: hypothesis.evidence)


def _hypotheses(
    chain: TrackedChain,
    axis: DepthAxis,
    pairs: LinearPairs,
    start: Float[np.ndarray, "parts"],
    transforms: tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]],
) -> tuple[NoiseHypothesis, ...]:
    """Return the likeliest variances of a good robot, and of a weak one."""
    prior = chain.robot_prior
    weak = prior.weak_robot_probability
    weak_medians = np.array([prior.weak_translation_median, prior.weak_rotation_median])
    candidates = []
    for medians, probability in ((prior.medians(None), 1.0 - weak), (weak_medians, weak)):
        if probability > 0.0:
            priors = noise_priors(chain, len(pairs.parts), medians)
            likeliest = likeliest_variances(pairs, start, priors)
            evidence = likeliest.evidence + float(np.log(probability))
            candidates.append(NoiseHypothesis(axis, likeliest, evidence, medians, transforms))
    return tuple(candidates)


def noise_priors(
    chain: TrackedChain, parts: int, robot_medians: Float[np.ndarray, "2"]
) -> LogNormalPriors:
    """Return the priors on a tracker's noises and, with these medians, on the robot's."""
    tracker_prior = chain.tracker_prior
    units = np.array([UNIT_TRANSLATION, UNIT_ROTATION])
    # The noise across the depth axis is the first part, to which others have ratios; the robot's
    # are the last two. Without a prior on the first part the evidence for no noise is unbounded.
    powers = np.eye(parts)
    powers[1:-2, 0] = -1.0
    depth = (tracker_prior.depth_median, tracker_prior.depth_geometric_std)
    of_tracker = np.log(
        [
            (
                tracker_prior.translation_median / UNIT_TRANSLATION,
                tracker_prior.translation_geometric_std,
            ),
            *([depth] if parts > 4 else []),
            (tracker_prior.ratio_median * units[0] / units[1], tracker_prior.ratio_geometric_std),
        ]
    )
    means = np.concatenate([of_tracker[:, 0], np.log(robot_medians / units)])
    stds = np.concatenate([of_tracker[:, 1], chain.robot_prior.log_stds(None)])
    return LogNormalPriors(powers, means, stds)
