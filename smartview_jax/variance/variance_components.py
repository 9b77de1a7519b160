"""Estimate the noise model of a joint fit from the data: the standard deviation of every error."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool

from ..calibration import Calibration
from ..dataset import Dataset
from ..engine import (
    POSE_CORRECTIONS,
    ROBOT_ERROR,
    BuiltProblem,
    FittedChain,
    Noise,
    Prior,
    Step,
    build_problem,
    solve,
)
from ..robot_errors import AbstractField, FieldChoice, RobotPrior, checked_field_choice
from .fisher_scoring import LikelihoodMaximum, StandardDeviationPrior, fisher_information
from .kenward_roger import small_sample_correction
from .likelihood import (
    ROBOT_SIGMA_FLOOR,
    LinearisedViews,
    StandardDeviations,
    marginalise,
    posterior_mode_step,
)
from .model_selection import (
    TARGET_SCALE,
    WHITE_NOISE,
    Candidate,
    FittedCandidate,
    ModelName,
    average_standard_deviations,
    candidate_models,
    drop_negligible,
    encompassing_field,
    fit_candidates,
    initial_standard_deviations,
    posterior_probabilities,
    smallest_sufficient_field,
    standard_deviation_prior,
)
from .noise_estimate import (
    FREE_SCALE_PROBABILITY,
    CandidateResult,
    NoiseEstimate,
    TargetScaleEvidence,
)
from .view_statistics import ViewStatistics, chain_at, with_free_poses, with_prior_sigmas

MAX_LINEARISATIONS = 6
"""Largest number of linearisations, each at the fit with the last standard deviations."""

SIGMA_TOLERANCE = 0.02
"""Relative change of every standard deviation below which the iteration has converged."""


def estimate_noise(
    data: Dataset,
    start: Calibration,
    *,
    field: FieldChoice | Literal[False] = "auto",
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    progress: Callable[[str], None] | None = None,
    robot_prior: RobotPrior | None = None,
) -> NoiseEstimate:
    """Estimate the standard deviations of all errors by restricted likelihood and priors on arms.

    Args:
        data: data set; below about eight views nothing is reliable, and more are better.
        start: any calibration near enough, with the lens that is to be fitted.
        field: model of the robot error. `"auto"` averages over a robot with white noise alone, and
            with a field in addition: linear in position or in the pose, or that of an arm of
            unknown geometry, or, where an arm's joints are known, of their zeros or of all its
            Denavit-Hartenberg parameters. None is white noise alone. A field of `robot_errors`, or
            one of your own, is used as it is.
        fixed: paths of parameters to hold, as in `fit_joint`.
        free: paths of parameters to make free, as in `fit_joint`.
        priors: priors on parameters, as in `fit_joint`.
        progress: function that is called with a message on the current step.
        robot_prior: prior of the standard deviations of an arm's errors.

    Raises:
        ValueError: as in `fit_joint`, and for a prior on what is estimated here.
    """
    report_progress = progress or (lambda _: None)
    prior, field = robot_prior or RobotPrior(), checked_field_choice(field)
    if field is None:
        start = start.uncorrected
    for path in priors or ():
        if path.split(".")[0] in (ROBOT_ERROR, POSE_CORRECTIONS):
            raise ValueError(
                f"prior on {path!r}: its size is what noise='estimated' finds; give a Noise instead"
            )

    # First pass: all models on the basis that contains them, linearised at the fit with free poses.
    field_is_fixed = ROBOT_ERROR in fixed
    if field_is_fixed:
        basis, field = start.field, None
    elif field == "auto":
        basis = encompassing_field(data, len(data.usable_views()))
    else:
        basis = field
    test_scale = prior.wrong_target_probability > 0.0 and TARGET_SCALE not in (
        *fixed,
        *free,
        *(priors or ()),
    )
    models = candidate_models(field, None if field_is_fixed else basis)
    # All standard deviations are one; their values are set later.
    unit = Noise(1.0, 1.0, 1.0, field=(1.0,) * (len(basis.groups) if basis else 0))
    built = build_problem(
        data,
        start,
        noise=unit,
        field=basis,
        fixed=fixed,
        free=(*free, *((TARGET_SCALE,) if test_scale else ())),
        priors=priors,
    )
    first = _compare_models(built, data, field, basis, models, prior, test_scale)

    # Second pass: only the models with more than negligible probability, on the smallest field that
    # contains them, alternating between the fit and the standard deviations.
    free_scale = (
        first.target_scale is not None and first.target_scale.probability > FREE_SCALE_PROBABILITY
    )
    probabilities = drop_negligible(
        {model: p for model, p in first.probabilities.items() if model.free_scale == free_scale}
    )
    field_probabilities = {model.field: p for model, p in probabilities.items()}
    listed = ", ".join(f"{name} {p:.2f}" for name, p in field_probabilities.items())
    report_progress(f"errors of the robot: {listed}")
    fitted_field = (
        basis
        if field_is_fixed
        else smallest_sufficient_field(basis, models, set(field_probabilities))
    )
    # The problem keeps the field that contains all models, and holds the rest of it at zero: all
    # fits of a calibration are then solved by one compiled program.
    fitted_groups = () if fitted_field is None else tuple(name for name, _ in fitted_field.groups)
    held = {
        name
        for name in first.built.shared_names
        if (name.startswith(f"{ROBOT_ERROR}.") and name.split(".")[1] not in fitted_groups)
        or (name == TARGET_SCALE and test_scale and not free_scale)
    }
    built = first.built.holding(held)
    views = ViewStatistics(built, data.usable_views(), first.views.within_sum_of_squares)
    sigmas = average_standard_deviations(first.fitted, probabilities)
    predicted = _predicted_optimum(first.linearised, first.z, sigmas)
    chain, linearised, maximum, converged = _iterate_to_convergence(
        views,
        _transfer_step(predicted, first.built.shared_names, built.shared_names),
        {name: models[name] for name in field_probabilities},
        first.views.select_groups(sigmas, views.group_names),
        standard_deviation_prior(prior, fitted_field, views.group_names),
    )
    error = chain.calibration.robot_error
    correction = small_sample_correction(linearised, maximum)
    return NoiseEstimate(
        max(field_probabilities, key=lambda name: field_probabilities[name]),
        _averaged_noise(maximum.sigmas, views, fitted_field, prior),
        fitted_field,
        basis,
        dataclasses.replace(
            chain.calibration,
            robot_error=None
            if fitted_field is None or error is None
            else error.converted_to(fitted_field),
        ),
        first.candidates,
        first.target_scale,
        None if fitted_field is None else _mount_displacement(built, linearised, maximum.sigmas),
        converged,
        tuple(map(float, correction.relative_std)),
        built.shared_names,
        correction,
        prior,
    )


class _ModelComparison(NamedTuple):
    """The models of the robot error, compared on one linearisation.

    Attributes:
        built: problem with the basis that contains all models.
        views: statistics of the views.
        z: step at which the views are linearised, the fit with free poses.
        linearised: the views linearised there.
        fitted: the models, each with the standard deviations that maximise its posterior.
        probabilities: posterior probabilities of the models.
        candidates: the same for the result.
        target_scale: evidence on the target's size; None where it is not in question.
    """

    built: BuiltProblem
    views: ViewStatistics
    z: Step
    linearised: LinearisedViews
    fitted: Mapping[ModelName, FittedCandidate]
    probabilities: Mapping[ModelName, float]
    candidates: tuple[CandidateResult, ...]
    target_scale: TargetScaleEvidence | None


def _compare_models(
    built: BuiltProblem,
    data: Dataset,
    field: FieldChoice,
    basis: AbstractField | None,
    models: Mapping[str, Candidate],
    prior: RobotPrior,
    test_scale: bool,
) -> _ModelComparison:
    """Compare the models of the robot error at the fit with free poses.

    Args:
        built: problem with the basis, and with a free target scale if that is in question.
        data: data set.
        field: field that the user asked for, or `"auto"`.
        basis: field that contains all models.
        models: models to compare, by the name of their field.
        prior: prior of the robot's errors.
        test_scale: whether the target's size is in question.

    Raises:
        ValueError: no model can be linearised.
    """
    problem = with_free_poses(built.problem)
    solution, equations = solve(problem)
    views = ViewStatistics(built, data.usable_views(), 2.0 * float(equations.cost), test_scale)
    sigma_prior = standard_deviation_prior(prior, basis, views.group_names)
    linearised = views.linearised_at_fit(problem, solution.z, equations)
    fitted = fit_candidates(
        linearised,
        models,
        views.group_names,
        initial_standard_deviations(sigma_prior, views.white_sigma),
        sigma_prior,
        prior.wrong_target_probability,
    )
    if not fitted:
        raise ValueError(
            "no model explains the views: their own best poses cannot be linearised; "
            "start nearer to the truth (fit_staged), or check the poses"
        )
    # A field that was asked for is used whatever the probability of white noise.
    requested = list(models)[-1] if isinstance(field, AbstractField) else None
    probabilities = posterior_probabilities(
        {model: fit for model, fit in fitted.items() if requested in (None, model.field)}
    )
    return _ModelComparison(
        built,
        views,
        solution.z,
        linearised,
        fitted,
        probabilities,
        _candidate_results(fitted, probabilities, views.white_sigma),
        _target_scale_evidence(built, linearised, solution.z, fitted, probabilities)
        if test_scale
        else None,
    )


def _iterate_to_convergence(
    views: ViewStatistics,
    initial: Step,
    models: Mapping[str, Candidate],
    sigmas: StandardDeviations,
    prior: StandardDeviationPrior,
) -> tuple[FittedChain, LinearisedViews, LikelihoodMaximum, bool]:
    """Alternate between the fit and the averaged standard deviations, until these converge.

    Args:
        views: statistics with the field that contains all models.
        initial: step of all parameters at which the first fit begins.
        models: models to average over.
        sigmas: standard deviations for the first fit.
        prior: prior of the standard deviations of the field's groups.

    Returns:
        The chain of the fit, the views linearised there, the maximum of the likelihood, and whether
        the standard deviations converged.
    """
    iterations, chain, accepted = 0, None, None
    while True:
        problem = with_prior_sigmas(views.problem, sigmas, views.group_index)
        solution, equations = solve(problem, start=initial)
        linearised = views.linearised_at_fit(problem, solution.z, equations)
        iterations += 1
        fitted = fit_candidates(linearised, models, views.group_names, sigmas, prior, 0.0)
        if not fitted:
            # No model has a finite weight, for example where pictures and poses do not belong
            # together: return the last good result.
            if chain is None or accepted is None:
                chain, accepted = chain_at(views.problem, initial), views.linearise(initial)
            return chain, accepted, _maximum_at(accepted, sigmas, prior), False
        chain, accepted = solution.chain, linearised
        previous, kept = sigmas, drop_negligible(posterior_probabilities(fitted))
        sigmas = average_standard_deviations(fitted, kept)
        change = np.abs(sigmas.vector - previous.vector)
        tolerance = SIGMA_TOLERANCE * previous.vector + 10.0 * ROBOT_SIGMA_FLOOR
        converged = bool((change <= tolerance).all())
        if converged or iterations == MAX_LINEARISATIONS:
            return chain, accepted, _maximum_at(accepted, sigmas, prior), converged
        initial = _predicted_optimum(accepted, solution.z, sigmas)


def _predicted_optimum(views: LinearisedViews, z: Step, sigmas: StandardDeviations) -> Step:
    """Compute the most probable parameters for given standard deviations, to first order."""
    return jax.tree.map(np.add, z, posterior_mode_step(views, sigmas))


def _transfer_step(z: Step, names: tuple[str, ...], target_names: tuple[str, ...]) -> Step:
    """Convert a step to the parameters of another problem; parameters that it adds are zero."""
    components = dict(zip(names, z.shared, strict=True))
    return z._replace(shared=np.array([components.get(name, 0.0) for name in target_names]))


def _candidate_results(
    fitted: Mapping[ModelName, FittedCandidate],
    model_probabilities: Mapping[ModelName, float],
    white_sigma: float,
) -> tuple[CandidateResult, ...]:
    """Return all models tried, with probabilities and likelihood ratios to white noise alone."""
    white_noise_deviance = fitted[ModelName(WHITE_NOISE, False)].maximum.deviance
    return tuple(
        CandidateResult(
            name,
            model_probabilities.get(name, 0.0),
            white_noise_deviance - candidate.maximum.deviance,
            _noise_from_sigmas(candidate.maximum.sigmas, white_sigma, candidate.active),
        )
        for name, candidate in fitted.items()
    )


def _target_scale_evidence(
    built: BuiltProblem,
    views: LinearisedViews,
    z: Step,
    fitted: Mapping[ModelName, FittedCandidate],
    model_probabilities: Mapping[ModelName, float],
) -> TargetScaleEvidence:
    """Estimate the target's size by the most probable model in which its scale is free."""
    free_scale_probabilities = {
        name: probability for name, probability in model_probabilities.items() if name.free_scale
    }
    best = max(free_scale_probabilities, key=lambda name: free_scale_probabilities[name])
    marginal = marginalise(views, fitted[best].maximum.sigmas)
    index = built.shared_names.index(TARGET_SCALE)
    scale_at_start = np.asarray(built.problem.parameters.start.target_scale)
    scale = scale_at_start + np.asarray(z.shared)[index] + marginal.step.shared[index]
    std = np.sqrt(marginal.shared_covariance[index, index])
    return TargetScaleEvidence(sum(free_scale_probabilities.values()), float(scale), float(std))


