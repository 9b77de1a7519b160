"""Average over models of the robot's error and of targets' sizes, and add their disagreement.

If the data do not decide between two models, the estimate lies between theirs, and its covariance
has to cover both. The covariance over all models is the average of the covariances within the
models plus the covariance between the models: the weighted squares of their distances from the
estimate.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from ..engine import is_size
from .directional_noise import DirectionalNoise
from .likelihood import marginalise
from .linearised_views import LinearisedViews
from .model_selection import FittedCandidate, ModelName, average_standard_deviations
from .standard_deviations import ROBOT_SIGMA_FLOOR, StandardDeviations


def averaged_models(
    views: LinearisedViews,
    groups: tuple[str, ...],
    fitted: Mapping[ModelName, FittedCandidate],
    probabilities: Mapping[ModelName, float],
) -> StandardDeviations:
    """Return the standard deviations of the averaged model.

    A target's size is estimated in some models, and as stated in the others. Its prior standard
    deviation is chosen so that the most probable size is the models' average.

    Args:
        views: the linearised views.
        groups: names of the groups, with the targets' sizes last if they are parameters.
        fitted: the models.
        probabilities: their probabilities.
    """
    sigmas = average_standard_deviations(fitted, probabilities)
    possible = {
        group: sum(p for model, p in probabilities.items() if size in model.free_sizes)
        for group, size in enumerate(groups)
        if is_size(size)
    }
    for group, probability in possible.items():
        prior_std = ROBOT_SIGMA_FLOOR if probability == 0.0 else _prior_std(fitted, group)
        sigmas = _with_group(sigmas, group, prior_std)
    undecided = {group: p for group, p in possible.items() if 0.0 < p < 1.0}
    if not undecided:
        return sigmas
    # Data alone give the logarithm x +- s; the stated size has the logarithm 0. With a prior 0 +- t
    # the mode is x t^2 / (s^2 + t^2), which is the average p x for t^2 = s^2 p / (1 - p).
    variances = marginalise(views, sigmas).shared_covariance.diagonal()
    for group, probability in undecided.items():
        variance = float(variances[views.group_index == group][0])
        precision = (1.0 - probability) / (probability * variance) + _prior_std(fitted, group) ** -2
        sigmas = _with_group(sigmas, group, precision**-0.5)
    return sigmas


def between_models_covariance(
    views: LinearisedViews,
    fitted: Mapping[ModelName, FittedCandidate],
    probabilities: Mapping[ModelName, float],
    averaged: StandardDeviations,
) -> Float[np.ndarray, "shared shared"]:
    """Return the covariance of the parameters between the models, about the averaged estimate.

    Args:
        views: the linearised views.
        fitted: the models.
        probabilities: their probabilities.
        averaged: result of `averaged_models`.
    """
    estimate = marginalise(views, averaged).step.shared
    if not probabilities:
        return np.zeros((len(estimate), len(estimate)))
    differences = np.array(
        [marginalise(views, fitted[name].maximum.sigmas).step.shared for name in probabilities]
    )
    differences = differences - estimate
    weights = np.array(list(probabilities.values()))
    return differences.T @ (weights[:, None] * differences)


def between_directions_covariance(
    views: LinearisedViews, directions: DirectionalNoise, averaged: StandardDeviations
) -> Float[np.ndarray, "shared shared"]:
    """Return the covariance of the parameters between hypotheses on the directions of errors.

    Args:
        views: the linearised views, along the axes of the averaged directions.
        directions: the hypotheses.
        averaged: result of `averaged_models`.
    """
    estimate = marginalise(views, averaged).step.shared
    unit = np.array(1.0)
    of_hypothesis = averaged._replace(translation=unit, rotation=unit)
    to_own = np.linalg.inv(directions.roots)
    result = np.zeros((len(estimate), len(estimate)))
    for name, probability in directions.probabilities.items():
        roots = to_own @ np.linalg.cholesky(directions.covariances[name])
        whitened = views.in_own_axes(roots)
        difference = marginalise(whitened, of_hypothesis).step.shared - estimate
        result += probability * np.outer(difference, difference)
    return result


def _prior_std(fitted: Mapping[ModelName, FittedCandidate], group: int) -> float:
    """Return the prior standard deviation of the target's size in the models that estimate it."""
    return max(float(candidate.maximum.sigmas.field[group]) for candidate in fitted.values())


def _with_group(sigmas: StandardDeviations, group: int, value: float) -> StandardDeviations:
    """Return the standard deviations with a new value for one group."""
    field = np.array(sigmas.field)
    field[group] = value
    return sigmas._replace(field=field)
