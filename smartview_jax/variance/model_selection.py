"""Compare models of the robot error on a set of views, and average them by their probability.

Every model is a set of groups of a common basis, so that all are compared on the same statistics.
The standard deviations of a model's errors maximise their posterior; the integral of the posterior
about the maximum, by Laplace's method, is the evidence of the model,

    log Z = -D / 2 - log det(I / 2 pi) / 2 - sum_k log(s_k sqrt(2 pi))

with `D` the deviance including the prior, `I` the information matrix of the logarithms of the
standard deviations and `s_k` the standard deviations of their priors. Evidence times prior
probability is the weight of a model. Few views often cannot decide between models, so none is
selected: the variances of the fit's priors are weighted averages of the models' variances (zero for
a model without the group).

Reference: Hoeting, Madigan, Raftery and Volinsky, Bayesian model averaging: a tutorial, 1999.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations
from types import MappingProxyType
from typing import NamedTuple

import jax
import numpy as np
from jaxlie import SE3
from jaxtyping import Bool

from ..calibration import TargetShape
from ..dataset import Dataset, Rig
from ..engine import TARGET_SCALE, is_size
from ..robot_errors import (
    COMMON_ERROR,
    AbstractField,
    CombinedField,
    ElasticDHErrors,
    FieldChoice,
    GenericSixAxisArm,
    LinearInPose,
    RobotPrior,
    SmoothInPose,
    field_name,
)
from .fisher_scoring import LikelihoodMaximum, StandardDeviationPrior, maximise_each
from .linearised_views import LinearisedViews
from .standard_deviations import StandardDeviations

MIN_GENERIC_ARM_VIEWS = 10
"""Smallest number of views for which an arm of unknown geometry is a candidate.

With fewer views, its guessed proportions fit almost anything: in one of ten sets of eight simulated
views of a robot with white noise alone, the error was twice as large with it; and with random sets
of six views of koide_charuco 20231006, an arm with seven joints, 2 to 3 times as large. From the
same number on, errors that are quadratic in the position are candidates.
"""

WHITE_NOISE_ODDS, SMALLEST_FIELD_ODDS, LARGER_FIELD_ODDS, GENERIC_ARM_ODDS = np.exp(
    [3.0, 0.0, -3.0, 1.0]
)
"""Prior odds of the models of the robot error: white noise alone, and with it a field.

The smallest field is linear in position, or for a known arm the zeros of its joints; each of those
that contain it has the odds of a larger one. The last is an arm of unknown geometry.

An unneeded error model costs more than missing a small error. At odds of 7 instead of 20 for white
noise, errors with five and six simulated views without a smooth error were 2 to 6 % larger than
with white noise alone; for arms with errors the evidence outweighs either odds many times over. The
errors of an arm are in its joints, so the arm is more probable than an error linear in the pose,
which a few views cannot constrain.
"""

PIXEL_SIGMA_PRIOR_RATE = 0.7
"""Rate of the exponential prior of log(effective pixel sigma / white pixel sigma).

The two agree where the model is true; on real data sets they differ by up to a factor of ten.
"""

TARGET_SHAPE = "target_shape"
"""First part of the names of the parameters of the target's shape."""

SHAPE_GROUPS = ("target_bow", "target_print")
"""Groups of the parameters of the target's shape: out of its plane, and within it."""

TARGET_GROUPS = (*SHAPE_GROUPS, TARGET_SCALE)
"""Groups of the target's parameters; they come after the groups of the robot's error."""

MIN_WEAK_ROBOT_EXCESS = 2.0
"""Standard deviations above the median of the good robot's prior at which a robot may be weak."""

MAX_COMBINED_SIZES = 3
"""Number of targets up to which each combination of wrong sizes is a model of its own.

Of more targets, none, one or all are tried: each combination costs as much as all models of the
robot error.
"""

MIN_MODEL_PROBABILITY = 0.01
"""Probability below which a model is left out of the average."""

WHITE_NOISE = "white"
"""The name of the model without a robot error field."""


