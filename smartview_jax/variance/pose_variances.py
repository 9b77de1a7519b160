"""Estimate the sizes of the noises of tracked poses from how far the chain misses them.

The chain is linear in its unknowns near the solution. The variances of tracker and robot maximise
the restricted likelihood, in which the unknowns are integrated out (Patterson and Thompson, 1971).
It is NumPy throughout: small matrices, once for each data set.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize

from ..dataset import UNIT_ROTATION, UNIT_TRANSLATION, PoseDataset
from ..geometry import (
    host_adjoints,
    host_cross_matrices,
    host_exponentials,
    host_logarithms,
)

SMALLEST_PART = 1e-3
"""Smallest standard deviation that is told from none, in units of the noise."""

DEVIANCE_TOLERANCE = 1e-13
"""Relative change of the deviance that ends the search: variances are then found to 1e-5."""

KNOWN_CHANGE = 0.1
"""Relative change of a covariance by one standard deviation of each size, below which the sizes
are known: their average would change the covariance by about half of its square for each."""

SIZE_DRAWS = 256
"""Number of draws of the sizes of noises over which a covariance is averaged."""

PROPOSAL_WIDTH, PROPOSAL_FREEDOM = 1.3, 5.0
"""Width of the distribution of the draws, in standard deviations by the information on the sizes,
and its degrees of freedom: its tails are wider than the posterior's."""

DepthAxis = Literal["none", "sight", "optical"]
"""Axis of a tracker's noise in depth: the line of sight, as of a marker in pictures, or the optical
axis, as of a sensor that measures depth apart from the other coordinates; none, as of a motion
capture system, whose translations are equally good in all directions."""

DEPTH_AXES: tuple[DepthAxis, ...] = ("sight", "optical")
"""The axes of trackers that have one."""

Poses = Float[np.ndarray, "views 4 4"]


class LinearPairs(NamedTuple):
    """Pairs of a tracked and a predicted pose, linear in the unknowns of the chain.

    Attributes:
        errors: measured minus predicted poses: translation (m) and rotation vector (rad).
        by_unknowns: change of the predictions by left twists of `camera_from_mount` and
            `holder_from_world`, and by what else is unknown.
        parts: covariance of the errors by each noise with a standard deviation of one unit: the
            tracker's (one, if its covariances are stated; else across its depth axis, along it if
            there is one, and of rotation), then the robot's of translation and of rotation.
    """

    errors: Float[np.ndarray, "views 6"]
    by_unknowns: Float[np.ndarray, "views 6 unknowns"]
    parts: Float[np.ndarray, "parts views 6 6"]

    def of(self, used: Bool[np.ndarray, "views"]) -> "LinearPairs":
        """Return some of the pairs."""
        return LinearPairs(self.errors[used], self.by_unknowns[used], self.parts[:, used])

    def information(
        self, variances: Float[np.ndarray, "parts"]
    ) -> Float[np.ndarray, "views unknowns 6"]:
        """Return the changes by the unknowns times the inverse covariance of the errors."""
        covariance = np.einsum("k,kvij->vij", variances, self.parts)
        return (np.linalg.inv(covariance) @ self.by_unknowns).swapaxes(1, 2)

    def solved(self, variances: Float[np.ndarray, "parts"]) -> Float[np.ndarray, "unknowns"]:
        """Return the step of the unknowns that explains the errors best."""
        return self.inverse(variances) @ np.einsum(
            "vpi,vi->p", self.information(variances), self.errors
        )

    def inverse(
        self, variances: Float[np.ndarray, "parts"]
    ) -> Float[np.ndarray, "unknowns unknowns"]:
        """Return the covariance of the unknowns; zero in directions that nothing tells."""
        normal = np.einsum("vpi,viq->pq", self.information(variances), self.by_unknowns)
        size = 1.0 / np.sqrt(np.maximum(np.diagonal(normal), np.finfo(float).tiny))
        scale = np.outer(size, size)
        return scale * np.linalg.pinv(scale * normal, rcond=1e-12, hermitian=True)


