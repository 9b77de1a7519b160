"""Compare models of the robot error on a set of views, and average them by their probability.

Every model is a set of groups of one basis that contains them all, so that all are compared on the
same statistics by the same program. The standard deviations of a model's errors are those that
maximise their posterior; the integral of the posterior about the maximum, by Laplace's method, is
the evidence of the model,

    log Z = -D / 2 - log det(I / 2 pi) / 2 - sum_k log(s_k sqrt(2 pi))

with `D` the deviance including the prior, `I` the information matrix of the logarithms of the sizes
and `s_k` the standard deviations of their priors. Evidence times prior probability is the weight of
a model. Few views often cannot decide between models, so none is selected: the fit uses the priors
of the weighted average, whose variances are the averages of the models' own (a model without a
group counts as zero there).

Reference: Hoeting, Madigan, Raftery and Volinsky, Bayesian model averaging: a tutorial, 1999.
"""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Bool

from ..compilation import optimised
from ..dataset import Dataset
from ..robot_errors import (
    AbstractField,
    CombinedField,
    DHErrors,
    ImpliedArm,
    LinearInPose,
    RobotPrior,
    field_name,
)
from .likelihood import LinearisedViews, Sizes
from .scoring import Likeliest, SizePrior, likeliest

MINIMUM_RELIABLE_VIEWS = 8
"""Number of views below which no figure of a calibration is reliable."""

ARM_VIEWS = 10
"""Smallest number of views for which an arm of unknown geometry is a candidate.

With fewer views, its guessed proportions fit almost anything: in one of ten sets of eight simulated
views of a robot with white noise alone, the result was twice as far off with it; and random sets of
six views of koide_charuco 20231006, an arm with seven joints, are wrong by 2 to 3 times as much.
"""

WHITE, POSITION, POSE, ARM = np.exp([3.0, 0.0, -3.0, 1.0])
"""Prior odds of the models of the robot error.

WHITE is white noise alone; in addition to it, POSITION has an error linear in position, POSE one
linear in the pose, and ARM that of an arm of unknown geometry.

An error model that is not needed costs more than a small error that is missed. At odds of 7 instead
of 20 for white noise, sets of five and six simulated views without a smooth error were 2 to 6 %
farther off than with white noise alone; for arms that do have errors the evidence outweighs either
odds many times over. The errors of an arm are in its joints, so that the arm is more probable than
an error linear in the pose, which a few views cannot constrain.
"""

PIXEL_RATE = 0.7
"""Rate of the exponential prior of log(effective pixel sigma / white pixel sigma).

The two agree where the model is true; on real data sets they differ by up to a factor of ten.
"""

NEGLIGIBLE = 0.01
"""Probability below which a model is left out of the average."""

SCALE = "target_scale"
"""Name of the target's scale, both as a parameter and as a group."""


class Tried(NamedTuple):
    """A model of the robot error with the standard deviations that maximise its posterior.

    Attributes:
        active: mask of the fitted standard deviations: translation, rotation, groups of the basis.
        found: the result of the maximisation.
        log_weight: logarithm of evidence times prior odds.
        scaled: whether the target's scale is free.
    """

    active: Bool[np.ndarray, "robot"]
    found: Likeliest
    log_weight: float
    scaled: bool


class Candidate(NamedTuple):
    """A model of the robot error to be tried.

    Attributes:
        groups: the groups of the basis that belong to the model.
        log_odds: logarithm of its prior odds.
    """

    groups: frozenset[str]
    log_odds: float


def largest_field(data: Dataset, views: int) -> AbstractField:
    """Return the basis that contains all error models to be tried on a data set.

    Args:
        data: data set, with an arm if the joints are known.
        views: number of views with enough points to determine their pose.
    """
    if data.arm is not None:
        return DHErrors(data.arm)
    poses = read_poses(data)
    linear = LinearInPose.over(poses)
    return CombinedField(linear, ImpliedArm.over(poses)) if views >= ARM_VIEWS else linear


def read_poses(data: Dataset) -> SE3:
    """Return the reported poses without placeholders for unreadable ones."""
    masked = {view for view, _ in data.masked_views}
    read = np.array([view not in masked for view in data.view_ids])
    return SE3(data.base_from_tool.wxyz_xyz[read])


def candidates(
    asked: AbstractField | Literal[False] | None, basis: AbstractField | None
) -> dict[str, Candidate]:
    """Return the models to be tried, by name.

    Args:
        asked: field that the user asked for: None for a choice, False for none.
        basis: field that contains all models.
    """
    white = {"white": Candidate(frozenset(), float(np.log(WHITE)))}
    if basis is None:
        return white
    if asked is not None:
        return white | {field_name(basis): Candidate(_groups(basis), 0.0)}
    linear, arm = _parts(basis)
    odds = (POSITION, POSE)
    nested = linear.nested
    found = {
        field_name(part): Candidate(_groups(part), float(np.log(odds[min(k, 1)])))
        for k, part in enumerate(nested)
    }
    if arm is not None:
        found[field_name(arm)] = Candidate(_groups(arm), float(np.log(ARM)))
    return white | found


