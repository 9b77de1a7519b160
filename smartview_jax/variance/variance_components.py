"""Estimate the noise model of a joint fit from the data: the standard deviation of every error."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration import Calibration, TargetShape
from ..dataset import Dataset
from ..engine import (
    POSE_CORRECTIONS,
    ROBOT_ERROR,
    BuiltProblem,
    FittedChain,
    Noise,
    Prior,
    Step,
    solve,
)
from ..robot_errors import AbstractField, FieldChoice, RobotPrior, checked_field_choice
from ..runtime.blas_threads import on_one_blas_thread
from .fisher_scoring import LikelihoodMaximum, StandardDeviationPrior, fisher_information
from .kenward_roger import small_sample_correction
from .lens_terms import lens_evidence
from .likelihood import (
    ROBOT_SIGMA_FLOOR,
    LinearisedViews,
    StandardDeviations,
    marginalise,
    posterior_mode_step,
)
from .model_average import averaged_models, between_models_covariance
from .model_comparison import (
    ModelComparison,
    compare_models,
    noise_from_sigmas,
    target_scale_evidence,
)
from .model_selection import (
    TARGET_GROUPS,
    TARGET_SCALE,
    Candidate,
    FittedCandidate,
    ModelName,
    drop_negligible,
    fit_candidates,
    posterior_probabilities,
    smallest_sufficient_field,
    standard_deviation_prior,
)
from .noise_estimate import NoiseEstimate, TargetShapeEstimate
from .possible_models import is_possible
from .view_statistics import ViewStatistics, chain_at, with_prior_sigmas

MAX_LINEARISATIONS = 6
"""Largest number of linearisations, each at the fit with the last standard deviations."""

SIGMA_TOLERANCE = 0.02
"""Relative change of every standard deviation below which the iteration has converged."""


def estimate_noise(
    data: Dataset,
    start: Calibration,
    *,
    field: FieldChoice = "auto",
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    progress: Callable[[str], None] | None = None,
    robot_prior: RobotPrior | None = None,
) -> NoiseEstimate:
    """Estimate the standard deviations of all errors by restricted likelihood and priors on arms.

    Args:
        data: data set; unreliable below about eight views.
        start: a calibration near the solution, with the lens to fit.
        field: model of the robot error. `"auto"` averages over a robot with white noise alone, and
            with an additional field: linear in position, linear in the pose, or an arm of unknown
            geometry; with known joints, errors of joint zeros or of all Denavit-Hartenberg
            parameters. None is white noise alone. A field of `robot_errors`, or a custom field, is
            used as given.
        fixed: paths of parameters to hold, as in `fit_joint`.
        free: paths of parameters to make free, as in `fit_joint`.
        priors: priors on parameters, as in `fit_joint`.
        progress: function that is called with a message on the current step.
        robot_prior: prior of the standard deviations of an arm's errors.

    Raises:
        ValueError: as in `fit_joint`, and for a prior on the robot's errors, which are estimated.
    """
    report_progress = progress or (lambda _: None)
    prior, field = robot_prior or RobotPrior(), checked_field_choice(field)
    if field is None:
        start = start.uncorrected
    for path in priors or ():
        if path.split(".")[0] in (ROBOT_ERROR, POSE_CORRECTIONS):
            raise ValueError(
                f"prior on {path!r}: noise='estimated' estimates its size; give a Noise instead"
            )

    # First pass: all models on the basis that contains them, linearised at the fit with free poses.
    first = compare_models(data, start, field, fixed=fixed, free=free, priors=priors, prior=prior)

    # Second pass: only the models with more than negligible probability, on the smallest field that
    # contains them, alternating between the fit and the standard deviations.
    probabilities = drop_negligible(first.probabilities)
    free_scale = any(model.free_scale for model in probabilities)
    field_probabilities = _by_field(probabilities)
    listed = ", ".join(f"{name} {p:.2f}" for name, p in field_probabilities.items())
    report_progress(f"errors of the robot: {listed}")
    fitted_field = (
        first.basis
        if ROBOT_ERROR in fixed
        else smallest_sufficient_field(first.basis, first.models, set(field_probabilities))
    )
    # The problem keeps the field that contains all models, with unused groups held at zero, so that
    # all fits of a calibration share one compiled program.
    built = first.built.holding(_held_names(first, fitted_field, free_scale))
    scale_is_group = free_scale and first.target_scale is not None
    within = first.views.within_sum_of_squares
    sigmas = averaged_models(first.linearised, first.views.group_names, first.fitted, probabilities)
    predicted_views, predicted = first.views.moved(
        first.z, posterior_mode_step(first.linearised, sigmas)
    )
    shape = predicted_views.shape
    views = ViewStatistics(built, data.usable_views(), within, scale_is_group, shape)
    average = _iterate_to_convergence(
        views,
        _transfer_step(predicted, first.built.shared_names, built.shared_names),
        {name: first.models[name] for name in field_probabilities},
        first.views.select_groups(sigmas, views.group_names),
        standard_deviation_prior(
            prior, fitted_field, views.group_names, shape, views.has_white_noise
        ),
        prior.wrong_target_probability,
    )
    chain, linearised, maximum = average.chain, average.views, average.maximum
    # At the better parameters of the second pass a free size may have become improbable.
    no_free_size = scale_is_group and not any(name.free_scale for name in average.probabilities)
    is_degenerate = (free_scale or field == "auto") and not is_possible(chain, data)
    if is_degenerate:
        report_progress("degenerate fit (target or motion shrunk): refit without this model")
    if no_free_size or is_degenerate:
        return estimate_noise(
            data,
            start,
            field=field if free_scale else None,
            fixed=fixed,
            free=free,
            priors=priors,
            progress=progress,
            robot_prior=dataclasses.replace(prior, wrong_target_probability=0.0),
        )
    error = chain.calibration.robot_error
    correction = small_sample_correction(linearised, maximum)
    field_group_count = sum(name not in TARGET_GROUPS for name in views.group_names)
    parameter_names = (*built.shared_names, *views.shape_names)
    lens = lens_evidence(
        views.at(average.shape, average.noise_corrections),
        average.z,
        linearised,
        maximum.sigmas,
        chain,
        parameter_names,
        prior.wrong_lens_probability,
    )
    target_scale, scale_std = first.target_scale, None
    if scale_is_group:
        target_scale = target_scale_evidence(
            built, linearised, average.z, average.fitted, average.probabilities
        )
        scale_std = float(maximum.sigmas.field[views.group_names.index(TARGET_SCALE)])
    return NoiseEstimate(
        max(field_probabilities, key=lambda name: field_probabilities[name]),
        _averaged_noise(maximum.sigmas, views, fitted_field, prior),
        fitted_field,
        first.basis,
        dataclasses.replace(
            chain.calibration,
            robot_error=None
            if fitted_field is None or error is None
            else error.converted_to(fitted_field),
        ),
        first.candidates,
        target_scale,
        scale_std,
        _target_shape_estimate(average, maximum.sigmas),
        None
        if fitted_field is None
        else _mount_displacement(built, views.group_names, linearised, maximum.sigmas),
        average.converged,
        tuple(map(float, correction.relative_std[: 3 + field_group_count])),
        parameter_names,
        correction,
        between_models_covariance(
            linearised, average.fitted, average.probabilities, maximum.sigmas
        ),
        prior,
        average.noise_corrections,
        lens,
        first.evidence,
    )


def _by_field(probabilities: Mapping[ModelName, float]) -> dict[str, float]:
    """Return the probabilities of the fields, whatever the target's size."""
    fields: dict[str, float] = {}
    for model, probability in probabilities.items():
        fields[model.field] = fields.get(model.field, 0.0) + probability
    return fields


