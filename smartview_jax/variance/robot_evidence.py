"""Provide the evidence of one robot's views on the sizes of its errors, apart from any prior."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration import TargetShape
from ..robot_errors import AbstractField, RobotPrior
from ..runtime.blas_threads import on_one_blas_thread
from .likelihood import LinearisedViews
from .model_selection import (
    SHAPE_GROUPS,
    TARGET_GROUPS,
    Candidate,
    fit_good_or_weak_robot,
    initial_standard_deviations,
    standard_deviation_prior,
)


class SizesOfErrors(NamedTuple):
    """The likelihood of the sizes of a robot's errors, approximated by a Gaussian near its peak.

    The sizes are the logarithms x of the standard deviations of translation, rotation and each
    group of a model. Up to a constant the log-likelihood is `vector @ x - x @ information @ x / 2`.

    Attributes:
        information: its information matrix; zero in directions that the views do not determine.
        vector: information times most likely sizes.
        log_evidence: logarithm of the evidence of the model, up to a constant that all models of
            the same views have in common.
    """

    information: Float[np.ndarray, "sizes sizes"]
    vector: Float[np.ndarray, "sizes"]
    log_evidence: float


class RobotEvidence(NamedTuple):
    """The views of one robot as the comparison of error models saw them.

    Attributes:
        views: the views, linearised.
        group_names: names of their groups of parameters.
        models: the models of the robot error by name, with their odds for any robot.
        basis: field that contains all models.
        shape: shape of the target; None if it is held as stated.
        initial_sigma, has_white_noise: as in `ViewStatistics`.
    """

    views: LinearisedViews
    group_names: tuple[str, ...]
    models: Mapping[str, Candidate]
    basis: AbstractField | None
    shape: TargetShape | None
    initial_sigma: float
    has_white_noise: bool

    def groups(self, model: str) -> tuple[str, ...]:
        """Return the names of the groups of a model, in the order of `sizes`."""
        return tuple(name for name in self.group_names if name in self.models[model].groups)

    @on_one_blas_thread
    def sizes(self, model: str, prior: RobotPrior) -> SizesOfErrors:
        """Return the likelihood of the sizes of the errors, near the peak of their posterior.

        Args:
            model: name of the model.
            prior: prior of the sizes, which the likelihood does not contain.
        """
        deviations = standard_deviation_prior(
            prior, self.basis, self.group_names, self.shape, self.has_white_noise
        )
        groups = self.groups(model)
        active_names = {*groups, *SHAPE_GROUPS}
        active = np.array([True, True, *(name in active_names for name in self.group_names)])
        initial = initial_standard_deviations(deviations, self.initial_sigma)
        fits = fit_good_or_weak_robot(self.views, initial, active[None], deviations)
        maximum, evidence = fits[0]

        # Pixel noise and the target's shape differ between data sets: they are integrated out, by
        # the Schur complement of the information that includes their priors.
        is_robot = np.array([name not in TARGET_GROUPS for name in self.group_names], dtype=bool)
        is_fitted = np.concatenate([[True], active])
        robot = np.flatnonzero(is_fitted & np.concatenate([[False, True, True], is_robot]))
        other = np.flatnonzero(is_fitted & np.concatenate([[True, False, False], ~is_robot]))
        precision = np.pad(deviations.log_std**-2, (1, 0))
        information = np.asarray(maximum.information)
        to_robot = np.linalg.solve(information[np.ix_(other, other)], information[other][:, robot])
        marginal = information[np.ix_(robot, robot)] - information[robot][:, other] @ to_robot
        marginal = marginal - np.diag(precision[robot])
        # The likelihood's gradient at the peak of the posterior cancels the prior's.
        log_sizes = np.log(maximum.sigmas.vector[robot])
        offset = log_sizes - np.log(np.append(1.0, deviations.median)[robot])
        gradient = precision[robot] * offset
        # Rounding can make it indefinite where the views determine nothing.
        values, vectors = np.linalg.eigh(marginal)
        marginal = (vectors * np.maximum(values, 0.0)) @ vectors.T
        units = np.log(self._units(groups))
        return SizesOfErrors(marginal, marginal @ (log_sizes - units) + gradient, float(evidence))

    def _units(self, groups: tuple[str, ...]) -> Float[np.ndarray, "sizes"]:
        """Return the standard deviations of coefficients per unit of `RobotPrior.group_medians`."""
        if self.basis is None:
            return np.ones(2)
        # A prior of ones shows the factors by which the field multiplies.
        names = [name for name, _ in self.basis.groups]
        ones = RobotPrior(1.0, 1.0, dict.fromkeys(names, 1.0)).medians(self.basis)
        return ones[[0, 1, *(2 + names.index(name) for name in groups)]]
