"""Estimate what robots of one type have in common: some errors, and the sizes of the rest.

Robots of one type have some errors in common (`type_mean`). Each robot deviates from these by
errors of its own, whose sizes differ little between the robots. The logarithms x of the standard
deviations of robot i (pose noise, and each group of an error field) are Gaussian about the type's:

    x_i ~ N(mu, T),  mu ~ N(m, S)

with m and S from the prior for any robot, and T, one spread of the pose noise and one of the
field's groups, by maximum likelihood with x and mu integrated out. Each robot's views contribute
their likelihood, approximated by a Gaussian at the peak of its posterior (`SizesOfErrors`). This
posterior uses the prior of the type, so estimates and approximations are repeated in turn. The next
robot then needs fewer views, because its errors are weighted like its type's. A robot's deviations
are measured from the common errors that the other robots tell: if it took part in their mean, the
deviations of few robots would look too small.

A robot may be of another type. Its evidence under the type's prior is compared with the evidence
under the prior for any robot, and its weight in the estimates is the probability that it belongs.

Reference: Efron, Large-scale inference: empirical Bayes methods for estimation, testing and
prediction, 2010.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from ..argument_checks import require_instance
from ..joint import JointFit
from ..robot_errors import RobotPrior, arm_parameters
from ..runtime.blas_threads import on_one_blas_thread
from ..runtime.modules import fields_of
from ..variance import RobotEvidence, SizesOfErrors
from .type_mean import CommonErrorsOfType

MAX_ROUNDS = 10
"""Largest number of estimates, each with the robots' likelihoods approximated at the last one."""

SIZE_TOLERANCE = 0.05
"""Relative change of every size of errors below which the estimates have converged."""

SMALLEST_SPREAD = 0.01
"""Smallest spread of the logarithms within a type that is tried, a percent: no robot's views tell
the size of an error so well."""

SHARE_STEPS = 100
"""Number of steps of expectation maximisation for the shares of kinds of robots.

A step takes microseconds, and far fewer suffice where robots can be told apart.
"""

MINIMUM_FITS = 2
"""Smallest number of robots that have something in common."""


@dataclasses.dataclass(frozen=True)
class FleetPrior(RobotPrior):
    """The prior for the next robot of a type, as `robot_prior` of `calibrate` and `fit_joint`.

    Attributes:
        model: name of the model of the robot error that describes the type best.
        membership: probability of each fit that its robot is of this type.
    """

    model: str = "white"
    membership: tuple[float, ...] = ()

    def __str__(self) -> str:
        """Return the type's errors as text: how large, and what all its robots have in common."""
        medians = {"translation": self.translation_median, "rotation": self.rotation_median}
        medians |= self.group_medians
        lines = [f"robots of one type, with errors {self.model!r} (m, rad)"]
        lines += [
            f"  {name}: {medians.get(name, self.other_group_median):.2g}, x/ {geometric_std:.2f}"
            for name, geometric_std in self.geometric_std_by_name.items()
        ]
        common = {} if self.common_errors is None else self.common_errors.mean_and_std
        lines += [
            f"  in common {name}: {mean:.2g} +- {std:.1g}"
            for name, (mean, std) in common.items()
            if abs(mean) > std
        ]
        return "\n".join(lines)

    @property
    def outsiders(self) -> tuple[int, ...]:
        """The numbers of the fits whose robots are probably of another type."""
        return tuple(k for k, probability in enumerate(self.membership) if probability < 0.5)


def fleet_prior(fits: Iterable[JointFit], general: RobotPrior | None = None) -> FleetPrior:
    """Estimate the prior of the errors of one type of robot from fits of several of them.

    The prior of a fit does not matter, only what its views say. The errors that all robots have in
    common are estimated if all were fitted with joint readings of the same nominal arm.

    Args:
        fits: fits with estimated noise, for instance by `calibrate_many`; robots of another type
            among them are recognised (`FleetPrior.outsiders`) and left out.
        general: prior for a robot of any type; few robots change it little. Errors in common, if
            it is the prior of a type, are not used.

    Raises:
        TypeError: a fit that is no `JointFit`.
        ValueError: fewer than two fits, a fit with given noise, or fits whose models of the robot
            error differ, as with and without joint readings.

    For example:

        >>> noisy = {"translation_noise": 1e-4, "rotation_noise": 2e-4}
        >>> robots = [sv.simulation.random_scene(k, 8, points, **noisy).data for k in range(3)]
        >>> fits = (sv.calibrate(robot, "radial").joint for robot in robots)
        >>> print(f"{1e3 * sv.fleet_prior(fits).translation_median:.3f} mm")  # doctest: +SKIP
        0.072 mm
    """
    general = dataclasses.replace(general or RobotPrior(), common_errors=None)
    evidence = [_evidence_of(k, fit) for k, fit in enumerate(fits)]
    if len(evidence) < MINIMUM_FITS:
        raise ValueError(f"fleet_prior: expected at least two fits, found {len(evidence)}")
    return _prior_of_type(evidence, general)


