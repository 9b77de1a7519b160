"""Estimate the errors that all robots of one type have in common, as where its drawings are wrong.

The coefficients c of robot i (zeros, link lengths, twists) are Gaussian about the type's mean m:

    c_i ~ N(m, V_i),  m ~ N(0, T)

with V_i the variances of the deviations of single robots, and T one variance of the mean for each
group of coefficients, by maximum likelihood with c and m integrated out. A group whose mean the
robots do not show gets a T of zero, and directions that no robot's views determine keep mean zero
and covariance T, so that the mean is believed as far as the fits tell.

Reference: Efron and Morris, Stein's estimation rule and its competitors: an empirical Bayes
approach, 1973.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize

from ..robot_errors import AbstractArmErrors, CommonErrors, RobotPrior, arm_parameters
from ..variance import ErrorsOfRobot

MEAN_BOUNDS = (1e-3, 1e3)
"""Smallest and largest standard deviation of means that is tried, in medians of any robot's."""

MEAN_STARTS = (0.03, 0.3, 3.0)
"""Standard deviations of means, in the same unit, at which the search for them begins."""

SMALLEST_MEAN = 0.02
"""Standard deviation of means, in the same unit, below which there is none: robots that hardly
deviate from each other would have one in every group, however small, and so the largest field."""

NEGLIGIBLE_SHARE, NEGLIGIBLE_SHARE_OF_OTHERS = 1e-2, 5e-2
"""Share of the variance of single robots below which a variance of the mean is left out: of all
robots' mean, and of the others' with which a robot is compared, to save time."""


class TypeMean(NamedTuple):
    """The mean of the errors of a type's robots, with what each robot contributes to it.

    All are in units of the errors' medians for any robot.

    Attributes:
        precision: information matrix of the mean, with its prior.
        vector: information matrix times mean.
        information_of_robots, vector_of_robots: the share of each robot in both.
        has_mean: mask of the coefficients that have a mean.
    """

    precision: Float[np.ndarray, "coefficients coefficients"]
    vector: Float[np.ndarray, "coefficients"]
    information_of_robots: Float[np.ndarray, "robots coefficients coefficients"]
    vector_of_robots: Float[np.ndarray, "robots coefficients"]
    has_mean: Bool[np.ndarray, "coefficients"]

    @classmethod
    def of(
        cls,
        robots: Sequence[ErrorsOfRobot],
        members: Float[np.ndarray, "robots"],
        medians: Float[np.ndarray, "coefficients"],
        group_index: Int[np.ndarray, "coefficients"],
    ) -> "TypeMean":
        """Estimate the mean from robots' likelihoods, in units of any robot's medians."""
        # With A a robot's information matrix, b its vector and V its variances, integration over c
        # leaves the information K = (1 + A V)^-1 A and the vector (1 + A V)^-1 b for m.
        by_units = np.outer(medians, medians)
        information = np.stack([robot.information * by_units for robot in robots])
        vector = np.stack([robot.vector * medians for robot in robots])
        variance = np.stack([robot.variance / medians**2 for robot in robots])
        inverse = np.linalg.inv(np.eye(len(medians)) + information * variance[:, None, :])
        information = members[:, None, None] * (inverse @ information)
        information = 0.5 * (information + information.swapaxes(1, 2))
        vector = members[:, None] * (inverse @ vector[..., None])[..., 0]
        stds = _likeliest_mean_stds(information.sum(0), vector.sum(0), group_index)[group_index]
        typical = members @ variance / max(float(members.sum()), 1.0)
        has_mean = stds**2 > np.maximum(NEGLIGIBLE_SHARE * typical, SMALLEST_MEAN**2)
        stds = np.where(has_mean, stds, MEAN_BOUNDS[0])
        precision = information.sum(0) + np.diag(stds**-2.0)
        return cls(precision, vector.sum(0), information, vector, has_mean)

    def without(self, robot: int) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n n"]]:
        """Return the mean and its covariance by all robots but one."""
        precision = self.precision - self.information_of_robots[robot]
        return _mean_and_covariance(precision, self.vector - self.vector_of_robots[robot])

    def of_all(self) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n n"]]:
        """Return the mean and its covariance by all robots."""
        return _mean_and_covariance(self.precision, self.vector)


