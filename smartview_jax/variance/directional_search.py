"""Estimate in which directions the poses that a robot reports err most.

A SCARA arm errs along its axes but hardly tilts, an arm with one worn gear errs along the motion of
that joint, and a lift errs along z. One standard deviation of translations and one of rotations
describe such a robot badly: the estimate wastes the good directions, and its intervals are wrong.
Here the covariance S of a pose's error at the tool is one 6 x 6 matrix in the axes of the tool or
of the base,

    S = D exp(H) D,    D = diag(sigma_t, sigma_t, sigma_t, sigma_r, sigma_r, sigma_r)

with a symmetric H, whose traces are zero for translation and for rotation; H = 0 is a robot that
errs alike in all directions. The hypotheses are H = 0, and a diagonal or a full H in either frame.
The entries of H maximise the same restricted likelihood as the standard deviations, times a normal
prior; Laplace's method gives the evidence of each hypothesis, and the covariances are averaged by
their probabilities, like all models of the robot's error.

Reference: Leonard and Hsu, Bayesian inference for a covariance matrix, 1992 (the normal prior of
the logarithm of a covariance matrix).
"""

import dataclasses
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ..engine import twist_rotations
from .directional_noise import DirectionalNoise, Matrices, mean_sizes, pose_sigmas
from .likelihood import Marginalisation, marginalise
from .linearised_views import LinearisedViews
from .standard_deviations import ROBOT_SIGMA_FLOOR, StandardDeviations

Frame = Literal["tool", "base"]
"""The frame whose axes the errors follow."""


@dataclasses.dataclass(frozen=True)
class DirectionalPrior:
    """The prior of the directions of a robot's errors, before any view is seen.

    Attributes:
        axis_geometric_std: exp of the standard deviation of the logarithm of an axis' standard
            deviation about the mean over the axes (`RobotPrior.directional_geometric_std`).
        level_geometric_std: the same for these means, about the standard deviations that were found
            for equal errors (`RobotPrior.geometric_std`).
        probability: probability that a robot errs more in some directions than in others.
        max_scoring_steps: largest number of steps of a search.
        tolerance: increase of the log-posterior that a further step predicts, below which a search
            ends.
        min_probability: probability below which a hypothesis is left out.
        max_equal_probability: probability of equal errors from which on errors are taken as equal:
            an average with less probable hypotheses differs little, and takes longer to fit.
    """

    axis_geometric_std: float = float(np.exp(0.5))
    level_geometric_std: float = float(np.e)
    probability: float = 1.0 / 3.0
    max_scoring_steps: int = 50
    tolerance: float = 1e-3
    min_probability: float = 0.1
    max_equal_probability: float = 0.5


class Hypothesis(NamedTuple):
    """A family of covariances of the errors of poses.

    Attributes:
        name: what the hypothesis is called.
        frame: the frame whose axes the errors follow.
        basis: basis of the matrices H, orthonormal in Frobenius' norm.
    """

    name: str
    frame: Frame
    basis: Float[np.ndarray, "directions 6 6"]


class FittedHypothesis(NamedTuple):
    """A hypothesis with the covariance that maximises its posterior.

    Attributes:
        log_evidence: logarithm of its evidence, relative to equal errors in all directions.
        covariance: covariance of the error of every view's pose, translation (m) first.
        slopes: derivative of these by every entry of H, in the basis of the hypothesis.
        uncertainty: covariance of the entries.
    """

    log_evidence: float
    covariance: Matrices
    slopes: Float[np.ndarray, "directions views 6 6"]
    uncertainty: Float[np.ndarray, "directions directions"]


EQUAL = "equal"
"""The name of the hypothesis that poses err alike in all directions."""


def hypotheses() -> tuple[Hypothesis, ...]:
    """Return all hypotheses on the directions of the errors, but for equal ones."""
    axes, full = _axis_basis(), np.concatenate([_axis_basis(), _mixed_basis()])
    frames: tuple[Frame, ...] = ("base", "tool")
    return tuple(
        Hypothesis(f"{frame} {name}", frame, basis)
        for frame in frames
        for name, basis in (("axes", axes), ("ellipsoid", full))
    )