class LogNormalPriors(NamedTuple):
    """Log-normal priors on products and ratios of the noises' standard deviations.

    Attributes:
        powers: of the standard deviations, in units, in the order of `LinearPairs.parts`.
        means, stds: of the logarithms of the products.
    """

    powers: Float[np.ndarray, "priors parts"]
    means: Float[np.ndarray, "priors"]
    stds: Float[np.ndarray, "priors"]


class LikeliestVariances(NamedTuple):
    """The likeliest variances of the noises.

    Attributes:
        variances: in squared units, in the order of `LinearPairs.parts`.
        deviance: -2 log of their posterior density, but for a constant.
        pairs: the pairs that tell them.
        priors: their priors; None for flat ones.
    """

    variances: Float[np.ndarray, "parts"]
    deviance: float
    pairs: LinearPairs
    priors: LogNormalPriors | None

    @property
    def information(self) -> Float[np.ndarray, "parts parts"]:
        """The expected information on the logarithms of their roots, with the priors'."""
        information = _information(self.pairs, self.variances)
        if self.priors is not None:
            powers, stds = self.priors.powers, self.priors.stds
            information += powers.T @ (powers / stds[:, None] ** 2)
        return information

    @property
    def evidence(self) -> float:
        """The logarithm of the evidence by Laplace's method, but for a constant.

        It compares descriptions of the same pairs by other noises, whose priors are proper.
        """
        # log Z = -D / 2 - log det(I / 2 pi) / 2, in which the 2 pi of as many priors cancel.
        return -0.5 * (self.deviance + float(np.linalg.slogdet(self.information)[1]))

    @property
    def log_density_over_evidence(self) -> float:
        """The log density of the poses (m, rad), whatever the unknowns are, over `evidence`.

        The sum compares different pairs. The density of the unknowns is flat; it is minus infinity
        if the pairs do not tell all of them.
        """
        by_unknowns = self.pairs.by_unknowns
        views, numbers, unknowns = by_unknowns.shape
        lengths = np.linalg.norm(by_unknowns, axis=(0, 1))
        inverse = self.pairs.inverse(self.variances)
        sizes = np.outer(lengths, lengths)
        if np.linalg.matrix_rank(sizes * inverse, hermitian=True) < unknowns:
            return -np.inf
        # The deviance has scaled unknowns: a unit of each changes the predictions by one in all.
        constant = 0.5 * (views * numbers - unknowns) * np.log(2.0 * np.pi)
        return -float(np.log(lengths).sum() + constant)


def linear_pairs(
    data: PoseDataset,
    camera_from_mount: Float[np.ndarray, "4 4"],
    mount_from_holder: Poses,
    holder_from_world: Float[np.ndarray, "4 4"],
    depth_axis: DepthAxis = "sight",
) -> LinearPairs:
    """Return the pairs of a data set, linear in the unknowns at a chain.

    Args:
        data: the tracked poses.
        camera_from_mount, holder_from_world: the transforms of the chain.
        mount_from_holder: the robot's part of the chain in every view.
        depth_axis: the direction in which the tracker's translations have a noise of their own.
    """
    predicted = camera_from_mount @ mount_from_holder @ holder_from_world
    count = len(predicted)
    # A twist in the camera's frame moves a translation t by v + w x t.
    by_twist = np.tile(np.eye(6), (count, 1, 1))
    by_twist[:, :3, 3:] = -host_cross_matrices(predicted[:, :3, 3])
    by_holder = by_twist @ host_adjoints(camera_from_mount @ mount_from_holder)
    # The robot errs at its tool, which is the mount of a camera on the hand, and else the holder.
    is_in_hand = data.mount == "eye_in_hand"
    by_tool = by_twist @ host_adjoints(camera_from_mount) if is_in_hand else by_holder
    by_robot = [
        UNIT_TRANSLATION**2 * by_tool[:, :, :3] @ by_tool[:, :, :3].swapaxes(1, 2),
        UNIT_ROTATION**2 * by_tool[:, :, 3:] @ by_tool[:, :, 3:].swapaxes(1, 2),
    ]
    assert data.covariance is not None
    by_tracker = (
        [np.asarray(data.covariance)]
        if data.states_covariance
        else _tracker_parts(predicted, depth_axis)
    )
    return LinearPairs(
        pose_differences(data.tracked_matrices, predicted),
        np.concatenate([by_twist, by_holder], axis=2),
        np.stack([*by_tracker, *by_robot]),
    )


