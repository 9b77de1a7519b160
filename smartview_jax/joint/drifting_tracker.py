"""Find out whether a tracker drifts, and take its drift out of the poses that it measured.

Visual odometry and other trackers that add up motions have errors that grow from view to view. The
drift is estimated together with the chain (`variance.tracker_drift`). A fit to the poses without
it, which takes errors as independent, then has the best chain of both (Henderson's equations), but
takes the drift as known, and white noise that the drift follows as absent: its covariance is
widened to the one of chain and drift together.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..dataset import MINIMUM_RELIABLE_VIEWS, UNIT_ROTATION, UNIT_TRANSLATION, PoseDataset
from ..geometry import (
    host_adjoints,
    host_cross_matrices,
    host_exponentials,
    host_matrices,
    host_transforms,
)
from ..robot_errors import LinearInPose
from ..runtime.blas_threads import on_one_blas_thread
from ..variance import (
    UNIT_SCALE,
    LogNormalPriors,
    Walk,
    likeliest_walk,
    moved_transforms,
    walk_log_evidence,
)
from .chain_covariance import in_named_parameters, widened_to
from .joint_fit import JointFit
from .tracker_noise import TrackedChain, TrackerNoise, in_metres, noise_priors, scaled_pairs

MIN_CORRELATION = 2.0
"""Correlation of successive errors for which a drift is considered, in its standard deviations.

It saves time: whether a tracker drifts is decided by the evidence.
"""

DRIFT_ROUNDS = 3
"""Rounds in which chain and drift are estimated, each linear at the ones before."""

FIELD_GEOMETRIC_STD = 3.0
"""exp of the standard deviation of the logarithm of an arm's smooth errors over median ones."""


class TrackerDrift(NamedTuple):
    """The drift of a tracker.

    Attributes:
        camera_from_world: tracked poses without it, with translations in the tracker's unit.
        covariance: of these by the tracker's white noise, m and rad.
        steps: standard deviation by axis of the error that is new in a view, m and rad.
        extent: largest distance (m) and angle (rad) of the drift from the first view.
        chain_covariance: of the chain, in the order of the names of both transforms and of the
            scale's logarithm, if that is unknown.
    """

    camera_from_world: Float[np.ndarray, "views 4 4"]
    covariance: Float[np.ndarray, "views 6 6"]
    steps: tuple[float, float]
    extent: tuple[float, float]
    chain_covariance: Float[np.ndarray, "unknowns unknowns"]

    @property
    def described_steps(self) -> str:
        """The error that is new in a view, in words."""
        step, turn = self.steps
        return f"+- {1e3 * step:.2g} mm, {np.rad2deg(turn):.2g} deg from pose to pose"

    @property
    def described(self) -> str:
        """The size of the drift in words."""
        distance, angle = self.extent
        return (
            f"the tracker drifts: by up to {1e3 * distance:.2g} mm and {np.rad2deg(angle):.2g} "
            f"degrees since the first pose ({self.described_steps}). Transforms and intervals "
            "allow for it, if the pairs are in the order in which they were measured; a tracker "
            "that sees one fixed target in all pictures would not drift"
        )


class LikeliestDrift(NamedTuple):
    """The likelier answer to whether the tracker of a chain drifts.

    Attributes:
        chain: the pairs, and what is known of them.
        noise: the likeliest white noise.
        drift: of the tracker; None if the evidence is against one.
        evidence: logarithm of the evidence for the likelier, of positions in metres.
    """

    chain: TrackedChain
    noise: TrackerNoise
    drift: TrackerDrift | None
    evidence: float

    def is_of(self, chain: TrackedChain) -> bool:
        """Return whether it is known for a chain: for the same pairs, from the same start."""
        return (
            self.chain.scale == chain.scale
            and self.chain.calibration is chain.calibration
            and bool((self.chain.data.seen == chain.data.seen).all())
        )


