"""Estimate the noise model of a joint fit from the data: the standard deviation of every error."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..calibration import Calibration
from ..compilation import compiled
from ..dataset import Dataset
from ..engine import (
    POSE_CORRECTIONS,
    ROBOT_ERROR,
    BuiltProblem,
    JointProblem,
    Noise,
    NormalEquations,
    Prior,
    Step,
    build_problem,
    solve,
)
from ..robot_errors import AbstractField, FieldChoice, RobotPrior
from .fisher_scoring import LikelihoodMaximum, StandardDeviationPrior, fisher_information
from .kenward_roger import SmallSampleCorrection, small_sample_correction
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

MAX_LINEARISATIONS = 6
"""Largest number of linearisations, each at the fit with the last standard deviations."""

SIGMA_TOLERANCE = 0.02
"""Relative change of every standard deviation below which the iteration has converged."""

SIGMA_FLOOR = 1e-4
"""Smallest pixel sigma, px; data with a smaller one count as free of noise."""

FREE_SCALE_PROBABILITY = 0.5
"""Probability that the target does not have its stated size, above which its scale is made free."""


class CandidateResult(NamedTuple):
    """A model of the robot error that was tried.

    Attributes:
        name: "white" where the model has no field, otherwise the field's name; followed by
            ", target_scale" where the target's scale was free as well.
        probability: posterior probability of the model; zero where another field was asked for.
        log_likelihood_ratio: twice the logarithm of the ratio of its penalised likelihood to that
            of white noise of the poses alone.
        noise: the standard deviations that maximise its posterior.
    """

    name: str
    probability: float
    log_likelihood_ratio: float
    noise: Noise


class TargetScaleEvidence(NamedTuple):
    """The evidence of the views on the size of the target.

    Attributes:
        probability: probability that the size is not as stated.
        scale: size of the target over its stated size, if it is not as stated.
        std: standard deviation of `scale`.
    """

    probability: float
    scale: float
    std: float


class NoiseEstimate(NamedTuple):
    """A noise model, averaged over models of the robot error by their probabilities.

    Attributes:
        name: name of the most probable model.
        noise: standard deviations of all errors in the averaged model.
        field: robot error field; None where the views do not call for one.
        calibration: the calibration at the end of the estimation.
        candidates: all models of the robot error that were tried.
        target_scale: evidence on the target's size; None where its scale was not in question.
        mount_displacement: translation (m) and rotation (rad) of the camera's mount with the robot
            error field, relative to that with white noise alone; None where there is no field, or
            the mount is held.
        converged: whether the standard deviations converged.
        relative_std: relative standard errors of the estimated standard deviations of pixel,
            translation, rotation and field; large for one near zero, which the data do not
            determine.
        parameter_names: names of the fit's shared parameters.
        small_sample_correction: contribution of the uncertain standard deviations to the
            covariance of the shared parameters.
        robot_prior: prior of the robot's errors.
    """

    name: str
    noise: Noise
    field: AbstractField | None
    calibration: Calibration
    candidates: tuple[CandidateResult, ...]
    target_scale: TargetScaleEvidence | None
    mount_displacement: tuple[float, ...] | None
    converged: bool
    relative_std: tuple[float, ...]
    parameter_names: tuple[str, ...]
    small_sample_correction: SmallSampleCorrection
    robot_prior: RobotPrior

    @property
    def free(self) -> tuple[str, ...]:
        """The paths of the parameters that are made free because the views call for it."""
        scale_is_free = (
            self.target_scale is not None and self.target_scale.probability > FREE_SCALE_PROBABILITY
        )
        return (TARGET_SCALE,) if scale_is_free else ()

    def correction_of(self, names: Sequence[str]) -> SmallSampleCorrection:
        """Return the small-sample correction for a subset of the parameters."""
        return self.small_sample_correction.subset(
            np.array([self.parameter_names.index(n) for n in names], dtype=int)
        )


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
    prior = robot_prior or RobotPrior()
    if field is None:
        start = start.uncorrected
    for path in priors or ():
        if path.split(".")[0] in (ROBOT_ERROR, POSE_CORRECTIONS):
            raise ValueError(
                f"prior on {path!r}: its size is what noise='estimated' finds; give a Noise instead"
            )

    def build_with(basis: AbstractField | None, free_scale: bool) -> BuiltProblem:
        """Build the problem with all standard deviations one; their values are set later."""
        unit = Noise(1.0, 1.0, 1.0, field=(1.0,) * (len(basis.groups) if basis else 0))
        extra_free = (TARGET_SCALE,) if free_scale else ()
        return build_problem(
            data,
            start,
            noise=unit,
            field=basis,
            fixed=fixed,
            free=(*free, *extra_free),
            priors=priors,
        )

    # First pass: all models on the basis that contains them, linearised at the fit with free poses.
    usable_views = data.usable_views()
    field_is_fixed = ROBOT_ERROR in fixed
    if field_is_fixed:
        basis, field = start.field, None
    elif field == "auto":
        basis = encompassing_field(data, len(usable_views))
    else:
        basis = field
    test_scale = prior.wrong_target_probability > 0.0 and not _includes_target_scale(
        (*fixed, *free, *(priors or ()))
    )
    built = build_with(basis, test_scale)
    solution, equations = solve(_with_free_poses(built.problem))
    views = _ViewStatistics(built, usable_views, 2.0 * float(equations.cost), test_scale)
    sigma_prior = standard_deviation_prior(prior, basis, test_scale)
    models = candidate_models(field, None if field_is_fixed else basis)
    initial = initial_standard_deviations(sigma_prior, views.white_sigma)
    linearised = views.linearise(solution.z)
    fitted = fit_candidates(
        linearised, models, views.group_names, initial, sigma_prior, prior.wrong_target_probability
    )
    if not fitted:
        raise ValueError(
            "no model explains the views: their own best poses cannot be linearised; "
            "start nearer to the truth (fit_staged), or check the poses"
        )
    if isinstance(field, AbstractField):
        # A field that was asked for is used whatever the probability of white noise.
        requested = list(models)[-1]
        model_probabilities = posterior_probabilities(
            {name: candidate for name, candidate in fitted.items() if name.field == requested}
        )
    else:
        model_probabilities = posterior_probabilities(fitted)
    candidate_results = _candidate_results(fitted, model_probabilities, views.white_sigma)
    scale = (
        _target_scale_evidence(built, linearised, solution.z, fitted, model_probabilities)
        if test_scale
        else None
    )

    # Second pass: only the models with more than negligible probability, on the smallest field that
    # contains them, alternating between the fit and the standard deviations.
    free_scale = scale is not None and scale.probability > FREE_SCALE_PROBABILITY
    model_probabilities = drop_negligible(
        {name: p for name, p in model_probabilities.items() if name.free_scale == free_scale}
    )
    candidate_probabilities = {name.field: p for name, p in model_probabilities.items()}
    listed = ", ".join(f"{name} {p:.2f}" for name, p in candidate_probabilities.items())
    report_progress(f"errors of the robot: {listed}")
    fitted_field = (
        basis
        if field_is_fixed
        else smallest_sufficient_field(basis, models, set(candidate_probabilities))
    )
    predicted = _predicted_optimum(
        linearised, solution.z, average_standard_deviations(fitted, model_probabilities)
    )
    previous_built, previous_views = built, views
    built = build_with(fitted_field, free_scale)
    views = _ViewStatistics(built, usable_views, previous_views.within_sum_of_squares)
    z, linearised, maximum, converged = _iterate_to_convergence(
        views,
        _transfer_step(predicted, previous_built.shared_names, built.shared_names),
        {name: models[name] for name in candidate_probabilities},
        previous_views.select_groups(
            average_standard_deviations(fitted, model_probabilities), views.group_names
        ),
        standard_deviation_prior(prior, fitted_field, False),
    )
    calibration, _ = built.problem.calibration(z)
    correction = jax.tree.map(np.asarray, _small_sample_correction(linearised, maximum))
    return NoiseEstimate(
        max(candidate_probabilities, key=lambda name: candidate_probabilities[name]),
        _noise_from_sigmas(maximum.sigmas, views.white_sigma),
        fitted_field,
        calibration if fitted_field is not None else calibration.uncorrected,
        candidate_results,
        scale,
        None if fitted_field is None else _mount_displacement(built, linearised, maximum.sigmas),
        converged,
        tuple(map(float, correction.relative_std)),
        built.shared_names,
        correction,
        prior,
    )


class _ViewStatistics:
    """The statistics of the views from the fit with free poses, for any linearisation.

    Attributes:
        problem: the joint problem.
        group_index: group of unknown standard deviation of each free shared parameter, -1 for none.
        within_sum_of_squares: sum of squared residuals of the fit with free poses and a free
            camera, px^2.
        group_names: names of the groups.
        statistic_count: number of statistics: free parameters of the camera and of the views'
            poses.
        white_sigma: standard deviation of the noise within views, px.
        known_weight: one over the standard deviation of the priors with known standard deviations.
    """

    def __init__(
        self,
        built: BuiltProblem,
        usable_views: Int[np.ndarray, "placed"],
        within_sum_of_squares: float,
        scale_is_group=False,
    ):
        problem, group_index = built.problem, _group_index(built, scale_is_group)
        camera_count = sum(k < problem.parameters.camera_size for k in problem.free)
        self.problem, self.group_index = problem, jnp.asarray(group_index)
        self.within_sum_of_squares = within_sum_of_squares
        error = problem.parameters.start.robot_error
        field_groups = () if error is None else tuple(name for name, _ in error.field.groups)
        self.group_names = (*field_groups, TARGET_SCALE) if scale_is_group else field_groups
        self.statistic_count = camera_count + int(
            np.asarray(problem.per_view_free)[usable_views].sum()
        )
        visible_count = int(np.asarray(problem.observations.visible).sum())
        # White sigma: sum of squared residuals over degrees of freedom, 2 n - (camera and free
        # poses).
        white = np.sqrt(within_sum_of_squares / max(2 * visible_count - self.statistic_count, 1))
        self.white_sigma = max(float(white), SIGMA_FLOOR)
        free_weight = np.asarray(problem.prior_weight.shared)[list(problem.free)]
        self.known_weight = jnp.asarray(np.where(group_index < 0, free_weight, 0.0))

    def linearise(self, z: Step) -> LinearisedViews:
        """Linearise the problem at a step."""
        equations, offset = _equations_and_offset(self.problem, z)
        return LinearisedViews(
            matrix=equations.matrix,
            gradient=equations.gradient,
            residual_sum_of_squares=2.0 * equations.cost - self.within_sum_of_squares,
            offset_from_prior=offset,
            known_weight=self.known_weight,
            group_index=self.group_index,
            per_view_free=self.problem.per_view_free,
            statistic_count=jnp.asarray(float(self.statistic_count)),
            white_sigma=jnp.asarray(self.white_sigma),
        )

    def select_groups(
        self, sigmas: StandardDeviations, names: tuple[str, ...]
    ) -> StandardDeviations:
        """Return the standard deviations with the groups selected and ordered by name."""
        indices = [3 + self.group_names.index(name) for name in names]
        return StandardDeviations.from_vector(sigmas.vector[jnp.array([0, 1, 2, *indices])])


def _iterate_to_convergence(
    views: _ViewStatistics,
    initial: Step,
    models: Mapping[str, Candidate],
    sigmas: StandardDeviations,
    prior: StandardDeviationPrior,
) -> tuple[Step, LinearisedViews, LikelihoodMaximum, bool]:
    """Alternate between the fit and the averaged standard deviations, until these converge.

    Args:
        views: statistics with the field that contains all models.
        initial: step of all parameters at which the first fit begins.
        models: models to average over.
        sigmas: standard deviations for the first fit.
        prior: prior of the standard deviations of the field's groups.

    Returns:
        The step of the fit, the views linearised there, the maximum of the likelihood, and whether
        the standard deviations converged.
    """
    iterations, converged = 0, False
    z, accepted = initial, views.linearise(initial)
    while True:
        refitted = solve(
            _with_prior_sigmas(views.problem, sigmas, views.group_index), start=initial
        )[0].z
        linearised, iterations = views.linearise(refitted), iterations + 1
        fitted = fit_candidates(linearised, models, views.group_names, sigmas, prior, 0.0)
        if not fitted:
            # No model has a finite weight, for example where pictures and poses do not belong
            # together: return the last good result.
            return z, accepted, _maximum_at(accepted, sigmas, prior), False
        z, accepted = refitted, linearised
        previous, kept = sigmas, drop_negligible(posterior_probabilities(fitted))
        sigmas = average_standard_deviations(fitted, kept)
        change = np.abs(np.asarray(sigmas.vector - previous.vector))
        converged = (
            change <= SIGMA_TOLERANCE * np.asarray(previous.vector) + 10.0 * ROBOT_SIGMA_FLOOR
        ).all()
        if converged or iterations == MAX_LINEARISATIONS:
            return z, accepted, _maximum_at(accepted, sigmas, prior), bool(converged)
        initial = _predicted_optimum(accepted, z, sigmas)


def _predicted_optimum(views: LinearisedViews, z: Step, sigmas: StandardDeviations) -> Step:
    """Compute the most probable parameters for given standard deviations, to first order."""
    return jax.tree.map(jnp.add, z, _posterior_mode_step(views, sigmas))


def _transfer_step(z: Step, names: tuple[str, ...], target_names: tuple[str, ...]) -> Step:
    """Convert a step to the parameters of another problem; parameters that it adds are zero."""
    components = dict(zip(names, np.asarray(z.shared), strict=True))
    shared = np.array([components.get(name, 0.0) for name in target_names])
    return Step(jnp.asarray(shared), z.per_view)


def _candidate_results(
    fitted: Mapping[ModelName, FittedCandidate],
    model_probabilities: Mapping[ModelName, float],
    white_sigma: float,
) -> tuple[CandidateResult, ...]:
    """Return all models tried, with probabilities and likelihood ratios to white noise alone."""
    white_noise_deviance = float(fitted[ModelName(WHITE_NOISE, False)].maximum.deviance)
    return tuple(
        CandidateResult(
            str(name),
            model_probabilities.get(name, 0.0),
            white_noise_deviance - float(candidate.maximum.deviance),
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
    step, std = _shared_step_and_std(views, fitted[best].maximum.sigmas)
    index = built.shared_names.index(TARGET_SCALE)
    scale = built.problem.parameters.start.target_scale + z.shared[index] + step[index]
    return TargetScaleEvidence(
        sum(free_scale_probabilities.values()), float(scale), float(std[index])
    )


def _mount_displacement(
    built: BuiltProblem, views: LinearisedViews, sigmas: StandardDeviations
) -> tuple[float, ...] | None:
    """Compute how far the robot error field displaces the mount, to first order."""
    mount = f"{built.problem.parameters.start.transform_names[0]}."
    indices = [k for k, name in enumerate(built.shared_names) if name.startswith(mount)]
    if len(indices) != 6:
        return None
    # A field with standard deviations of `ROBOT_SIGMA_FLOOR` is held at zero.
    white_sigmas = StandardDeviations.from_vector(sigmas.vector.at[3:].set(ROBOT_SIGMA_FLOOR))
    with_field, without_field = (
        _posterior_mode_step(views, each_sigmas).shared for each_sigmas in (sigmas, white_sigmas)
    )
    return tuple(map(float, np.asarray(with_field - without_field)[indices]))


def _includes_target_scale(paths: Sequence[str]) -> bool:
    """Return whether the target's scale is among the paths."""
    return TARGET_SCALE in paths