def _target_shape_estimate(
    average: "_Average", sigmas: StandardDeviations
) -> TargetShapeEstimate | None:
    """Return the target's shape, and how it affects all other parameters."""
    shape = average.shape
    if shape is None:
        return None
    covariance = np.asarray(marginalise(average.views, sigmas).shared_covariance)
    if not np.isfinite(covariance).all():
        # Poses and pictures do not belong together, which the fit reports; the shape stays as
        # stated.
        return None
    columns = covariance[:, -len(shape.coefficients) :]
    of_shape = columns[-len(shape.coefficients) :]
    # The covariance can be singular to rounding if standard deviations are at their floor.
    scale = np.sqrt(np.diagonal(of_shape))
    correlation = of_shape / np.outer(scale, scale)
    by_shape = np.asarray((columns / scale) @ np.linalg.pinv(correlation, hermitian=True))
    return TargetShapeEstimate(shape, of_shape, by_shape / scale)


class _Average(NamedTuple):
    """The fit of the averaged model.

    Attributes:
        shape: the target's shape; None if it is held as stated.
        chain: the chain of the fit.
        z: the step of the fit.
        views: the views linearised there.
        fitted: the models, fitted there.
        probabilities: the probabilities of the models.
        maximum: the standard deviations of the averaged model, and their information.
        converged: whether the standard deviations converged.
        noise_corrections: corrections of the poses for noise with which the robot error field was
            evaluated.
    """

    shape: TargetShape | None
    chain: FittedChain
    z: Step
    views: LinearisedViews
    fitted: Mapping[ModelName, FittedCandidate]
    probabilities: Mapping[ModelName, float]
    maximum: LikelihoodMaximum
    converged: bool
    noise_corrections: Float[np.ndarray, "views 6"]