def _mount_displacement(
    built: BuiltProblem, views: LinearisedViews, sigmas: StandardDeviations
) -> tuple[float, ...] | None:
    """Compute how far the robot error field displaces the mount, to first order."""
    mount = f"{built.problem.parameters.start.transform_names[0]}."
    indices = [k for k, name in enumerate(built.shared_names) if name.startswith(mount)]
    if len(indices) != 6:
        return None
    # A field with standard deviations of `ROBOT_SIGMA_FLOOR` is held at zero.
    white_sigmas = sigmas._replace(field=np.full_like(sigmas.field, ROBOT_SIGMA_FLOOR))
    with_field, without_field = (
        posterior_mode_step(views, each_sigmas).shared for each_sigmas in (sigmas, white_sigmas)
    )
    return tuple(map(float, (with_field - without_field)[indices]))


def _maximum_at(
    views: LinearisedViews, sigmas: StandardDeviations, prior: StandardDeviationPrior
) -> LikelihoodMaximum:
    """Return the result of a search for the maximum that ends at these standard deviations."""
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
    """Return the noise of the averaged model; of groups that are held, the prior's medians."""
    noise = _noise_from_sigmas(sigmas, views.white_sigma)
    fitted = dict(zip(views.group_names, noise.field, strict=True))
    names = () if field is None else tuple(name for name, _ in field.groups)
    values = (
        fitted.get(name, float(median))
        for name, median in zip(names, prior.medians(field)[2:], strict=True)
    )
    return dataclasses.replace(noise, field=tuple(values))


def _noise_from_sigmas(
    sigmas: StandardDeviations, white_sigma: float, active: Bool[np.ndarray, "robot"] | None = None
) -> Noise:
    """Convert to a `Noise`; with `active`, only the active groups of the field are kept."""
    field = sigmas.field if active is None else sigmas.field[active[2:]]
    pixel_and_pose = (float(sigmas.pixel), float(sigmas.translation), float(sigmas.rotation))
    return Noise(*pixel_and_pose, field=tuple(map(float, field)), white_pixel=white_sigma)