class CommonErrorsOfType(NamedTuple):
    """The common errors as robots of a type learn them from each other.

    Attributes:
        field: the field whose coefficients they are.
        mean: the mean of the type, in units of `medians`.
        medians: median size of each coefficient for any robot.
        sizes: what single robots deviate from the mean, in the same unit.
    """

    field: AbstractArmErrors
    mean: TypeMean
    medians: Float[np.ndarray, "coefficients"]
    sizes: Float[np.ndarray, "coefficients"]

    @classmethod
    def of(
        cls,
        field: AbstractArmErrors,
        robots: Sequence[ErrorsOfRobot],
        members: Float[np.ndarray, "robots"],
        general: RobotPrior,
    ) -> "CommonErrorsOfType":
        """Estimate them from robots' likelihoods, weighted by membership."""
        counts = [size for _, size in field.groups]
        medians = np.repeat(general.medians(field)[2:], counts)
        group_index = np.repeat(np.arange(len(counts)), counts)
        mean = TypeMean.of(robots, members, medians, group_index)
        variance = members @ np.stack([robot.variance for robot in robots])
        sizes = np.sqrt(variance / max(float(members.sum()), 1e-9)) / medians
        return cls(field, mean, medians, sizes)

    def told_by_others(self, robot: int) -> CommonErrors | None:
        """Return the common errors that all robots but one tell."""
        return self._common_errors(*self.mean.without(robot), NEGLIGIBLE_SHARE_OF_OTHERS)

    @property
    def told_by_all(self) -> CommonErrors | None:
        """The common errors that all robots tell; None if they have none."""
        return self._common_errors(*self.mean.of_all(), NEGLIGIBLE_SHARE)

    def _common_errors(
        self,
        mean: Float[np.ndarray, "n"],
        covariance: Float[np.ndarray, "n n"],
        negligible_share: float,
    ) -> CommonErrors | None:
        """Return a mean and the parts of its covariance that matter next to single robots'."""
        has_mean = self.mean.has_mean
        if not has_mean.any():
            return None
        mean = np.where(has_mean, mean, 0.0)
        covariance = np.where(has_mean[:, None] & has_mean, covariance, 0.0)
        units = np.maximum(self.sizes, MEAN_BOUNDS[0])
        values, vectors = np.linalg.eigh(covariance / np.outer(units, units))
        kept = values > negligible_share
        root = units[:, None] * vectors[:, kept] * np.sqrt(values[kept])
        # At least one column: fields and files have arrays with entries.
        root = root if kept.any() else np.zeros((len(mean), 1))
        return CommonErrors(
            self.field.names,
            tuple(map(float, self.medians * mean)),
            tuple(tuple(map(float, row)) for row in self.medians[:, None] * root),
            arm_parameters(self.field.arm),
        )


def _mean_and_covariance(
    precision: Float[np.ndarray, "n n"], vector: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n n"]]:
    """Return the mean and the covariance of a Gaussian from its precision."""
    covariance = np.linalg.inv(precision)
    return covariance @ vector, 0.5 * (covariance + covariance.T)


def _likeliest_mean_stds(
    information: Float[np.ndarray, "n n"],
    vector: Float[np.ndarray, "n"],
    group_index: Int[np.ndarray, "n"],
) -> Float[np.ndarray, "groups"]:
    """Return the standard deviation of the mean in each group that makes all robots likeliest.

    The prior of each is half a Cauchy distribution with the scale of any robot's errors.
    """
    groups, identity = int(group_index.max()) + 1, np.eye(len(vector))

    def negative_log(log_stds: Float[np.ndarray, "groups"]) -> tuple[float, np.ndarray]:
        """Return minus the logarithm of the posterior density, and its slopes."""
        # With the information K of all robots and their vector k, integration over m leaves
        #     k m / 2 - log det(1 + K T) / 2,  m = T (1 + K T)^-1 k,
        # whose slope by log T_i is (m_i^2 + C_ii) / T_i / 2 - 1 / 2 with C = T (1 + K T)^-1.
        group_variance = np.exp(2.0 * log_stds)
        variance = group_variance[group_index]
        spread = identity + information * variance
        covariance = variance[:, None] * np.linalg.inv(spread)
        mean = covariance @ vector
        value = 0.5 * np.linalg.slogdet(spread)[1] - 0.5 * vector @ mean
        by_log_std = 1.0 - (mean**2 + np.diagonal(covariance)) / variance
        slopes = np.bincount(group_index, by_log_std, minlength=groups)
        slopes += 2.0 * group_variance / (1.0 + group_variance)
        return float(value + np.sum(np.log1p(group_variance))), slopes

    bounds = [tuple(np.log(MEAN_BOUNDS))] * groups
    searches = [
        minimize(
            negative_log, np.full(groups, np.log(std)), jac=True, method="L-BFGS-B", bounds=bounds
        )
        for std in MEAN_STARTS
    ]
    return np.exp(min(searches, key=lambda search: search.fun).x)