def _tracker_parts(
    camera_from_world: Poses, depth_axis: DepthAxis
) -> list[Float[np.ndarray, "views 6 6"]]:
    """Return a tracker's noise of one unit: across its depth axis, along it, of rotation.

    Without a depth axis: in all directions, and of rotation.
    """
    place = camera_from_world[:, :3, 3]
    if depth_axis == "optical":
        place = np.tile([0.0, 0.0, 1.0], (len(place), 1))
    sight = place / np.maximum(np.linalg.norm(place, axis=1, keepdims=True), np.finfo(float).tiny)
    along, across, turn = (np.zeros((len(place), 6, 6)) for _ in range(3))
    along[:, :3, :3] = sight[:, :, None] * sight[:, None]
    across[:, :3, :3] = np.eye(3) - along[:, :3, :3]
    turn[:, 3:, 3:] = np.eye(3)
    if depth_axis == "none":
        return [UNIT_TRANSLATION**2 * (across + along), UNIT_ROTATION**2 * turn]
    return [UNIT_TRANSLATION**2 * across, UNIT_TRANSLATION**2 * along, UNIT_ROTATION**2 * turn]


def moved_transforms(
    camera_from_mount: Float[np.ndarray, "4 4"],
    holder_from_world: Float[np.ndarray, "4 4"],
    step: Float[np.ndarray, "unknowns"],
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]]:
    """Return both transforms of the chain after a step of the unknowns of `LinearPairs`."""
    by_mount, by_holder = host_exponentials(step[:12].reshape(2, 6))
    return by_mount @ camera_from_mount, by_holder @ holder_from_world


def pose_differences(poses: Poses, others: Poses) -> Float[np.ndarray, "views 6"]:
    """Return differences of translations, m, and the rotation vectors between poses."""
    turns = np.tile(np.eye(4), (len(poses), 1, 1))
    turns[:, :3, :3] = poses[:, :3, :3] @ others[:, :3, :3].swapaxes(1, 2)
    return np.concatenate(
        [poses[:, :3, 3] - others[:, :3, 3], host_logarithms(turns)[:, 3:]], axis=1
    )


def likeliest_variances(
    pairs: LinearPairs, start: Float[np.ndarray, "parts"], priors: LogNormalPriors | None = None
) -> LikeliestVariances:
    """Return the variances of all noises that maximise the restricted likelihood times the prior.

    Args:
        pairs: the pairs.
        start: variances from which the search begins.
        priors: on the noises; flat ones by default.
    """
    deviance, widest = _Deviance(pairs, priors), -2.0 * np.log(SMALLEST_PART)
    optimum = minimize(
        deviance.with_slopes,
        np.log(start),
        jac=True,
        method="L-BFGS-B",
        bounds=[(-widest, widest)] * len(start),
        options={"ftol": DEVIANCE_TOLERANCE},
    )
    return LikeliestVariances(np.exp(optimum.x), float(optimum.fun), pairs, priors)