def tracker_drift(
    chain: TrackedChain, noise: TrackerNoise, known: LikeliestDrift | None = None
) -> TrackerDrift | None:
    """Return the drift of a tracker, if the evidence is for one; else None.

    The smooth errors of robots may be alike in successive pairs, too. So the evidence is compared
    between a robot with such errors, and the same with a tracker that drifts.

    Args:
        chain: the pairs, and what is known of them.
        noise: the result of `likeliest_noise`.
        known: the result of `likeliest_drift` for the same chain, if it is known already.
    """
    probability, seen = chain.tracker_prior.drift_probability, chain.data.seen
    if probability == 0.0 or seen.sum() < MINIMUM_RELIABLE_VIEWS:
        return None
    # A drift of the scale alone is in one of the six numbers of a pose.
    if noise.correlation < MIN_CORRELATION and not chain.scale:
        return None
    return (known or likeliest_drift(chain, noise)).drift


@on_one_blas_thread
def likeliest_drift(chain: TrackedChain, noise: TrackerNoise) -> LikeliestDrift:
    """Return the likelier answer to whether a tracker drifts; arguments as in `tracker_drift`."""
    probability = chain.tracker_prior.drift_probability
    steady, drifting = _Chain(chain, noise), _Chain(chain, noise)
    without = steady.evidence(_priors(chain, noise, False), False)
    if probability == 0.0:
        return LikeliestDrift(chain, noise, None, without)
    odds = float(np.log(probability / (1.0 - probability)))
    with_drift = drifting.evidence(_priors(chain, noise, True), True) + odds
    if with_drift > without:
        return LikeliestDrift(chain, noise, drifting.drift(), with_drift)
    return LikeliestDrift(chain, noise, None, without)