@on_one_blas_thread
def _prior_of_type(evidence: Sequence[RobotEvidence], general: RobotPrior) -> FleetPrior:
    """Return the prior of `fleet_prior` from what each robot's views say."""
    models = _common_models(evidence)
    any_robot = np.array([_evidence_of_any_robot(robot, models, general) for robot in evidence])
    prior, common, best, members = _likeliest_type(evidence, models, any_robot, general)
    # The next robot has one prior for all models.
    sizes = {model: _sizes_of_all(evidence, model, prior, common) for model in models}
    logs = np.array([[entry.log_evidence for entry in of_model] for of_model in sizes.values()])
    shares, _ = _shares(logs, members)
    of_type = np.logaddexp.reduce(logs + np.log(shares)[:, None], axis=0)
    members = _shares(np.stack([of_type, any_robot]))[1][0]
    values = fields_of(prior, RobotPrior)
    values["model_odds"] = dict(zip(models, map(float, shares), strict=True))
    common = _common_errors(evidence, best, sizes[best], members, general)
    values["common_errors"] = None if common is None else common.told_by_all
    return FleetPrior(**values, model=best, membership=tuple(map(float, members)))


def _likeliest_type(
    evidence: Sequence[RobotEvidence],
    models: Sequence[str],
    any_robot: Float[np.ndarray, "robots"],
    general: RobotPrior,
) -> tuple[RobotPrior, CommonErrorsOfType | None, str, Float[np.ndarray, "robots"]]:
    """Estimate sizes and common errors of a type in each model, and which robots belong, in turn.

    Return prior and common errors of the best model, its name, and the weight of each robot.
    """
    members = np.ones(len(evidence))
    priors, best = dict.fromkeys(models, general), models[0]
    common: dict[str, CommonErrorsOfType | None] = dict.fromkeys(models)
    for k in range(MAX_ROUNDS):
        sizes = {
            model: _sizes_of_all(evidence, model, priors[model], common[model]) for model in models
        }
        logs = {model: np.array([entry.log_evidence for entry in sizes[model]]) for model in models}
        best = max(models, key=lambda model: float(logs[model] @ members))
        # In the first round the prior of the type is still the general one.
        members = (
            _shares(np.stack([logs[best], any_robot]))[1][0]
            if k > 0
            else _most_alike(sizes[best], *_sizes_of_any_robot(evidence[0].groups(best), general))
        )
        last = priors[best]
        for model in models:
            groups = evidence[0].groups(model)
            estimate = _prior_of(sizes[model], members, groups, general)
            priors[model] = estimate if k == 0 else _halfway(priors[model], estimate)
            # At first, deviations contain the errors in common. Unless the sizes are limited, the
            # deviations explain these errors, which are then never found.
            common[model] = _common_errors(
                evidence, model, sizes[model], members, general, limits_sizes=k == 0
            )
        if k > 0 and _relative_change(last, priors[best]) < SIZE_TOLERANCE:
            break
    return _with_other_groups(priors, best, evidence[0]), common[best], best, members


def _with_other_groups(
    priors: Mapping[str, RobotPrior], best: str, robot: RobotEvidence
) -> RobotPrior:
    """Return the best model's prior, with each other group's size as the smallest model has it.

    With the sizes of any robot's errors in these groups, a robot of any type would belong.
    """
    prior, known = priors[best], {*robot.groups(best)}
    medians, stds = dict(prior.group_medians), dict(prior.geometric_std_by_name)
    for model, of_model in priors.items():
        for group in {*robot.groups(model)} - known:
            medians[group] = of_model.group_medians[group]
            stds[group] = of_model.geometric_std_by_name[group]
        known |= {*robot.groups(model)}
    return dataclasses.replace(prior, group_medians=medians, geometric_std_by_name=stds)


def _halfway(first: RobotPrior, second: RobotPrior) -> RobotPrior:
    """Return the prior between two, by geometric means.

    Whole steps would go to and fro about the sizes that the views hardly determine: their
    likelihoods are far from Gaussian, and look different from either side.
    """

    def mean(value: float, other: float) -> float:
        return float(np.sqrt(value * other))

    stds = first.geometric_std_by_name
    return dataclasses.replace(
        second,
        translation_median=mean(first.translation_median, second.translation_median),
        rotation_median=mean(first.rotation_median, second.rotation_median),
        group_medians={
            name: mean(first.group_medians[name], value)
            for name, value in second.group_medians.items()
        },
        geometric_std_by_name={
            name: mean(stds.get(name, value), value)
            for name, value in second.geometric_std_by_name.items()
        },
    )