def _with_free_poses(problem: JointProblem) -> JointProblem:
    """Return the problem with a free pose for every view, by changing only the priors.

    Only arrays differ, so that the same compiled program is used.
    """
    # The shared parameters except the camera's get priors so narrow that they are held, and the
    # corrections of the views get none.
    weight, free = problem.prior_weight, np.array(problem.free, dtype=int)
    fixed_indices = free[free >= problem.parameters.camera_size]
    return eqx.tree_at(
        lambda p: p.prior_weight,
        problem,
        Step(
            weight.shared.at[fixed_indices].set(1.0 / ROBOT_SIGMA_FLOOR),
            jnp.zeros_like(weight.per_view),
        ),
    )


@compiled
def _equations_and_offset(problem: JointProblem, z: Step) -> tuple[NormalEquations, Step]:
    """Return the normal equations of the observations, and the differences from the prior means."""
    offset = problem.offset_from_prior(problem.unscaled_step(z))
    return problem.normal_equations_without_priors(z), Step(
        offset.shared[problem.free_indices], offset.per_view
    )


def _group_index(built: BuiltProblem, scale_is_group: bool) -> Int[np.ndarray, "free"]:
    """Return the group of unknown standard deviation of each free shared parameter; -1 for none.

    Args:
        built: problem with the names of its parameters.
        scale_is_group: whether the target's scale is a group of its own, the last one.
    """
    error = built.problem.parameters.start.robot_error
    groups = () if error is None else error.field.groups
    prefixes = [f"{ROBOT_ERROR}.{group}." for group, _ in groups]
    prefixes += [TARGET_SCALE] if scale_is_group else []
    return np.array(
        [
            next((k for k, prefix in enumerate(prefixes) if name.startswith(prefix)), -1)
            for name in built.shared_names
        ],
        dtype=int,
    )


