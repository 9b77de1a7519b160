"""Compare models of the robot's error by their evidence, on one linearisation of the views."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool

from ..calibration import Calibration, flat_shape
from ..dataset import Dataset, Rig, turns_about_one_point
from ..engine import (
    ROBOT_ERROR,
    TARGET_SCALE,
    AbstractBuiltProblem,
    Noise,
    ParameterChoice,
    Step,
    build_problem,
    is_size,
    solve,
)
from ..geometry import host_matrices
from ..robot_errors import AbstractField, FieldChoice, RobotPrior
from ..runtime.blas_threads import on_one_blas_thread
from .fisher_scoring import StandardDeviationPrior
from .free_poses import fit_free_poses
from .likelihood import marginalise, posterior_mode_step
from .linearised_views import LinearisedViews
from .model_selection import (
    WHITE_NOISE,
    Candidate,
    FittedCandidate,
    ModelName,
    candidate_models,
    encompassing_field,
    fit_candidates,
    initial_standard_deviations,
    posterior_probabilities,
    standard_deviation_prior,
)
from .noise_estimate import CandidateResult, TargetScaleEvidence
from .possible_models import TARGET_SCALE_LIMITS
from .robot_evidence import RobotEvidence
from .standard_deviations import StandardDeviations
from .view_statistics import ViewStatistics, with_prior_sigmas

MAX_FREE_FITS = 3
"""Largest number of fits with free poses, each started from the fit of robot and pictures."""

FREE_FIT_TOLERANCE = 1e-3
"""Relative decrease of the sum of squares below which a fit with free poses is accepted."""


class ModelComparison(NamedTuple):
    """The models of the robot error, compared on one linearisation.

    Attributes:
        basis: field that contains all models; None without a field.
        models: the models, by the name of their field.
        built: problem with the basis that contains all models.
        views: statistics of the views.
        z: step at which the views are linearised, the fit with white noise of the poses alone.
        linearised: the views linearised there.
        fitted: the models, each with the standard deviations that maximise its posterior.
        probabilities: posterior probabilities of the models.
        candidates: the same for the result.
        target_scales: evidence on each target's size that is tested, by the parameter's name.
    """

    basis: AbstractField | None
    models: Mapping[str, Candidate]
    built: AbstractBuiltProblem
    views: ViewStatistics
    z: Step
    linearised: LinearisedViews
    fitted: Mapping[ModelName, FittedCandidate]
    probabilities: Mapping[ModelName, float]
    candidates: tuple[CandidateResult, ...]
    target_scales: Mapping[str, TargetScaleEvidence]

    @property
    def evidence(self) -> RobotEvidence:
        """The views as evidence on the sizes of the robot's errors."""
        return RobotEvidence.of(
            jax.tree.map(np.asarray, self.linearised),
            self.built.shared_names,
            self.models,
            self.basis,
            self.views,
        )


class RequestedModels(NamedTuple):
    """The models of the robot error that are to be compared.

    Attributes:
        field: the requested field, `"auto"`, or None for white noise alone.
        basis: field that contains all models; None without a field.
        models: the models, by the name of their field.
    """

    field: FieldChoice
    basis: AbstractField | None
    models: Mapping[str, Candidate]

    @classmethod
    def of(
        cls, field: FieldChoice, data: Dataset | Rig, view_count: int, prior: RobotPrior
    ) -> "RequestedModels":
        """Return the models for a data set with a number of usable views."""
        basis = encompassing_field(data, view_count) if field == "auto" else field
        basis = prior.about_type(basis)
        return cls(field, basis, candidate_models(field, basis, prior.model_odds))

    @property
    def unit_noise(self) -> Noise:
        """Noise with standard deviations of one, whose values are set later."""
        return Noise(1.0, 1.0, 1.0).with_unit_groups(self.basis)


def tested_sizes(
    sizes: Iterable[str], choice: ParameterChoice, prior: RobotPrior, data: Dataset | Rig
) -> tuple[str, ...]:
    """Return which targets' sizes are compared with the stated ones.

    Not one that the user decides on, and none if the robot's motion tells nothing of any size.
    """
    tested = tuple(size for size in sizes if not choice.states(size))
    if prior.wrong_target_probability == 0.0 or not tested:
        return ()
    poses = host_matrices(data.base_from_tool)[data.usable_views()]
    return () if turns_about_one_point(poses) else tested