def try_all(
    views: LinearisedViews,
    models: Mapping[str, Candidate],
    groups: tuple[str, ...],
    guess: Sizes,
    prior: SizePrior,
    wrong_target: float,
) -> dict[str, Tried]:
    """Fit every model, and compute its weight; models without a finite weight are left out.

    Args:
        views: views linearised with the basis.
        models: result of `candidates`.
        groups: names of the basis' groups, in order, and `SCALE` last where the target's scale is a
            parameter.
        guess: sizes at which the searches begin.
        prior: prior of the sizes of all groups.
        wrong_target: prior probability that the target does not have its stated size.
    """
    tried: dict[str, Tried] = {}
    for scaled in (False, True) if SCALE in groups else (False,):
        odds = np.log(wrong_target / (1.0 - wrong_target)) if scaled else 0.0
        for name, model in models.items():
            chosen = model.groups | ({SCALE} if scaled else set())
            active = np.array([True, True, *(group in chosen for group in groups)])
            found = search(views, guess, jnp.asarray(active), prior)
            weight = float(log_evidence(found, active, prior) + model.log_odds + odds)
            if np.isfinite(weight):
                known = f"{name}, {SCALE}" if scaled else name
                tried[known] = Tried(active, found, weight, scaled)
    return tried


def log_evidence(found: Likeliest, active: Bool[np.ndarray, "robot"], prior: SizePrior) -> float:
    """Compute the logarithm of a model's evidence by Laplace's method, up to a common constant."""
    # log Z = -D / 2 - log det(I / 2 pi) / 2 - sum_k log(s_k sqrt(2 pi)); the pixel sigma has no
    # such s_k, since its prior is exponential and the same for all models.
    kinds = np.concatenate([[True], active])
    information = np.asarray(found.information)[np.ix_(kinds, kinds)] / (2.0 * np.pi)
    if not np.isfinite(information).all():
        return -np.inf
    widths = np.sqrt(2.0 * np.pi) * np.asarray(prior.spread)[active]
    logarithm = np.linalg.slogdet(information)[1]
    return float(-0.5 * found.deviance - 0.5 * logarithm - np.sum(np.log(widths)))


def probabilities(tried: Mapping[str, Tried]) -> dict[str, float]:
    """Return the probabilities of the models, which add up to one."""
    # The largest logarithm is subtracted first: evidences themselves would underflow.
    logs = np.array([one.log_weight for one in tried.values()])
    weights = np.exp(logs - logs.max())
    return dict(zip(tried, map(float, weights / weights.sum()), strict=True))


def kept(weights: Mapping[str, float]) -> dict[str, float]:
    """Return the probabilities without negligible ones, normalised to one again."""
    large = {name: weight for name, weight in weights.items() if weight >= NEGLIGIBLE}
    whole = sum(large.values())
    return {name: weight / whole for name, weight in large.items()}


def averaged(tried: Mapping[str, Tried], weights: Mapping[str, float]) -> Sizes:
    """Return the sizes whose variances are the weighted averages of the models' variances."""
    numbers = [np.asarray(tried[name].found.sizes.numbers) for name in weights]
    shares = np.array(list(weights.values()))
    return Sizes.of(jnp.asarray(np.sqrt(shares @ np.square(numbers))))


def field_of(
    basis: AbstractField | None, models: Mapping[str, Candidate], names: set[str]
) -> AbstractField | None:
    """Return the smallest part of the basis that contains the models; None for white noise."""
    groups = frozenset().union(*(models[name].groups for name in names))
    if basis is None or not groups:
        return None
    linear, arm = _parts(basis)
    if arm is None or not groups & _groups(arm):
        return next(part for part in linear.nested if groups <= _groups(part))
    rest = groups - _groups(arm)
    if not rest:
        return arm
    return CombinedField(next(part for part in linear.nested if rest <= _groups(part)), arm)


def size_prior(prior: RobotPrior, field: AbstractField | None, with_scale: bool) -> SizePrior:
    """Return the prior of the sizes of a field's groups, and of the target's scale if free."""
    median, spread = prior.medians(field), np.asarray(prior.spreads(field))
    if with_scale:
        # The standard deviation of the scale is known, not estimated: a log-normal prior with a
        # negligible spread holds it.
        median, spread = np.append(median, prior.wrong_target_std), np.append(spread, 0.01)
    return SizePrior(jnp.asarray(median), jnp.asarray(spread), jnp.asarray(PIXEL_RATE))


def first_guess(prior: SizePrior, white_sigma: float) -> Sizes:
    """Return the prior's medians, and an effective pixel sigma a little above the white one."""
    return Sizes.of(jnp.concatenate([jnp.asarray([1.1 * white_sigma]), prior.median]))


def _parts(basis: AbstractField) -> tuple[AbstractField, AbstractField | None]:
    """Return a basis without the arm of unknown geometry, and that arm or None."""
    if isinstance(basis, CombinedField):
        return basis.first, basis.second
    return basis, None


def _groups(field: AbstractField) -> frozenset[str]:
    """Return the names of a field's groups."""
    return frozenset(name for name, _ in field.groups)


search = optimised(likeliest)
