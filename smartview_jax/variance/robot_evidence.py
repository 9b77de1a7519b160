"""Provide the evidence of one robot's views on its errors and their sizes, apart from any prior."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..calibration import TargetShape
from ..engine import ROBOT_ERROR
from ..robot_errors import (
    COMMON_ERROR,
    AbstractArmErrors,
    AbstractField,
    CommonErrors,
    ErrorsOfType,
    RobotPrior,
)
from ..runtime.blas_threads import on_one_blas_thread
from .likelihood import marginalise
from .linearised_views import LinearisedViews
from .model_selection import (
    SHAPE_GROUPS,
    TARGET_GROUPS,
    Candidate,
    fit_good_or_weak_robot,
    initial_standard_deviations,
    standard_deviation_prior,
)
from .standard_deviations import StandardDeviations
from .view_statistics import ViewStatistics

VAGUE_ERROR_FACTOR = 10.0
"""Standard deviations of errors, in medians of any robot's, about which a likelihood is computed.

The value hardly matters, since the prior is subtracted again.
"""


class SizesOfErrors(NamedTuple):
    """The likelihood of the sizes of a robot's errors, approximated by a Gaussian near its peak.

    The sizes are the logarithms x of the standard deviations of translation, rotation and each
    group of a model. Up to a constant the log-likelihood is `vector @ x - x @ information @ x / 2`.

    Attributes:
        information: its information matrix; zero in directions that the views do not determine.
        vector: information times most likely sizes.
        log_evidence: logarithm of the evidence of the model, up to a constant that all models of
            the same views have in common.
        sigmas: standard deviations of all errors at the peak.
    """

    information: Float[np.ndarray, "sizes sizes"]
    vector: Float[np.ndarray, "sizes"]
    log_evidence: float
    sigmas: StandardDeviations | None = None


class ErrorsOfRobot(NamedTuple):
    """The likelihood of the coefficients c of a robot's error field, for given sizes of its noise.

    Up to a constant the log-likelihood is `vector @ c - c @ information @ c / 2`.

    Attributes:
        information: its information matrix; zero in directions that the views do not determine.
        vector: information times most likely coefficients.
        variance: variance of each coefficient about its mean over robots, in the robot's model.
    """

    information: Float[np.ndarray, "coefficients coefficients"]
    vector: Float[np.ndarray, "coefficients"]
    variance: Float[np.ndarray, "coefficients"]


class RobotEvidence(NamedTuple):
    """The views of one robot as the comparison of error models saw them.

    Attributes:
        views: the views, linearised.
        names: names of their shared parameters.
        group_names: names of their groups of parameters.
        models: the models of the robot error by name, with their odds for any robot.
        basis: field that contains all models.
        shape: shape of the target; None if it is held as stated.
        initial_sigma, has_white_noise: as in `ViewStatistics`.
    """

    views: LinearisedViews
    names: tuple[str, ...]
    group_names: tuple[str, ...]
    models: Mapping[str, Candidate]
    basis: AbstractField | None
    shape: TargetShape | None
    initial_sigma: float
    has_white_noise: bool

    @classmethod
    def of(
        cls,
        views: LinearisedViews,
        names: Sequence[str],
        models: Mapping[str, Candidate],
        basis: AbstractField | None,
        statistics: ViewStatistics,
    ) -> "RobotEvidence":
        """Return the evidence of linearised views, whose errors may be about a type's mean.

        Args:
            views: the views, linearised.
            names: names of their shared parameters.
            models, basis: as in `RobotEvidence`.
            statistics: the statistics that were linearised.
        """
        group_names = statistics.group_names
        if isinstance(basis, ErrorsOfType):
            views, names = about_zero(views, names, basis)
            group_names = tuple(name for name in group_names if name != COMMON_ERROR)
            basis = basis.errors
        return cls(
            views,
            tuple(names),
            group_names,
            models,
            basis,
            statistics.shape,
            statistics.initial_sigma,
            statistics.has_white_noise,
        )

    @property
    def arm_errors(self) -> AbstractArmErrors | None:
        """The field of arm errors whose coefficients mean the same for all robots of a type."""
        if not isinstance(self.basis, AbstractArmErrors):
            return None
        known = {f"{ROBOT_ERROR}.{name}" for name in self.basis.names}
        return self.basis if known <= {*self.names} else None

    def about(self, common: CommonErrors | None) -> LinearisedViews:
        """Return the views with the prior means of the errors of a type."""
        if common is None or self.arm_errors is None:
            return self.views
        indices = _indices(self.names, common.names)
        return self.views.about_common(indices, np.array(common.mean), np.array(common.root))

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
        fits = fit_good_or_weak_robot(
            self.about(prior.common_errors), initial, active[None], deviations
        )
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
        return SizesOfErrors(
            marginal, marginal @ (log_sizes - units) + gradient, float(evidence), maximum.sigmas
        )

    @on_one_blas_thread
    def errors(self, sigmas: StandardDeviations, model: str, general: RobotPrior) -> ErrorsOfRobot:
        """Return the likelihood of the robot's errors, for given sizes of all errors.

        Args:
            sigmas: the sizes, as in `SizesOfErrors`.
            model: name of the model that has them; the errors of its robots in other groups are
                the mean over robots.
            general: prior for any robot.
        """
        errors = self.arm_errors
        assert errors is not None
        vague = VAGUE_ERROR_FACTOR * general.medians(errors)[2:]
        names = errors.group_names
        places = [self.group_names.index(name) for name in names]
        field = np.array(sigmas.field, dtype=float)
        own = np.where([name in self.groups(model) for name in names], field[places], 0.0)
        field[places] = vague
        marginal = marginalise(self.views, sigmas._replace(field=field))
        indices = _indices(self.names, errors.names)
        # (A + W)^-1 is the posterior's covariance for the likelihood's information A, and the
        # vague prior's W.
        information = np.linalg.inv(marginal.shared_covariance[np.ix_(indices, indices)])
        coefficients = self.views.offset_from_prior.shared + marginal.step.shared
        vector = information @ coefficients[indices]
        sizes = [size for _, size in errors.groups]
        information = information - np.diag(np.repeat(vague**-2.0, sizes))
        return ErrorsOfRobot(information, vector, np.repeat(own**2, sizes))

    def _units(self, groups: tuple[str, ...]) -> Float[np.ndarray, "sizes"]:
        """Return the standard deviations of coefficients per unit of `RobotPrior.group_medians`."""
        if self.basis is None:
            return np.ones(2)
        # A prior of ones shows the factors by which the field multiplies.
        names = self.basis.group_names
        ones = RobotPrior(1.0, 1.0, dict.fromkeys(names, 1.0)).medians(self.basis)
        return ones[[0, 1, *(2 + names.index(name) for name in groups)]]


def about_zero(
    views: LinearisedViews, names: Sequence[str], field: ErrorsOfType
) -> tuple[LinearisedViews, tuple[str, ...]]:
    """Return views with the whole errors of an arm, and the names of their shared parameters.

    Errors that the fit holds are none of the parameters.

    Args:
        views: views with what the arm deviates from its type.
        names: names of their shared parameters.
        field: the field about the type.
    """
    place = {name: k for k, name in enumerate(names)}
    places = [place.get(f"{ROBOT_ERROR}.{name}", -1) for name in field.names]
    whole, common = np.split(np.array(places, dtype=int), [field.errors.size])
    mean, root = np.asarray(field.mean), np.asarray(field.root)
    is_free, uncertain = whole >= 0, common >= 0
    views = views.without_common(
        whole[is_free], common[uncertain], mean[is_free], root[np.ix_(is_free, uncertain)]
    )
    return views, tuple(name for k, name in enumerate(names) if k not in common)


def _indices(names: Sequence[str], coefficients: Sequence[str]) -> Int[np.ndarray, "coefficients"]:
    """Return the indices of an error field's coefficients among the names of parameters."""
    return np.array([names.index(f"{ROBOT_ERROR}.{name}") for name in coefficients], dtype=int)