@on_one_blas_thread
def compare_models(
    data: Dataset,
    start: Calibration,
    field: FieldChoice,
    choice: ParameterChoice,
    prior: RobotPrior,
) -> ModelComparison:
    """Compare the models of the robot error at the fit with white noise of the poses alone.

    Args:
        data: data set.
        start: a calibration near the solution, with the lens to fit.
        field: the requested field, `"auto"`, or None for white noise alone.
        choice: parameters to hold and to make free, and their priors.
        prior: prior of the robot's errors.

    Raises:
        ValueError: no model can be linearised.
    """
    if ROBOT_ERROR in choice.fixed:
        requested = RequestedModels(None, start.field, candidate_models(None, None))
    else:
        requested = RequestedModels.of(field, data, len(data.usable_views()), prior)
    basis, sizes = requested.basis, tested_sizes((TARGET_SCALE,), choice, prior, data)
    built = build_problem(
        data,
        start,
        noise=requested.unit_noise,
        field=basis,
        **choice.freeing(*sizes)._asdict(),
    )
    shape = None
    if not prior.target_is_flat:
        shape = flat_shape(np.asarray(data.points), np.asarray(data.visible))
    start_of_free, fits, poses = None, 0, built.pose_parameters(data.usable_views())
    while True:
        free_fit = fit_free_poses(built, data.usable_views(), shape, start_of_free)
        within_sum_of_squares, fits = free_fit.sum_of_squares, fits + 1
        shape = free_fit.shape
        views = ViewStatistics(built, poses, within_sum_of_squares, sizes, shape)
        sigma_prior = standard_deviation_prior(
            prior, basis, views.group_names, shape, views.has_white_noise
        )
        initial = initial_standard_deviations(sigma_prior, views.initial_sigma)
        free_poses = views.linearised_at_fit(free_fit.problem, free_fit.z, free_fit.equations)
        white = likeliest_white_noise(free_poses, views.group_names, initial, sigma_prior, prior)
        views, z, linearised = linearised_at_mode(
            views, built.shared_names, free_fit.z, free_poses, white
        )
        # No fit can explain the pixels better than free poses, unless a free pose converged to a
        # wrong minimum from a grossly wrong reported pose: then it is repeated from this fit.
        excess = float(linearised.residual_sum_of_squares)
        if excess >= -FREE_FIT_TOLERANCE * within_sum_of_squares or fits == MAX_FREE_FITS:
            break
        start_of_free, shape = z, views.shape
    return compared_at(
        Linearisation(built, views, z, linearised),
        requested,
        initial,
        sigma_prior,
        prior.wrong_target_probability,
    )


class Linearisation(NamedTuple):
    """The views of a problem, linearised at the fit with white noise of the poses alone.

    Attributes:
        built: problem with the basis that contains all models.
        views: statistics of the views.
        z: step of the fit.
        linearised: the views linearised there.
    """

    built: AbstractBuiltProblem
    views: ViewStatistics
    z: Step
    linearised: LinearisedViews


def compared_at(
    linearisation: Linearisation,
    requested: RequestedModels,
    initial: StandardDeviations,
    sigma_prior: StandardDeviationPrior,
    wrong_target_probability: float,
) -> ModelComparison:
    """Compare models of the robot error on one linearisation.

    Args:
        linearisation: the linearised views.
        requested: the models.
        initial: standard deviations from which the search begins.
        sigma_prior: prior of the standard deviations.
        wrong_target_probability: prior probability that the target does not have its stated size.

    Raises:
        ValueError: no model has a finite weight.
    """
    built, views, z, linearised = linearisation
    fitted = fit_candidates(
        linearised,
        requested.models,
        views.group_names,
        initial,
        sigma_prior,
        wrong_target_probability,
    )
    if not fitted:
        raise ValueError(
            "no error model could be fitted, because the chain cannot be linearised: start nearer "
            "to the solution (fit_staged), or check the poses"
        )
    # A requested field is used whatever the probability of white noise.
    only = list(requested.models)[-1] if isinstance(requested.field, AbstractField) else None
    probabilities = posterior_probabilities(
        {model: fit for model, fit in fitted.items() if only in (None, model.field)}
    )
    return ModelComparison(
        requested.basis,
        requested.models,
        built,
        views,
        z,
        linearised,
        fitted,
        probabilities,
        _candidate_results(fitted, probabilities, views.white_sigma),
        target_scale_evidence(built, linearised, z, fitted, probabilities),
    )


def likeliest_white_noise(
    views: LinearisedViews,
    groups: tuple[str, ...],
    initial: StandardDeviations,
    sigma_prior: StandardDeviationPrior,
    prior: RobotPrior,
) -> StandardDeviations:
    """Return the more likely white noise: with the target's size as stated, or free."""
    white = {WHITE_NOISE: Candidate(frozenset(), 0.0)}
    fitted = fit_candidates(
        views, white, groups, initial, sigma_prior, prior.wrong_target_probability
    )
    if not fitted:
        return initial._replace(field=np.zeros_like(initial.field))
    return max(fitted.values(), key=lambda candidate: candidate.log_weight).maximum.sigmas