def _relative_change(first: RobotPrior, second: RobotPrior) -> float:
    """Return the largest relative change of a median size from one prior to another."""
    medians = np.array(
        [
            (prior.translation_median, prior.rotation_median, *prior.group_medians.values())
            for prior in (first, second)
        ]
    )
    return float(np.abs(medians[1] / medians[0] - 1.0).max())


def _evidence_of(number: int, fit: JointFit) -> RobotEvidence:
    """Return what the views of a fit say about the sizes of its robot's errors."""
    require_instance(f"fits[{number}]", fit, JointFit, "calibrate(...).joint is one")
    estimate = fit.noise_estimate
    if estimate is None or estimate.robot_evidence is None:
        raise ValueError(
            f"fits[{number}]: expected a fit with noise='estimated', which tells the sizes of the "
            "robot's errors"
        )
    return estimate.robot_evidence


def _common_models(evidence: Sequence[RobotEvidence]) -> list[str]:
    """Return the names of the models that all fits compared."""
    for k, robot in enumerate(evidence):
        if [*robot.models] != [*evidence[0].models]:
            raise ValueError(
                f"fits[{k}]: its models of the robot error are {', '.join(robot.models)}, but "
                f"{', '.join(evidence[0].models)} in fits[0]; fit all with or without joint "
                "readings, or with the same field="
            )
    return [*evidence[0].models]


def _evidence_of_any_robot(
    robot: RobotEvidence, models: Sequence[str], general: RobotPrior
) -> float:
    """Return the logarithm of the evidence under the prior for any robot, over all models."""
    log_odds = np.array([robot.models[model].log_odds for model in models])
    logs = np.array([robot.sizes(model, general).log_evidence for model in models])
    return float(np.logaddexp.reduce(logs + log_odds) - np.logaddexp.reduce(log_odds))


def _sizes_of_all(
    evidence: Sequence[RobotEvidence],
    model: str,
    prior: RobotPrior,
    common: CommonErrorsOfType | None,
) -> list[SizesOfErrors]:
    """Return every robot's likelihood of the sizes of its errors, about the others' mean."""
    # A robot with much larger noise than its type's is of another type.
    of_type = dataclasses.replace(prior, weak_robot_probability=0.0, common_errors=None)
    priors = [
        of_type
        if common is None
        else dataclasses.replace(of_type, common_errors=common.told_by_others(k))
        for k in range(len(evidence))
    ]
    return [robot.sizes(model, prior) for robot, prior in zip(evidence, priors, strict=True)]


def _common_errors(
    evidence: Sequence[RobotEvidence],
    model: str,
    sizes: Sequence[SizesOfErrors],
    members: Float[np.ndarray, "robots"],
    general: RobotPrior,
    limits_sizes: bool = False,
) -> CommonErrorsOfType | None:
    """Return the errors that robots have in common; None if these are not of one nominal arm.

    With limited sizes, deviations of single robots count at most as any robot's median.
    """
    fields = [robot.arm_errors for robot in evidence]
    arms = {None if field is None else arm_parameters(field.arm) for field in fields}
    field = fields[0]
    if field is None or len(arms) > 1:
        return None
    robots = [
        robot.errors(entry.sigmas, model, general)
        for robot, entry in zip(evidence, sizes, strict=True)
        if entry.sigmas is not None
    ]
    if limits_sizes:
        medians = general.medians(field)[2:] ** 2
        limits = np.repeat(medians, [size for _, size in field.groups])
        robots = [robot._replace(variance=np.minimum(robot.variance, limits)) for robot in robots]
    return CommonErrorsOfType.of(field, robots, members, general)


def _shares(
    logs: Float[np.ndarray, "kinds robots"], weights: Float[np.ndarray, "robots"] | None = None
) -> tuple[Float[np.ndarray, "kinds"], Float[np.ndarray, "kinds robots"]]:
    """Estimate the shares of kinds of robots, and the probability of each kind for each robot.

    The logarithms are of each robot's evidence for each kind; without weights all count alike.
    """
    weights = np.ones(logs.shape[1]) if weights is None else weights
    shares = np.full(len(logs), 1.0 / len(logs))
    probabilities = np.zeros_like(logs)
    for _ in range(SHARE_STEPS):
        joint = logs + np.log(shares)[:, None]
        probabilities = np.exp(joint - np.logaddexp.reduce(joint, axis=0))
        # Half a robot of each kind beforehand (Jeffreys' prior): no share becomes zero.
        counts = probabilities @ weights + 0.5
        shares = counts / counts.sum()
    return shares, probabilities