class ModelName(NamedTuple):
    """The name of a model: its robot error field, and the targets' sizes that it estimates."""

    field: str
    free_sizes: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Return the name as results show it."""
        return f"{self.field} with {', '.join(self.free_sizes)}" if self.free_sizes else self.field


class FittedCandidate(NamedTuple):
    """A model of the robot error with the standard deviations that maximise its posterior.

    Attributes:
        active: mask of the fitted standard deviations: translation, rotation, groups of the basis.
        maximum: the result of the maximisation.
        log_weight: logarithm of evidence times prior odds.
    """

    active: Bool[np.ndarray, "robot"]
    maximum: LikelihoodMaximum
    log_weight: float


class Candidate(NamedTuple):
    """A model of the robot error to be tried.

    Attributes:
        groups: the groups of the basis that belong to the model.
        log_odds: logarithm of its prior odds.
    """

    groups: frozenset[str]
    log_odds: float


def encompassing_field(data: Dataset | Rig, view_count: int) -> AbstractField:
    """Return the basis that contains all error models to be tried on a data set.

    Args:
        data: data set, with an arm if the joints are known.
        view_count: number of views with enough points to determine their pose.
    """
    # With a known arm no generic arm is needed.
    if data.arm is not None:
        return ElasticDHErrors(data.arm)
    poses = readable_poses(data)
    if view_count < MIN_GENERIC_ARM_VIEWS:
        return LinearInPose.from_poses(poses)
    return CombinedField(SmoothInPose.from_poses(poses), GenericSixAxisArm.from_poses(poses))


def readable_poses(data: Dataset | Rig) -> SE3:
    """Return the reported poses without placeholders for unreadable ones."""
    masked = {view for view, _ in data.masked_views}
    is_readable = np.array([view not in masked for view in data.view_ids])
    return jax.tree.map(lambda numbers: np.asarray(numbers)[is_readable], data.base_from_tool)


def candidate_models(
    requested: FieldChoice,
    basis: AbstractField | None,
    model_odds: Mapping[str, float] = MappingProxyType({}),
) -> dict[str, Candidate]:
    """Return the models to be tried, by name.

    Args:
        requested: the requested field; `"auto"` for a choice, None for none.
        basis: field that contains all models.
        model_odds: prior odds by name, instead of the odds for any robot.
    """
    return {
        name: model._replace(log_odds=float(np.log(model_odds[name])))
        if name in model_odds
        else model
        for name, model in _models_of_any_robot(requested, basis).items()
    }


def _models_of_any_robot(
    requested: FieldChoice, basis: AbstractField | None
) -> dict[str, Candidate]:
    """Return the models to be tried on a robot of unknown type, by name."""
    white = {WHITE_NOISE: Candidate(frozenset(), float(np.log(WHITE_NOISE_ODDS)))}
    if basis is None:
        return white
    # The models describe how a robot deviates from its type.
    basis = basis.whole
    if requested != "auto":
        return white | {field_name(basis): Candidate(frozenset(basis.group_names), 0.0)}
    linear, arm = _split_basis(basis)
    odds = (SMALLEST_FIELD_ODDS, LARGER_FIELD_ODDS)
    nested = linear.nested_fields
    models = {
        field_name(part): Candidate(frozenset(part.group_names), float(np.log(odds[min(k, 1)])))
        for k, part in enumerate(nested)
    }
    if arm is not None:
        models[field_name(arm)] = Candidate(
            frozenset(arm.group_names), float(np.log(GENERIC_ARM_ODDS))
        )
    return white | models


def fit_candidates(
    views: LinearisedViews,
    models: Mapping[str, Candidate],
    groups: tuple[str, ...],
    initial: StandardDeviations,
    prior: StandardDeviationPrior,
    wrong_target_probability: float,
) -> dict[ModelName, FittedCandidate]:
    """Fit every model, and compute its weight; models without a finite weight are left out.

    Args:
        views: views linearised with the basis.
        models: result of `candidate_models`.
        groups: names of the basis' groups, in order, and last the targets' sizes that are tested.
        initial: standard deviations at which the searches begin.
        prior: prior of the standard deviations of all groups.
        wrong_target_probability: prior probability that the target does not have its stated size.
    """
    # Every model is a mask on the same statistics, so the views are linearised once.
    size_odds = wrong_target_probability / (1.0 - wrong_target_probability)
    names, log_odds, masks = [], [], []
    for free_sizes in _choices_of_sizes(groups):
        # The probability is zero only if no size is tested.
        size_log_odds = len(free_sizes) * np.log(size_odds) if free_sizes else 0.0
        for name, model in models.items():
            # The target's shape is in all models: its size is estimated, not selected. What a
            # type of robot has in common is in all models of its robots.
            model_groups = model.groups | {*SHAPE_GROUPS, COMMON_ERROR, *free_sizes}
            names.append(ModelName(name, free_sizes))
            log_odds.append(model.log_odds + size_log_odds)
            masks.append(np.array([True, True, *(group in model_groups for group in groups)]))
    fits = fit_good_or_weak_robot(views, initial, np.array(masks), prior)
    return {
        name: FittedCandidate(active, maximum, log_weight)
        for name, active, odds, (maximum, evidence) in zip(
            names, masks, log_odds, fits, strict=True
        )
        if np.isfinite(log_weight := float(evidence + odds))
    }


def _choices_of_sizes(groups: Sequence[str]) -> list[tuple[str, ...]]:
    """Return which targets' sizes to estimate: none, each combination, or all of many."""
    sizes = tuple(filter(is_size, groups))
    counts = range(len(sizes) + 1)
    if len(sizes) > MAX_COMBINED_SIZES:
        counts = (0, 1, len(sizes))
    return [chosen for count in counts for chosen in combinations(sizes, count)]


