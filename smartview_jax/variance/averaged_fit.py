"""Fit the average of several error models, alternating with the standard deviations."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration import TargetShape
from ..engine import (
    ROBOT_ERROR,
    AbstractBuiltProblem,
    JointProblem,
    Noise,
    RigProblem,
    Step,
    is_size,
    solve,
)
from ..geometry import host_matrices
from ..robot_errors import AbstractField, RobotPrior
from ..runtime.blas_threads import on_one_blas_thread
from .directional_noise import DirectionalNoise
from .fisher_information import fisher_information
from .fisher_scoring import LikelihoodMaximum, StandardDeviationPrior
from .kenward_roger import SmallSampleCorrection, small_sample_correction
from .likelihood import marginalise, posterior_mode_step
from .linearised_views import LinearisedViews, kinds_of
from .model_average import averaged_models, between_directions_covariance, between_models_covariance
from .model_comparison import ModelComparison, noise_from_sigmas
from .model_selection import (
    Candidate,
    FittedCandidate,
    ModelName,
    drop_negligible,
    fit_candidates,
    posterior_probabilities,
    smallest_sufficient_field,
    standard_deviation_prior,
)
from .standard_deviations import ROBOT_SIGMA_FLOOR, StandardDeviations
from .view_statistics import ViewStatistics, chain_at, with_prior_sigmas

MAX_LINEARISATIONS = 6
"""Largest number of linearisations, each at the fit with the last standard deviations."""

SIGMA_TOLERANCE = 0.02
"""Relative change of every standard deviation below which the iteration has converged."""


class AveragedFit(NamedTuple):
    """The fit of the averaged model.

    Attributes:
        statistics: the statistics of the views at the fit.
        chain: the chain of the fit, or of every camera of a rig.
        z: the step of the fit.
        views: the views linearised there.
        fitted: the models, fitted there.
        probabilities: the probabilities of the models.
        maximum: the standard deviations of the averaged model, and their information.
        converged: whether the standard deviations converged.
        noise_corrections: corrections of the poses for noise with which the robot error field was
            evaluated.
        directions: the directions in which poses err most; None if they err alike in all. The
            views' own parameters are along its axes.
    """

    statistics: ViewStatistics
    chain: Any
    z: Step
    views: LinearisedViews
    fitted: Mapping[ModelName, FittedCandidate]
    probabilities: Mapping[ModelName, float]
    maximum: LikelihoodMaximum
    converged: bool
    noise_corrections: Float[np.ndarray, "views 6"]
    directions: DirectionalNoise | None = None

    @property
    def small_sample_correction(self) -> SmallSampleCorrection:
        """The contribution of uncertain standard deviations and directions to the covariance."""
        return small_sample_correction(self.views, self.maximum, self.directions)

    @property
    def between_models_covariance(self) -> Float[np.ndarray, "shared shared"]:
        """The covariance of the shared parameters between the models of the robot's error."""
        sigmas = self.maximum.sigmas
        covariance = between_models_covariance(self.views, self.fitted, self.probabilities, sigmas)
        if self.directions is None:
            return covariance
        return covariance + between_directions_covariance(self.views, self.directions, sigmas)

    @property
    def shape(self) -> TargetShape | None:
        """The target's shape; None if it is held as stated."""
        return self.statistics.shape


class SecondPass(NamedTuple):
    """The fit of the averaged model, on the smallest field that contains its models.

    Attributes:
        field_probabilities: probabilities of the fields, whatever the target's size.
        field: that field; None if white noise is enough.
        built: the problem, in which the parameters that no model needs are held.
        views: its statistics, as stated at the beginning, along the axes of the fit.
        average: the fit.
        comparison: the models of the average.
    """

    field_probabilities: dict[str, float]
    field: AbstractField | None
    built: AbstractBuiltProblem
    views: ViewStatistics
    average: AveragedFit
    comparison: "Comparison"


def average_over_models(
    first: ModelComparison,
    fixed: Sequence[str],
    prior: RobotPrior,
    pose_parameters: int,
    report_progress: Callable[[str], None],
) -> SecondPass:
    """Fit the average of the models with more than negligible probability.

    It alternates between the fit and the standard deviations.

    Args:
        first: the comparison of the models.
        fixed: paths of parameters to hold.
        prior: prior of the standard deviations of an arm's errors.
        pose_parameters: number of free parameters of the poses that single views tell.
        report_progress: called with a line of text.
    """
    probabilities = drop_negligible(first.probabilities)
    free_sizes = {size for model in probabilities for size in model.free_sizes}
    tested_sizes = tuple(filter(is_size, first.views.group_names))
    sizes = tuple(size for size in tested_sizes if size in free_sizes)
    field_probabilities = probabilities_by_field(probabilities)
    listed = ", ".join(f"{name} {p:.2f}" for name, p in field_probabilities.items())
    report_progress(f"errors of the robot: {listed}")
    fitted_field = (
        first.basis
        if ROBOT_ERROR in fixed
        else smallest_sufficient_field(first.basis, first.models, set(field_probabilities))
    )
    # The problem keeps the field that contains all models, with unused groups held at zero, so that
    # all fits of a calibration share one compiled program.
    built = first.built.holding(_held_names(first, fitted_field, {*tested_sizes} - free_sizes))
    within = first.views.within_sum_of_squares
    sigmas = averaged_models(first.linearised, first.views.group_names, first.fitted, probabilities)
    predicted_views, predicted = first.views.moved(
        first.z, posterior_mode_step(first.linearised, sigmas)
    )
    shape = predicted_views.shape
    views = ViewStatistics(built, pose_parameters, within, sizes, shape)
    comparison = Comparison(
        {name: first.models[name] for name in field_probabilities},
        standard_deviation_prior(
            prior, fitted_field, views.group_names, shape, views.has_white_noise
        ),
        prior.wrong_target_probability,
    )
    average = iterate_to_convergence(
        views,
        _transfer_step(predicted, first.built.shared_names, built.shared_names),
        first.views.select_groups(sigmas, views.group_names),
        comparison,
    )
    return SecondPass(field_probabilities, fitted_field, built, views, average, comparison)