def _axis_basis() -> Float[np.ndarray, "directions 6 6"]:
    """Return the diagonal matrices that leave the means of translation and rotation."""
    contrasts = np.array([[1.0, -1.0, 0.0], [1.0, 1.0, -2.0]]) / np.sqrt([[2.0], [6.0]])
    diagonals = np.kron(np.eye(2), contrasts)
    return diagonals[:, :, None] * np.eye(6)


def _mixed_basis() -> Float[np.ndarray, "directions 6 6"]:
    """Return the symmetric matrices with two equal entries off the diagonal."""
    rows, columns = np.triu_indices(6, 1)
    basis = np.zeros((len(rows), 6, 6))
    basis[range(len(rows)), rows, columns] = np.sqrt(0.5)
    return basis + basis.swapaxes(1, 2)


def estimate_directions(
    views: LinearisedViews,
    sigmas: StandardDeviations,
    tool_from_base: Float[np.ndarray, "views 3 3"],
    prior: DirectionalPrior | None = None,
) -> DirectionalNoise | None:
    """Estimate the directions of a robot's errors; None if they are alike in all directions.

    Args:
        views: the views, linearised; their own parameters are twists at the tool.
        sigmas: standard deviations of all errors, for errors alike in all directions.
        tool_from_base: rotation from the robot's base to its tool in every view.
        prior: what is known of the directions.
    """
    prior = prior or DirectionalPrior()
    free = np.asarray(views.per_view_free)
    unseen = np.all(~free, axis=1)
    if not (free.all(axis=1) | unseen).all():
        return None
    # A state that no camera saw tells nothing, whether its correction is held or not.
    views = views._replace(per_view_free=free | unseen[:, None])
    held = np.append(np.asarray(sigmas.field) <= 10.0 * ROBOT_SIGMA_FLOOR, False)
    views = views.with_held((views.group_index >= 0) & held[views.group_index])
    candidates = hypotheses()
    log_odds = np.log(prior.probability / (1.0 - prior.probability) / len(candidates))
    equal = _fit_equal(views, sigmas, prior)
    fitted = {EQUAL: equal.fitted(0.0)}
    for candidate in candidates:
        search = _Search.of(candidate, views, sigmas, tool_from_base, prior)
        start = search.at(np.pad(equal.x, (0, len(candidate.basis))))
        # A quadratic at equal errors tells whether the search is worth its time.
        promise = start.promised_evidence(equal) + log_odds
        if promise < np.log(prior.min_probability):
            continue
        best = search.maximise(start)
        fitted[candidate.name] = best.fitted(best.log_evidence - equal.log_evidence + log_odds)
    return _averaged(fitted, prior)


def _averaged(
    fitted: dict[str, FittedHypothesis], prior: DirectionalPrior
) -> DirectionalNoise | None:
    """Return the average of hypotheses by their probabilities; None if errors are likely equal."""
    logs = np.array([each.log_evidence for each in fitted.values()])
    weights = np.exp(logs - logs.max())
    weights = np.where(weights / weights.sum() < prior.min_probability, 0.0, weights)
    probabilities = {
        name: float(weight) for name, weight in zip(fitted, weights / weights.sum(), strict=True)
    }
    probabilities = {name: p for name, p in probabilities.items() if p > 0.0}
    if probabilities.get(EQUAL, 0.0) >= prior.max_equal_probability:
        return None
    kept = {name: fitted[name] for name in probabilities}
    covariance = sum(
        (p * kept[name].covariance for name, p in probabilities.items()),
        np.zeros_like(fitted[EQUAL].covariance),
    )
    translation, rotation = mean_sizes(covariance)
    units = np.repeat([translation, rotation], 3)
    relative = covariance / np.outer(units, units)
    roots = np.linalg.cholesky(relative) * (units[:, None] / units)
    sizes = [len(each.slopes) for each in kept.values()]
    uncertainty, stops = np.zeros((sum(sizes), sum(sizes))), np.cumsum(sizes)
    for each, size, stop in zip(kept.values(), sizes, stops, strict=True):
        uncertainty[stop - size : stop, stop - size : stop] = each.uncertainty
    return DirectionalNoise(
        float(translation),
        float(rotation),
        roots,
        probabilities,
        {name: each.covariance for name, each in kept.items()},
        np.concatenate([p * kept[name].slopes for name, p in probabilities.items()]),
        uncertainty,
    )