def fit_good_or_weak_robot(
    views: LinearisedViews,
    initial: StandardDeviations,
    active: Bool[np.ndarray, "models robot"],
    prior: StandardDeviationPrior,
) -> list[tuple[LikelihoodMaximum, float]]:
    """Fit models for a good and for a weak robot.

    Args:
        views: the linearised views.
        initial: standard deviations at which the searches begin.
        active: mask of the standard deviations that each model fits.
        prior: prior of the standard deviations.

    Returns:
        The better maximum of each model, and the logarithm of the evidence of both together.
    """
    fits = [
        (good, log_evidence(good, mask, prior))
        for good, mask in zip(maximise_each(views, initial, active, prior), active, strict=True)
    ]
    # With the noise of a good robot, a weak one need not be considered.
    noise = np.array([good.sigmas.vector[1:3] for good, _ in fits])
    log_excess = np.log(noise / prior.median[:2]) / prior.log_std[:2]
    may_be_weak = np.flatnonzero(log_excess.max(axis=1) > MIN_WEAK_ROBOT_EXCESS)
    if prior.weak_probability == 0.0 or not len(may_be_weak):
        return fits
    of_weak = prior.of_weak_robot
    # From the good robot's noise the search can end in a local maximum with wrong positions only
    # and a hundredfold pixel noise, so it starts at the typical noise of weak robots.
    start = initial._replace(
        translation=np.asarray(of_weak.median[0]), rotation=np.asarray(of_weak.median[1])
    )
    log_odds = np.log(prior.weak_probability / (1.0 - prior.weak_probability))
    weak_fits = maximise_each(views, start, active[may_be_weak], of_weak)
    for k, weak in zip(may_be_weak, weak_fits, strict=True):
        good, good_evidence = fits[k]
        weak_evidence = log_evidence(weak, active[k], of_weak) + log_odds
        if np.isfinite(weak_evidence):
            both = float(np.logaddexp(good_evidence, weak_evidence))
            fits[k] = (weak if weak_evidence > good_evidence else good), both
    return fits


def log_evidence(
    maximum: LikelihoodMaximum, active: Bool[np.ndarray, "robot"], prior: StandardDeviationPrior
) -> float:
    """Compute the logarithm of a model's evidence by Laplace's method, up to a common constant."""
    # log Z = -D / 2 - log det(I / 2 pi) / 2 - sum_k log(s_k sqrt(2 pi)); the pixel sigma has no
    # such s_k, since its prior is exponential and the same for all models.
    is_fitted = np.concatenate([[True], active])
    information = maximum.information[np.ix_(is_fitted, is_fitted)] / (2.0 * np.pi)
    if not np.isfinite(information).all():
        return -np.inf
    prior_widths = np.sqrt(2.0 * np.pi) * prior.log_std[active]
    logarithm = np.linalg.slogdet(information)[1]
    return float(-0.5 * maximum.deviance - 0.5 * logarithm - np.sum(np.log(prior_widths)))