def linearised_at_mode(
    views: ViewStatistics,
    names: Sequence[str],
    z: Step,
    linearised: LinearisedViews,
    sigmas: StandardDeviations,
) -> tuple[ViewStatistics, Step, LinearisedViews]:
    """Linearise the views at the most probable parameters for given standard deviations.

    The pose of a view is then the best estimate from robot and pictures together. At poses from the
    pictures alone their noise would enter the derivatives, and bias the target's size with many
    views of an accurate robot.

    Args:
        views: statistics of the views.
        names: names of the free shared parameters.
        z: step at which the views were linearised.
        linearised: the views linearised there.
        sigmas: standard deviations of all errors.

    Returns:
        The statistics with the robot error field evaluated at the poses of the fit, the fit, and
        the views linearised there.
    """
    step = posterior_mode_step(linearised, sigmas)
    moved, start = views.moved(z, step)
    # Poses are proportional to the scale, whose logarithm is the parameter: a step d of the linear
    # model is a factor of 1 + d.
    sizes = [k for k, name in enumerate(names) if is_size(name)]
    factors = np.clip(1.0 + step.shared[sizes], *TARGET_SCALE_LIMITS)
    start.shared[sizes] = np.asarray(z.shared)[sizes] + np.log(factors)
    if not all(np.isfinite(part).all() for part in start):
        return views, z, linearised
    views = moved.with_noise_corrections(np.asarray(start.per_view))
    problem = with_prior_sigmas(views.problem, sigmas, views.group_index)
    solution, equations = solve(problem, start=start)
    return views, solution.z, views.linearised_at_fit(problem, solution.z, equations)


def _candidate_results(
    fitted: Mapping[ModelName, FittedCandidate],
    model_probabilities: Mapping[ModelName, float],
    white_sigma: float,
) -> tuple[CandidateResult, ...]:
    """Return all models tried, with probabilities and likelihood ratios to white noise alone."""
    white_noise_deviance = fitted[ModelName(WHITE_NOISE)].maximum.deviance
    return tuple(
        CandidateResult(
            name,
            model_probabilities.get(name, 0.0),
            white_noise_deviance - candidate.maximum.deviance,
            noise_from_sigmas(candidate.maximum.sigmas, white_sigma, candidate.active),
        )
        for name, candidate in fitted.items()
    )


def target_scale_evidence(
    built: AbstractBuiltProblem,
    views: LinearisedViews,
    z: Step,
    fitted: Mapping[ModelName, FittedCandidate],
    model_probabilities: Mapping[ModelName, float],
) -> dict[str, TargetScaleEvidence]:
    """Estimate each target's size by the most probable model in which it is free, by its name."""
    sizes = {size: None for model in model_probabilities for size in model.free_sizes}
    return {
        size: _size_evidence(size, built, views, z, fitted, model_probabilities) for size in sizes
    }


def _size_evidence(
    size: str,
    built: AbstractBuiltProblem,
    views: LinearisedViews,
    z: Step,
    fitted: Mapping[ModelName, FittedCandidate],
    model_probabilities: Mapping[ModelName, float],
) -> TargetScaleEvidence:
    """Estimate one target's size by the most probable model in which it is free."""
    probabilities = {
        model: probability
        for model, probability in model_probabilities.items()
        if size in model.free_sizes
    }
    best = max(probabilities, key=lambda model: probabilities[model])
    marginal = marginalise(views, fitted[best].maximum.sigmas)
    index = built.shared_names.index(size)
    # The parameter is the logarithm of the scale, but poses are proportional to the scale itself:
    # a step d of the linear model is a factor of 1 + d.
    value = built.problem.host_start_values()[np.asarray(built.problem.free)[index]]
    linearised_scale = np.exp(value + np.asarray(z.shared)[index])
    scale = linearised_scale * np.clip(1.0 + marginal.step.shared[index], *TARGET_SCALE_LIMITS)
    std = linearised_scale * np.sqrt(marginal.shared_covariance[index, index])
    return TargetScaleEvidence(sum(probabilities.values()), float(scale), float(std))


def noise_from_sigmas(
    sigmas: StandardDeviations, white_sigma: float, active: Bool[np.ndarray, "robot"] | None = None
) -> Noise:
    """Convert to a `Noise`; with `active`, only the active groups of the field are kept."""
    field = sigmas.field if active is None else sigmas.field[active[2:]]
    pixel_and_pose = (float(sigmas.pixel), float(sigmas.translation), float(sigmas.rotation))
    return Noise(*pixel_and_pose, field=tuple(map(float, field)), white_pixel=white_sigma)