def averaged_covariance(
    likeliest: LikeliestVariances, about: Float[np.ndarray, "unknowns"] | None = None
) -> Float[np.ndarray, "unknowns unknowns"]:
    """Return the covariance of the unknowns about an estimate, over all sizes of the noises.

    A few pairs do not tell the sizes. The covariance is the mean of the covariances at each size,
    by its posterior probability, plus the scatter of the estimates at these sizes (law of total
    covariance). Where the sizes are known well enough, it is the covariance at the likeliest ones.

    Args:
        likeliest: the likeliest sizes, with proper priors.
        about: the estimate, a step of the unknowns; by default the one at the likeliest sizes.
    """
    deviance, count = _Deviance(likeliest.pairs, likeliest.priors), len(likeliest.variances)
    centre, widest = np.log(likeliest.variances), -2.0 * np.log(SMALLEST_PART)
    root = 2.0 * np.linalg.cholesky(np.linalg.inv(likeliest.information))
    value, step, covariance = deviance.solution(centre)
    offset = np.zeros(len(step)) if about is None else step - about
    at_likeliest = covariance + np.outer(offset, offset)
    if all(
        _is_nearly(covariance, step, *deviance.solution(centre + sign * change)[1:])
        for change in root.T
        for sign in (1.0, -1.0)
    ):
        return at_likeliest
    # Importance sampling from a Student distribution about the likeliest logarithms, wider than
    # the normal one of their information.
    drawn = _student_draws(count)
    logarithms = centre + PROPOSAL_WIDTH * drawn @ root.T
    possible = (np.abs(logarithms) <= widest).all(axis=1)
    logarithms, drawn = logarithms[possible], drawn[possible]
    if not len(drawn):
        return at_likeliest
    solutions = [deviance.solution(drawing) for drawing in logarithms]
    values, steps, covariances = (np.array(part) for part in zip(*solutions, strict=True))
    log_proposal = np.log1p(np.sum(drawn**2, axis=1) / PROPOSAL_FREEDOM)
    log_proposal *= -0.5 * (PROPOSAL_FREEDOM + count)
    log_weights = -0.5 * (values - value) - log_proposal
    weights = np.exp(log_weights - log_weights.max())
    if not weights.sum() > 0.0:
        return at_likeliest
    weights /= weights.sum()
    scatter = steps - step + offset
    return np.tensordot(weights, covariances, 1) + scatter.T @ (weights[:, None] * scatter)