class _Point(NamedTuple):
    """The posterior of a hypothesis at some levels and entries of H.

    Attributes:
        search: the search.
        x: logarithms of the levels of translation and rotation, and entries of H.
        value: negative logarithm of the posterior.
        gradient, information: its gradient, and the expected Hessian.
        by_entry: change of the covariance by each coordinate, between its inverse roots.
        roots: root of the covariance of every view.
    """

    search: "_Search"
    x: Float[np.ndarray, "coordinates"]
    value: float
    gradient: Float[np.ndarray, "coordinates"]
    information: Float[np.ndarray, "coordinates coordinates"]
    by_entry: Float[np.ndarray, "coordinates 6 6"]
    roots: Matrices

    @property
    def log_evidence(self) -> float:
        """The logarithm of the evidence by Laplace's method; all hypotheses have two levels."""
        entries = len(self.x) - 2
        return float(
            -self.value
            - 0.5 * np.linalg.slogdet(self.information)[1]
            + 0.5 * entries * np.log(self.search.precision)
        )

    def promised_evidence(self, equal: "_Point") -> float:
        """Return the logarithm of the evidence that a quadratic here promises."""
        gain = 0.5 * self.gradient @ np.linalg.solve(self.information, self.gradient)
        return float(gain + self.log_evidence - equal.log_evidence)

    def fitted(self, log_evidence: float) -> FittedHypothesis:
        """Return the hypothesis with the covariances at this point."""
        roots, transposed = self.roots, self.roots.swapaxes(1, 2)
        slopes = roots[None] @ self.by_entry[2:, None] @ transposed[None]
        uncertainty = np.linalg.inv(self.information)[2:, 2:]
        return FittedHypothesis(log_evidence, roots @ transposed, slopes, uncertainty)


class _Search(NamedTuple):
    """The search for the covariance that maximises the posterior of a hypothesis.

    Attributes:
        views: the views, with own parameters in the hypothesis' frame.
        sigmas: standard deviations of all errors.
        basis: as in `Hypothesis`.
        rotations: twists at the tool by twists in the frame.
        precision: prior precision of the entries of H.
        options: when the search ends.
    """

    views: LinearisedViews
    sigmas: StandardDeviations
    basis: Float[np.ndarray, "directions 6 6"]
    rotations: Matrices
    precision: float
    options: DirectionalPrior

    @property
    def level_precision(self) -> float:
        """The prior precision of the logarithms of both levels, about where they are."""
        return float(np.log(self.options.level_geometric_std) ** -2)

    @classmethod
    def of(
        cls,
        hypothesis: Hypothesis,
        views: LinearisedViews,
        sigmas: StandardDeviations,
        tool_from_base: Float[np.ndarray, "views 3 3"],
        prior: DirectionalPrior,
    ) -> "_Search":
        """Return the search for a hypothesis."""
        rotations = np.tile(np.eye(6), (len(tool_from_base), 1, 1))
        if hypothesis.frame == "base":
            rotations = twist_rotations(tool_from_base)
        # H is the logarithm of variances, twice the logarithm of standard deviations.
        precision = (2.0 * np.log(prior.axis_geometric_std)) ** -2
        return cls(
            views.in_own_axes(rotations), sigmas, hypothesis.basis, rotations, precision, prior
        )

    def at(self, x: Float[np.ndarray, "coordinates"]) -> _Point:
        """Evaluate the posterior."""
        units = np.repeat(pose_sigmas(self.sigmas) * np.exp(x[:2]), 3)
        values, vectors = np.linalg.eigh(np.tensordot(x[2:], self.basis, axes=1))
        root = (vectors * np.exp(0.5 * values)) @ vectors.T
        inverse_root = (vectors * np.exp(-0.5 * values)) @ vectors.T
        own_root = units[:, None] * root
        roots = np.broadcast_to(own_root, self.rotations.shape)
        whitened = self.views.in_own_axes(roots)
        marginal = marginalise(
            whitened, self.sigmas._replace(translation=np.array(1.0), rotation=np.array(1.0))
        )
        # With S = R R' the covariance and c = R w: dD = tr(A sum_v (1 - E[w w'])), where
        # A = R^-1 dS R'^-1, which is exp(-H/2) d exp(H) exp(-H/2) for a change of H, and
        # exp(-H/2) (dL exp(H) + exp(H) dL) exp(-H/2) for a change dL of the logarithm of D.
        half = 0.5 * (values[:, None] - values)
        factors = np.where(np.abs(half) > 1e-6, np.sinh(half) / np.where(half, half, 1.0), 1.0)
        by_entry = vectors @ ((vectors.T @ self.basis @ vectors) * factors) @ vectors.T
        levels = np.repeat(np.eye(2), 3, axis=1)[:, :, None] * np.eye(6)
        by_level = inverse_root @ levels @ root
        by_entry = np.concatenate([by_level + by_level.swapaxes(1, 2), by_entry])
        w = whitened.offset_from_prior.per_view + marginal.step.per_view
        excess = len(w) * np.eye(6) - w.T @ w - marginal.per_view_covariance.sum(axis=0)
        gradient = 0.5 * np.tensordot(by_entry, excess, axes=2)
        # The levels have a prior too, or one that the views hardly tell would decide the evidence.
        precisions = np.where(np.arange(len(x)) < 2, self.level_precision, self.precision)
        gradient += precisions * x
        value = 0.5 * float(marginal.deviance) + 0.5 * float(precisions @ x**2)
        information = _information(marginal, by_entry)
        information += np.diag(precisions)
        return _Point(self, x, value, gradient, information, by_entry, self.rotations @ own_root)

    def maximise(self, start: _Point) -> _Point:
        """Return the maximum of the posterior, by damped Fisher scoring."""
        best, damping = start, 1e-3
        for _ in range(self.options.max_scoring_steps):
            scale = np.diag(best.information) * damping
            step = -np.linalg.solve(best.information + np.diag(scale), best.gradient)
            predicted = -float(step @ (best.gradient + 0.5 * best.information @ step))
            # Entries change by at most a factor of e^2 of a variance in a step.
            step *= min(1.0, 2.0 / max(np.abs(step).max(), 1e-300))
            trial = self.at(best.x + step)
            if trial.value < best.value:
                best, damping = trial, max(0.2 * damping, 1e-6)
            else:
                damping *= 6.0
            if predicted < self.options.tolerance or damping > 1e8:
                break
        return best