def posterior_probabilities(
    fitted: Mapping[ModelName, FittedCandidate],
) -> dict[ModelName, float]:
    """Return the probabilities of the models, which add up to one."""
    # The largest logarithm is subtracted first: evidences themselves would underflow.
    logs = np.array([candidate.log_weight for candidate in fitted.values()])
    weights = np.exp(logs - logs.max())
    return dict(zip(fitted, map(float, weights / weights.sum()), strict=True))


def drop_negligible(probabilities: Mapping[ModelName, float]) -> dict[ModelName, float]:
    """Return the probabilities without negligible ones, normalised to one again."""
    large = {
        name: probability
        for name, probability in probabilities.items()
        if probability >= MIN_MODEL_PROBABILITY
    }
    total = sum(large.values())
    return {name: weight / total for name, weight in large.items()}


def average_standard_deviations(
    fitted: Mapping[ModelName, FittedCandidate], probabilities: Mapping[ModelName, float]
) -> StandardDeviations:
    """Return standard deviations whose squares are weighted averages of the models' variances."""
    # Variances add up over models, standard deviations do not.
    sigma_vectors = [fitted[name].maximum.sigmas.vector for name in probabilities]
    model_weights = np.array(list(probabilities.values()))
    return StandardDeviations.from_vector(np.sqrt(model_weights @ np.square(sigma_vectors)))


def smallest_sufficient_field(
    basis: AbstractField | None, models: Mapping[str, Candidate], names: set[str]
) -> AbstractField | None:
    """Return the smallest part of the basis that contains the models; None for white noise."""
    groups = frozenset().union(*(models[name].groups for name in names))
    if basis is None or not (groups or basis.is_about_type):
        return None
    linear, arm = _split_basis(basis)
    if arm is None or groups.isdisjoint(arm.group_names):
        return next(part for part in linear.nested_fields if groups.issubset(part.group_names))
    linear_groups = groups.difference(arm.group_names)
    if not linear_groups:
        return arm
    return CombinedField(
        next(part for part in linear.nested_fields if linear_groups.issubset(part.group_names)), arm
    )


def standard_deviation_prior(
    prior: RobotPrior,
    field: AbstractField | None,
    group_names: Sequence[str],
    shape: TargetShape | None = None,
    has_white_noise: bool = True,
) -> StandardDeviationPrior:
    """Return the prior of the standard deviations of reported poses and of some groups.

    Args:
        prior: prior of the robot's errors.
        field: field that has the groups.
        group_names: names of the groups, with the targets' sizes last if they are among them.
        shape: shape of the target, if it has groups; they come before the scale.
        has_white_noise: whether the effective pixel sigma is hardly larger than the white one;
            otherwise nothing is known of it.
    """
    field_names = () if field is None else field.group_names
    indices = [0, 1, *(2 + field_names.index(name) for name in group_names if name in field_names)]
    median, log_std = prior.medians(field)[indices], np.asarray(prior.log_stds(field))[indices]
    if shape is not None:
        relative = np.array([prior.target_bow_median, prior.target_print_median])
        median = np.append(median, float(shape.half_size) * relative)
        log_std = np.append(log_std, np.full(2, np.log(prior.target_geometric_std)))
    # The standard deviation of a size is known, not estimated: a log-normal prior with a negligible
    # spread holds it.
    sizes = sum(map(is_size, group_names))
    median = np.append(median, np.full(sizes, prior.wrong_target_scale_std))
    log_std = np.append(log_std, np.full(sizes, 0.01))
    return StandardDeviationPrior(
        median,
        log_std,
        PIXEL_SIGMA_PRIOR_RATE if has_white_noise else 0.0,
        prior.weak_robot_probability,
        (prior.weak_translation_median, prior.weak_rotation_median),
    )


def initial_standard_deviations(
    prior: StandardDeviationPrior, pixel_sigma: float
) -> StandardDeviations:
    """Return the prior's medians with an effective pixel sigma."""
    return StandardDeviations.from_vector(np.concatenate([[pixel_sigma], prior.median]))


def _split_basis(basis: AbstractField) -> tuple[AbstractField, AbstractField | None]:
    """Return a basis without the arm of unknown geometry, and that arm or None."""
    if isinstance(basis, CombinedField):
        return basis.first, basis.second
    return basis, None