def _student_draws(count: int) -> Float[np.ndarray, "draws numbers"]:
    """Return draws of a Student distribution about zero, each with its mirror image."""
    random, freedom = np.random.default_rng(0), PROPOSAL_FREEDOM
    normal = random.standard_normal((SIZE_DRAWS // 2, count))
    drawn = normal / np.sqrt(random.chisquare(freedom, (SIZE_DRAWS // 2, 1)) / freedom)
    return np.concatenate([drawn, -drawn])


def _is_nearly(
    covariance: Float[np.ndarray, "unknowns unknowns"],
    step: Float[np.ndarray, "unknowns"],
    other_step: Float[np.ndarray, "unknowns"],
    other_covariance: Float[np.ndarray, "unknowns unknowns"],
) -> bool:
    """Return whether another covariance and step are nearly the same, in standard deviations."""
    size = np.sqrt(np.diagonal(covariance))
    size = np.where(size > 0.0, size, 1.0)
    changes = (other_step - step) / size, (other_covariance - covariance) / np.outer(size, size)
    return all(bool((np.abs(change) < KNOWN_CHANGE).all()) for change in changes)


class _Deviance:
    """The deviance, -2 log of the restricted likelihood times the prior, by log variances."""

    def __init__(self, pairs: LinearPairs, priors: LogNormalPriors | None):
        self._pairs, self._priors = pairs, priors
        # Of the unknowns only the space that they span matters.
        lengths = np.linalg.norm(pairs.by_unknowns, axis=(0, 1))
        self._lengths = np.maximum(lengths, np.finfo(float).tiny)
        self._columns = pairs.by_unknowns / self._lengths
        # In rows of numbers sums over the pairs are products of matrices, which take a fraction of
        # the time that NumPy's sums of products do.
        self._rows = self._columns.reshape(-1, len(lengths))
        self._flat_parts = pairs.parts.reshape(len(pairs.parts), -1)

    def with_slopes(self, logarithms: Float[np.ndarray, "parts"]) -> tuple[float, np.ndarray]:
        """Return the deviance, and its slopes by log variances."""
        value, inverse, _, (information, weighted, whitened) = self._solved(logarithms)
        # By each part V: tr(P V) - r' W V W r, with W = S^-1 and P = W - W J (J' W J)^-1 J' W.
        projected = information - (weighted.reshape(self._rows.shape) @ inverse).reshape(
            weighted.shape
        ) @ weighted.swapaxes(1, 2)
        by_covariance = projected - whitened[:, :, None] * whitened[:, None]
        slopes = np.exp(logarithms) * (self._flat_parts @ by_covariance.ravel())
        if self._priors is not None:
            slopes += self._priors.powers.T @ (self._misses(logarithms) / self._priors.stds)
        return value, slopes

    def solution(
        self, logarithms: Float[np.ndarray, "parts"]
    ) -> tuple[float, Float[np.ndarray, "unknowns"], Float[np.ndarray, "unknowns unknowns"]]:
        """Return the deviance, and the best step of the unknowns with its covariance."""
        value, inverse, step, _ = self._solved(logarithms)
        return value, step / self._lengths, inverse / np.outer(self._lengths, self._lengths)

    def _solved(
        self, logarithms: Float[np.ndarray, "parts"]
    ) -> tuple[float, np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Return the deviance, covariance and step of the unknowns, and what the slopes need."""
        errors = self._pairs.errors
        covariance = (np.exp(logarithms) @ self._flat_parts).reshape(self._pairs.parts.shape[1:])
        information = np.linalg.inv(covariance)
        weighted = information @ self._columns
        weighted_rows = weighted.reshape(self._rows.shape)
        normal = self._rows.T @ weighted_rows
        # An unknown that no motion tells has no likelihood to integrate.
        values, vectors = np.linalg.eigh(normal)
        told = values > 1e-12 * values[-1]
        inverse = (vectors[:, told] / values[told]) @ vectors[:, told].T
        step = inverse @ (errors.ravel() @ weighted_rows)
        residuals = errors - (self._rows @ step).reshape(errors.shape)
        whitened = (information @ residuals[..., None])[..., 0]
        value = (
            np.linalg.slogdet(covariance)[1].sum()
            + np.log(values[told]).sum()
            + np.sum(residuals * whitened)
        )
        if self._priors is not None:
            misses, stds = self._misses(logarithms), self._priors.stds
            value += np.sum(misses**2) + 2.0 * np.log(stds).sum()
        return float(value), inverse, step, (information, weighted, whitened)

    def _misses(self, logarithms: Float[np.ndarray, "parts"]) -> Float[np.ndarray, "priors"]:
        """Return the differences from the priors' means in their standard deviations."""
        assert self._priors is not None
        return (self._priors.powers @ (0.5 * logarithms) - self._priors.means) / self._priors.stds


def _information(
    pairs: LinearPairs, variances: Float[np.ndarray, "parts"]
) -> Float[np.ndarray, "parts parts"]:
    """Return the expected information of the restricted likelihood on log standard deviations.

    It is 2 s_k s_l tr(P V_k P V_l) for the variances s and P = W - W J C J' W, with W the inverse
    covariance of the errors, J their change by the unknowns and C the covariance of these.
    """
    W = np.linalg.inv(np.einsum("k,kvij->vij", variances, pairs.parts))
    C, WJ = pairs.inverse(variances), pairs.information(variances).swapaxes(1, 2)
    WV = W @ (variances[:, None, None, None] * pairs.parts)
    J_WV, WV_WJ = pairs.by_unknowns.swapaxes(1, 2) @ WV, WV @ WJ
    explained = C @ (J_WV @ WJ).sum(axis=1)
    trace = np.einsum("kvij,lvji->kl", WV, WV)
    trace -= 2.0 * np.tensordot(C @ J_WV, WV_WJ, axes=((1, 2, 3), (1, 3, 2)))
    return 2.0 * (trace + np.einsum("kpq,lqp->kl", explained, explained))