def _prior_of(
    sizes: Sequence[SizesOfErrors],
    members: Float[np.ndarray, "robots"],
    groups: Sequence[str],
    general: RobotPrior,
) -> RobotPrior:
    """Return the prior of a type from its robots' likelihoods, weighted by membership."""
    names = ["translation", "rotation", *groups]
    mean, log_std = _common_sizes(sizes, members, *_sizes_of_any_robot(groups, general))
    medians = dict(zip(names, map(float, np.exp(mean)), strict=True))
    stds = dict(zip(names, map(float, np.exp(log_std)), strict=True))
    return dataclasses.replace(
        general,
        translation_median=medians["translation"],
        rotation_median=medians["rotation"],
        group_medians={**general.group_medians, **{name: medians[name] for name in groups}},
        geometric_std_by_name={**general.geometric_std_by_name, **stds},
    )


def _sizes_of_any_robot(
    groups: Sequence[str], general: RobotPrior
) -> tuple[Float[np.ndarray, "sizes"], Float[np.ndarray, "sizes"]]:
    """Return mean and standard deviation of the logarithms of the sizes of any robot's errors."""
    medians = [general.translation_median, general.rotation_median]
    medians += [general.group_medians.get(name, general.other_group_median) for name in groups]
    names = ["translation", "rotation", *groups]
    return np.log(medians), np.log([general.geometric_std_of(name) for name in names])


def _most_alike(
    sizes: Sequence[SizesOfErrors],
    general_mean: Float[np.ndarray, "sizes"],
    general_std: Float[np.ndarray, "sizes"],
) -> Float[np.ndarray, "robots"]:
    """Return one for the half of the robots that are nearest to the median, zero for the others.

    From an estimate of all robots, others among them would widen the type until they belong to it.
    """
    precision = np.diag(general_std**-2)
    estimates = np.array(
        [
            np.linalg.solve(robot.information + precision, robot.vector + precision @ general_mean)
            for robot in sizes
        ]
    )
    distances = np.sum(((estimates - np.median(estimates, axis=0)) / general_std) ** 2, axis=1)
    return (distances <= np.median(distances)).astype(float)


def _common_sizes(
    sizes: Sequence[SizesOfErrors],
    members: Float[np.ndarray, "robots"],
    general_mean: Float[np.ndarray, "sizes"],
    general_std: Float[np.ndarray, "sizes"],
) -> tuple[Float[np.ndarray, "sizes"], Float[np.ndarray, "sizes"]]:
    """Return mean and standard deviation of the logarithms of the sizes of the next robot."""
    information = np.stack([robot.information for robot in sizes])
    vector = np.stack([robot.vector for robot in sizes])
    count = len(general_mean)
    is_pose = np.arange(count) < 2

    def estimate(log_spreads: Float[np.ndarray, "2"]) -> tuple[float, np.ndarray, np.ndarray]:
        """Return minus the log-likelihood of the spreads, and mu with its precision."""
        # With I the information and h the vector of a robot, and the variances T, integration
        # over x leaves, for the robot, mu g - mu W mu / 2 + h S h / 2 - log det(1 + T I) / 2 with
        #     W = I (1 + T I)^-1,  g = (1 + I T)^-1 h,  S = T (1 + I T)^-1
        variance = np.where(is_pose, *np.exp(2.0 * log_spreads))
        inverse = np.linalg.inv(np.eye(count) + information * variance)
        g = (inverse @ vector[..., None])[..., 0]
        precision = np.einsum("r,rij->ij", members, inverse @ information) + np.diag(
            general_std**-2
        )
        eta = members @ g + general_mean / general_std**2
        mean = np.linalg.solve(precision, eta)
        logarithms = 0.5 * np.linalg.slogdet(inverse)[1] + 0.5 * np.sum(vector * variance * g, 1)
        value = members @ logarithms + 0.5 * eta @ mean - 0.5 * np.linalg.slogdet(precision)[1]
        return -float(value), mean, precision

    # Within a type the sizes do not spread more than over all types.
    bounds = [
        (np.log(SMALLEST_SPREAD), np.log(general_std[chosen].max())) if chosen.any() else (0.0, 0.0)
        for chosen in (is_pose, ~is_pose)
    ]
    start = [np.mean(bound) for bound in bounds]
    optimum = minimize(lambda x: estimate(x)[0], start, method="L-BFGS-B", bounds=bounds)
    _, mean, precision = estimate(optimum.x)
    variance = np.where(is_pose, *np.exp(2.0 * optimum.x))
    return mean, np.sqrt(variance + np.diagonal(np.linalg.inv(precision)))