def _held_names(
    first: ModelComparison, fitted_field: AbstractField | None, free_scale: bool
) -> set[str]:
    """Return the parameters of the comparison's problem that the fitted model does not have."""
    groups = () if fitted_field is None else tuple(name for name, _ in fitted_field.groups)
    return {
        name
        for name in first.built.shared_names
        if (name.startswith(f"{ROBOT_ERROR}.") and name.split(".")[1] not in groups)
        or (name == TARGET_SCALE and first.target_scale is not None and not free_scale)
    }


@on_one_blas_thread
def _iterate_to_convergence(
    views: ViewStatistics,
    initial: Step,
    models: Mapping[str, Candidate],
    sigmas: StandardDeviations,
    prior: StandardDeviationPrior,
    wrong_target_probability: float,
) -> _Average:
    """Alternate between the fit and the averaged standard deviations, until these converge.

    Args:
        views: statistics with the field that contains all models.
        initial: step of all parameters at which the first fit begins.
        models: models to average over.
        sigmas: standard deviations for the first fit.
        prior: prior of the standard deviations of the field's groups.
        wrong_target_probability: prior probability that the target does not have its stated size.
    """
    iterations, last = 0, None
    while True:
        corrections = np.asarray(initial.per_view)
        views = views.with_noise_corrections(corrections)
        problem = with_prior_sigmas(views.problem, sigmas, views.group_index)
        solution, equations = solve(problem, start=initial)
        linearised = views.linearised_at_fit(problem, solution.z, equations)
        iterations += 1
        search_start = sigmas
        if TARGET_SCALE in views.group_names:
            # Its prior differs between the average and the models.
            search_start = sigmas._replace(field=np.append(sigmas.field[:-1], prior.median[-1]))
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
            return _Average(
                views.shape, chain, initial, linearised, {}, {}, maximum, False, corrections
            )
        previous, kept = sigmas, drop_negligible(posterior_probabilities(fitted))
        sigmas = averaged_models(linearised, views.group_names, fitted, kept)
        change = np.abs(sigmas.vector - previous.vector)
        tolerance = SIGMA_TOLERANCE * previous.vector + 10.0 * ROBOT_SIGMA_FLOOR
        converged = bool((change <= tolerance).all())
        maximum = _maximum_at(linearised, sigmas, prior)
        last = _Average(
            views.shape,
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


def _mount_displacement(
    built: BuiltProblem,
    groups: Sequence[str],
    views: LinearisedViews,
    sigmas: StandardDeviations,
) -> tuple[float, ...] | None:
    """Compute the displacement of the mount by the robot error field, to first order."""
    mount = f"{built.problem.parameters.start.transform_names[0]}."
    indices = [k for k, name in enumerate(built.shared_names) if name.startswith(mount)]
    if len(indices) != 6:
        return None
    # A field with standard deviations of `ROBOT_SIGMA_FLOOR` is held at zero.
    is_field = np.array([group not in TARGET_GROUPS for group in groups])
    white_sigmas = sigmas._replace(field=np.where(is_field, ROBOT_SIGMA_FLOOR, sigmas.field))
    with_field, without_field = (
        posterior_mode_step(views, each_sigmas).shared for each_sigmas in (sigmas, white_sigmas)
    )
    return tuple(map(float, (with_field - without_field)[indices]))


def _maximum_at(
    views: LinearisedViews, sigmas: StandardDeviations, prior: StandardDeviationPrior
) -> LikelihoodMaximum:
    """Return these standard deviations as the result of a search for the maximum."""
    marginal = marginalise(views, sigmas)
    information = np.asarray(fisher_information(views, marginal, len(sigmas.field)))
    information = information + np.diag(np.pad(prior.log_std**-2, (1, 0)))
    return LikelihoodMaximum(sigmas, float(marginal.deviance), 0.0, information, 0)


def _averaged_noise(
    sigmas: StandardDeviations,
    views: ViewStatistics,
    field: AbstractField | None,
    prior: RobotPrior,
) -> Noise:
    """Return the noise of the averaged model, with the prior's medians for held groups."""
    noise = noise_from_sigmas(sigmas, views.white_sigma)
    fitted = dict(zip(views.group_names, noise.field, strict=True))
    names = () if field is None else tuple(name for name, _ in field.groups)
    values = (
        fitted.get(name, float(median))
        for name, median in zip(names, prior.medians(field)[2:], strict=True)
    )
    return dataclasses.replace(noise, field=tuple(values))