def probabilities_by_field(probabilities: Mapping[ModelName, float]) -> dict[str, float]:
    """Return the probabilities of the fields, whatever the target's size."""
    fields: dict[str, float] = {}
    for model, probability in probabilities.items():
        fields[model.field] = fields.get(model.field, 0.0) + probability
    return fields


def _held_names(
    first: ModelComparison, fitted_field: AbstractField | None, unused_sizes: set[str]
) -> set[str]:
    """Return the parameters of the comparison's problem that the fitted model does not have."""
    groups = () if fitted_field is None else fitted_field.group_names
    return {
        name
        for name in first.built.shared_names
        if (name.startswith(f"{ROBOT_ERROR}.") and name.split(".")[1] not in groups)
        or name in unused_sizes
    }


class Comparison(NamedTuple):
    """The models of a comparison, and their priors.

    Attributes:
        models: models to average over.
        prior: prior of the standard deviations of the field's groups.
        wrong_target_probability: prior probability that the target does not have its stated size.
    """

    models: Mapping[str, Candidate]
    prior: StandardDeviationPrior
    wrong_target_probability: float


@on_one_blas_thread
def iterate_to_convergence(
    views: ViewStatistics,
    initial: Step,
    sigmas: StandardDeviations,
    comparison: Comparison,
) -> AveragedFit:
    """Alternate between the fit and the averaged standard deviations, until these converge.

    Args:
        views: statistics with the field that contains all models.
        initial: step of all parameters at which the first fit begins.
        sigmas: standard deviations for the first fit.
        comparison: the models to average over, and their priors.
    """
    (models, prior, wrong_target_probability), iterations, last = comparison, 0, None
    while True:
        corrections = views.corrections(np.asarray(initial.per_view))
        views = views.with_noise_corrections(corrections)
        problem = with_prior_sigmas(views.problem, sigmas, views.group_index)
        solution, equations = solve(problem, start=initial)
        linearised = views.linearised_at_fit(problem, solution.z, equations)
        iterations += 1
        search_start = sigmas
        if sizes := sum(map(is_size, views.group_names)):
            # Their priors differ between the average and the models.
            field = np.append(sigmas.field[:-sizes], prior.median[-sizes:])
            search_start = sigmas._replace(field=field)
        fitted = fit_candidates(
            linearised, models, views.group_names, search_start, prior, wrong_target_probability
        )
        if not fitted:
            # No model has a finite weight, for example if pictures and poses do not belong
            # together: return the last good result.
            if last is not None:
                return last._replace(maximum=_maximum_at(last.views, sigmas, prior))
            chain, linearised = chain_at(views.problem, initial), views.linearise(initial)
            maximum = _maximum_at(linearised, sigmas, prior)
            return AveragedFit(
                views, chain, initial, linearised, {}, {}, maximum, False, corrections
            )
        previous, kept = sigmas, drop_negligible(posterior_probabilities(fitted))
        sigmas = averaged_models(linearised, views.group_names, fitted, kept)
        change = np.abs(sigmas.vector - previous.vector)
        tolerance = SIGMA_TOLERANCE * previous.vector + 10.0 * ROBOT_SIGMA_FLOOR
        converged = bool((change <= tolerance).all())
        maximum = _maximum_at(linearised, sigmas, prior)
        last = AveragedFit(
            views,
            solution.chain,
            solution.z,
            linearised,
            fitted,
            kept,
            maximum,
            converged,
            corrections,
        )
        if converged or iterations == MAX_LINEARISATIONS:
            return last
        views, initial = views.moved(solution.z, posterior_mode_step(linearised, sigmas))


def _transfer_step(z: Step, names: tuple[str, ...], target_names: tuple[str, ...]) -> Step:
    """Convert a step to the parameters of another problem; parameters that it adds are zero."""
    components = dict(zip(names, z.shared, strict=True))
    return z._replace(shared=np.array([components.get(name, 0.0) for name in target_names]))


def _maximum_at(
    views: LinearisedViews, sigmas: StandardDeviations, prior: StandardDeviationPrior
) -> LikelihoodMaximum:
    """Return these standard deviations as the result of a search for the maximum."""
    marginal = marginalise(views, sigmas)
    information = np.asarray(
        fisher_information(views, marginal, kinds_of(views, len(sigmas.field)))
    )
    information = information + np.diag(np.pad(prior.log_std**-2, (1, 0)))
    return LikelihoodMaximum(sigmas, float(marginal.deviance), 0.0, information, 0)


def averaged_noise(
    average: AveragedFit,
    views: ViewStatistics,
    field: AbstractField | None,
    prior: RobotPrior,
) -> Noise:
    """Return the noise of the averaged model, with the prior's medians for held groups.

    Its directions hold at any pose of the robot.
    """
    noise = noise_from_sigmas(average.maximum.sigmas, views.white_sigma)
    fitted = dict(zip(views.group_names, noise.field, strict=True))
    names = () if field is None else field.group_names
    values = (
        fitted.get(name, float(median))
        for name, median in zip(names, prior.medians(field)[2:], strict=True)
    )
    directions = None
    if average.directions is not None:
        problem = views.problem
        assert isinstance(problem, JointProblem | RigProblem)
        poses = host_matrices(problem.command.base_from_tool)
        directions = average.directions.at_any_pose(poses[:, :3, :3].swapaxes(1, 2))
    return dataclasses.replace(noise, field=tuple(values), directions=directions)
