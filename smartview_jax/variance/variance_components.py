"""Estimate the noise model of a joint fit from the data: the standard deviation of every error."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Unpack

import numpy as np

from ..calibration import Calibration
from ..dataset import Dataset
from ..engine import (
    POSE_CORRECTIONS,
    ROBOT_ERROR,
    TARGET_SCALE,
    BuiltProblem,
    ParameterChoice,
    ParameterOptions,
)
from ..robot_errors import FieldChoice, RobotPrior, checked_field_choice
from ..runtime.modules import with_fields
from .averaged_fit import AveragedFit, SecondPass, average_over_models, averaged_noise
from .depth_weights import with_weighed_depths
from .directional_fit import fit_by_direction
from .lens_terms import lens_evidence
from .likelihood import marginalise, posterior_mode_step
from .linearised_views import LinearisedViews
from .model_comparison import (
    ModelComparison,
    compare_models,
    target_scale_evidence,
)
from .model_selection import (
    TARGET_GROUPS,
    drop_negligible,
)
from .noise_estimate import NoiseEstimate, TargetShapeEstimate
from .possible_models import is_possible
from .standard_deviations import ROBOT_SIGMA_FLOOR, StandardDeviations


def estimate_noise(
    data: Dataset,
    start: Calibration,
    *,
    field: FieldChoice = "auto",
    progress: Callable[[str], None] | None = None,
    robot_prior: RobotPrior | None = None,
    **parameters: Unpack[ParameterOptions],
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
        progress: function that is called with a message on the current step.
        robot_prior: prior of the standard deviations of an arm's errors.
        parameters: `fixed`, `free` and `priors`, as in `fit_joint`.

    Raises:
        ValueError: as in `fit_joint`, and for a prior on the robot's errors, which are estimated.
    """
    report_progress = progress or (lambda _: None)
    prior, field = robot_prior or RobotPrior(), checked_field_choice(field)
    if field is None:
        start = start.uncorrected
    choice = ParameterChoice.of(**parameters)
    for path in choice.priors:
        if path.split(".")[0] in (ROBOT_ERROR, POSE_CORRECTIONS):
            raise ValueError(
                f"prior on {path!r}: noise='estimated' estimates its size; give a Noise instead"
            )

    data = with_weighed_depths(data, start, choice, field)
    # First pass: all models on the basis that contains them, linearised at the fit with free poses.
    first = compare_models(data, start, field, choice, prior)

    assert isinstance(first.built, BuiltProblem)
    poses = first.built.pose_parameters(data.usable_views())
    second = average_over_models(first, choice.fixed, prior, poses, report_progress)
    average = second.average
    size_is_group = TARGET_SCALE in second.views.group_names
    free_size = any(model.free_sizes for model in drop_negligible(first.probabilities))
    # At the better parameters of the second pass a free size may have become improbable.
    no_free_size = size_is_group and not any(model.free_sizes for model in average.probabilities)
    is_degenerate = (free_size or field == "auto") and not is_possible(average.chain, data)
    if is_degenerate:
        report_progress("degenerate fit (target or motion shrunk): refit without this model")
    if no_free_size or is_degenerate:
        return estimate_noise(
            data,
            start,
            field=field if free_size else None,
            progress=progress,
            robot_prior=dataclasses.replace(prior, wrong_target_probability=0.0),
            **parameters,
        )
    mount = start.transform_names[0]
    alike = _estimate_of(first, second, prior, mount)
    # Where no smooth error was compared, what follows the views would be taken for directions.
    by_direction = None if field is None else fit_by_direction(second, prior)
    if by_direction is None or not is_possible(by_direction.average.chain, data):
        return alike
    return _estimate_of(first, by_direction, prior, mount)._replace(alike=alike)


def _estimate_of(
    first: ModelComparison, second: SecondPass, prior: RobotPrior, mount: str
) -> NoiseEstimate:
    """Return the estimate, given the fit of the averaged model.

    Args:
        first: the comparison of the models.
        second: the fit.
        prior: prior of the standard deviations of an arm's errors.
        mount: name of the camera's transform.
    """
    built, views, average, fitted_field = second.built, second.views, second.average, second.field
    assert isinstance(built, BuiltProblem)
    chain, linearised, maximum = average.chain, average.views, average.maximum
    error = chain.calibration.robot_error
    correction = average.small_sample_correction
    field_group_count = sum(name not in TARGET_GROUPS for name in views.group_names)
    parameter_names = (*built.shared_names, *views.shape_names)
    lens = lens_evidence(
        average.statistics,
        average.z,
        linearised,
        maximum.sigmas,
        chain,
        parameter_names,
        prior.wrong_lens_probability,
    )
    target_scales, scale_std = first.target_scales, None
    if TARGET_SCALE in views.group_names:
        target_scales = target_scale_evidence(
            built, linearised, average.z, average.fitted, average.probabilities
        )
        scale_std = float(maximum.sigmas.field[views.group_names.index(TARGET_SCALE)])
    estimate = NoiseEstimate(
        max(second.field_probabilities, key=lambda name: second.field_probabilities[name]),
        averaged_noise(average, views, fitted_field, prior),
        fitted_field,
        first.basis,
        with_fields(
            chain.calibration,
            robot_error=None
            if fitted_field is None or error is None
            else error.converted_to(fitted_field),
        ),
        first.candidates,
        target_scales.get(TARGET_SCALE),
        scale_std,
        _target_shape_estimate(average, maximum.sigmas),
        None
        if fitted_field is None
        else _mount_displacement(
            built.shared_names,
            mount,
            views.group_names,
            linearised,
            maximum.sigmas,
        ),
        average.converged,
        tuple(map(float, correction.relative_std[: 3 + field_group_count])),
        parameter_names,
        correction,
        average.between_models_covariance,
        prior,
        average.noise_corrections,
        lens,
        first.evidence,
        average.directions,
    )
    by_fitted = built.problem.host_named_by_fitted(average.z)
    if by_fitted is None:
        return estimate
    covariance = np.asarray(marginalise(linearised, maximum.sigmas).shared_covariance)
    return estimate.by_names(by_fitted, covariance)


def _target_shape_estimate(
    average: AveragedFit, sigmas: StandardDeviations
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


def _mount_displacement(
    names: Sequence[str],
    mount: str,
    groups: Sequence[str],
    views: LinearisedViews,
    sigmas: StandardDeviations,
) -> tuple[float, ...] | None:
    """Compute the displacement of the mount by the robot error field, to first order."""
    indices = [k for k, name in enumerate(names) if name.startswith(f"{mount}.")]
    if len(indices) != 6:
        return None
    # A field with standard deviations of `ROBOT_SIGMA_FLOOR` is held at zero.
    is_field = np.array([group not in TARGET_GROUPS for group in groups])
    white_sigmas = sigmas._replace(field=np.where(is_field, ROBOT_SIGMA_FLOOR, sigmas.field))
    with_field, without_field = (
        posterior_mode_step(views, each_sigmas).shared for each_sigmas in (sigmas, white_sigmas)
    )
    return tuple(map(float, (with_field - without_field)[indices]))