class _Chain:
    """A chain of tracked poses, which is estimated with the noises, and with a drift or none."""

    def __init__(self, chain: TrackedChain, noise: TrackerNoise):
        self.data, self.scale, self.noise = chain.data, chain.scale, noise
        self.camera_from_mount, self.holder_from_world = chain.transforms
        self.factor = float(chain.calibration.target_scale)
        self.drifted = np.zeros((chain.data.view_count, 7 if chain.scale else 6))
        self.field = LinearInPose.from_poses(chain.data.base_from_tool)
        medians = chain.robot_prior.medians(self.field)[2:]
        self.field_stds = np.repeat(medians, [count for _, count in self.field.groups])

    def evidence(self, priors: LogNormalPriors, drifts: bool) -> float:
        """Return the logarithm of the evidence, with a drift or none, at the best chain."""
        white = 0.5 * np.log(self.noise.best.variances)
        logarithms = np.pad(white, (0, len(priors.means) - len(white)))
        for _ in range(DRIFT_ROUNDS):
            logarithms = self._round(logarithms, priors, drifts)
        return walk_log_evidence(self.walk, self.likeliest, priors)

    def _round(
        self, start: Float[np.ndarray, "kinds"], priors: LogNormalPriors, drifts: bool
    ) -> Float[np.ndarray, "kinds"]:
        """Move the chain and the drift to the best ones, and return the noises' logarithms."""
        data = self._without_drift()
        pairs = scaled_pairs(
            data, self.camera_from_mount, self.holder_from_world, self.noise.best.axis, self.scale
        )
        # Linear at the drift so far, which is added to what is left.
        by_drift = pairs.by_unknowns[:, :, 6:]
        earlier = np.einsum("vij,vj->vi", by_drift, self.drifted)
        pairs = pairs._replace(errors=pairs.errors + earlier)
        self.walk = Walk.of(pairs, data.seen, self._by_field(), self.field_stds, drifts)
        self.likeliest = likeliest_walk(self.walk, start, priors)
        self.drifted, unknowns = self.likeliest.fit.drift, self.likeliest.fit.unknowns
        self.camera_from_mount, self.holder_from_world = moved_transforms(
            self.camera_from_mount, self.holder_from_world, unknowns
        )
        if self.scale:
            self.factor *= float(np.exp(unknowns[12]))
        return self.likeliest.logarithms

    def _without_drift(self) -> PoseDataset:
        """Return the data in metres, without the drift so far."""
        measured = in_metres(self.data, self.factor).tracked_matrices.copy()
        if self.scale:
            measured[:, :3, 3] *= np.exp(self.drifted[:, 6:])
        # The drift is a left twist of `holder_from_world`.
        world = self.holder_from_world
        back = np.linalg.inv(world) @ host_exponentials(-self.drifted[:, :6]) @ world
        return dataclasses.replace(self.data, camera_from_world=host_transforms(measured @ back))

    def _by_field(self) -> Float[np.ndarray, "views 6 coefficients"]:
        """Return the change of the predictions by the robot error field."""
        robot = host_matrices(self.data.mount_from_holder)
        place = (self.camera_from_mount @ robot @ self.holder_from_world)[:, :3, 3]
        by_twist = np.tile(np.eye(6), (len(robot), 1, 1))
        by_twist[:, :3, 3:] = -host_cross_matrices(place)
        basis = np.asarray(self.field.basis(self.data.base_from_tool))
        # The actual pose of the tool is the reported one times the error.
        if self.data.mount == "eye_in_hand":
            return -by_twist @ host_adjoints(self.camera_from_mount) @ basis
        return by_twist @ host_adjoints(self.camera_from_mount @ robot) @ basis

    def drift(self) -> TrackerDrift:
        """Return the drift that was found."""
        walk, likeliest = self.walk, self.likeliest
        measured = self._without_drift().tracked_matrices
        measured[:, :3, 3] /= self.factor
        variances = np.exp(2.0 * likeliest.logarithms[: len(walk.pairs.parts) - 2])
        stds = walk.drift_stds(likeliest.logarithms)
        moved = np.einsum("vij,vj->vi", walk.by_drift, self.drifted)[self.data.seen]
        count = walk.pairs.by_unknowns.shape[2]
        covariance = likeliest.fit.covariance[:count, :count]
        return TrackerDrift(
            measured,
            np.einsum("k,kvij->vij", variances, walk.pairs.parts[:-2]),
            (float(stds[0]), float(stds[3])),
            (
                float(np.linalg.norm(moved[:, :3], axis=1).max()),
                float(np.linalg.norm(moved[:, 3:], axis=1).max()),
            ),
            in_named_parameters(covariance, self.camera_from_mount, self.holder_from_world),
        )


def _priors(chain: TrackedChain, noise: TrackerNoise, drifts: bool) -> LogNormalPriors:
    """Return the priors on all noises, on the size of the field and on the drift, if any."""
    white = noise_priors(chain, len(noise.best.variances), noise.best.robot_medians)
    more = [(0.0, np.log(FIELD_GEOMETRIC_STD))]
    if drifts:
        prior = chain.tracker_prior
        wide = np.log(prior.drift_geometric_std)
        ratio = prior.drift_ratio_median * UNIT_TRANSLATION / UNIT_ROTATION
        more += [
            (np.log(prior.drift_median / UNIT_TRANSLATION), wide),
            (np.log(ratio), np.log(prior.ratio_geometric_std)),
            *([(np.log(prior.drift_scale_median / UNIT_SCALE), wide)] if chain.scale else []),
        ]
    count = len(white.means)
    powers = np.eye(count + len(more))
    powers[:count, :count] = white.powers
    if drifts:
        powers[count + 2, count + 1] = -1.0
    means, stds = np.array(more).T
    return LogNormalPriors(
        powers, np.concatenate([white.means, means]), np.concatenate([white.stds, stds])
    )


def with_uncertain_drift(fit: JointFit, drift: TrackerDrift) -> JointFit:
    """Return the fit to poses without the drift, with its uncertainty and a warning."""
    widened = widened_to(fit, drift.chain_covariance)
    return dataclasses.replace(widened, warnings=(drift.described, *fit.warnings))