def _fit_equal(
    views: LinearisedViews, sigmas: StandardDeviations, prior: DirectionalPrior
) -> _Point:
    """Return the maximum for errors alike in all directions."""
    equal = Hypothesis(EQUAL, "tool", np.zeros((0, 6, 6)))
    rotations = np.tile(np.eye(3), (len(views.per_view_free), 1, 1))
    search = _Search.of(equal, views, sigmas, rotations, prior)
    return search.maximise(search.at(np.zeros(2)))


def _information(
    marginal: Marginalisation, by_entry: Float[np.ndarray, "coordinates 6 6"]
) -> Float[np.ndarray, "coordinates coordinates"]:
    """Return the Fisher information of the coordinates of the covariance.

    It is tr(P A_k P A_l) / 2 over all pairs of views, with A_k the changes of the whitened
    covariance, and P one minus the posterior covariance of the whitened parameters.
    """
    views = len(marginal.gain)
    whitened_gain = marginal.gain @ marginal.shared_whitening.T
    reduction = np.eye(6) - marginal.per_view_covariance
    common = whitened_gain @ whitened_gain.swapaxes(1, 2)
    # tr(P A P B) is a quadratic form in the entries of A and B.
    flat = [blocks.reshape(views, 36) for blocks in (reduction, common)]
    form = flat[0].T @ flat[0] - flat[1].T @ flat[1]
    # F_ijkl = sum_v P_ij P_kl, and tr(P A P B) = P_ij A_jk P_kl B_li.
    partial = np.tensordot(by_entry, form.reshape(6, 6, 6, 6), axes=((1, 2), (1, 2)))
    same_view = np.tensordot(partial, by_entry, axes=((1, 2), (2, 1)))
    shared = whitened_gain.shape[2]
    rows = whitened_gain.transpose(1, 2, 0).reshape(6 * shared, views)
    products = (rows @ rows.T).reshape(6, shared, 6, shared).transpose(0, 2, 1, 3)
    by_shared = by_entry.reshape(len(by_entry), 36) @ products.reshape(36, shared * shared)
    return 0.5 * (same_view + by_shared @ by_shared.T)