@compiled
def _with_prior_sigmas(
    problem: JointProblem, sigmas: StandardDeviations, group_index: Array
) -> JointProblem:
    """Return the problem with priors of the given standard deviations."""
    free_indices, shared = problem.free_indices, problem.prior_weight.shared
    weights = sigmas.prior_weights(group_index, shared[free_indices])
    per_view = jnp.broadcast_to(weights.per_view, problem.per_view_free.shape)
    weight = Step(shared.at[free_indices].set(weights.shared), per_view)
    return eqx.tree_at(lambda p: (p.pixel_sigma, p.prior_weight), problem, (sigmas.pixel, weight))


@compiled
def _maximum_at(
    views: LinearisedViews, sigmas: StandardDeviations, prior: StandardDeviationPrior
) -> LikelihoodMaximum:
    """Return the result of a search for the maximum that ends at these standard deviations."""
    marginal = marginalise(views, sigmas)
    information = fisher_information(views, marginal, len(sigmas.field))
    information = information + jnp.diag(jnp.pad(prior.log_std**-2, (1, 0)))
    return LikelihoodMaximum(sigmas, marginal.deviance, jnp.zeros(()), information, jnp.array(0))


@compiled
def _shared_step_and_std(
    views: LinearisedViews, sigmas: StandardDeviations
) -> tuple[Float[Array, "shared"], Float[Array, "shared"]]:
    """Compute the best step of the shared parameters, and their standard deviations."""
    marginal = marginalise(views, sigmas)
    return marginal.step.shared, jnp.sqrt(jnp.diagonal(marginal.shared_covariance))


_posterior_mode_step = compiled(posterior_mode_step)
_small_sample_correction = compiled(small_sample_correction)


def _noise_from_sigmas(
    sigmas: StandardDeviations, white_sigma: float, active: Bool[np.ndarray, "robot"] | None = None
) -> Noise:
    """Convert to a `Noise`; with `active`, only the active groups of the field are kept."""
    field = np.asarray(sigmas.field)
    field = field if active is None else field[active[2:]]
    pixel_and_pose = (float(sigmas.pixel), float(sigmas.translation), float(sigmas.rotation))
    return Noise(*pixel_and_pose, field=tuple(map(float, field)), white_pixel=white_sigma)
