"""Estimate the noise model of a rig: one robot's errors from all cameras together."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration import Calibration
from ..dataset import Rig
from ..engine import (
    BuiltRig,
    Noise,
    ParameterChoice,
    Step,
    build_problem,
    build_rig,
    is_size,
    rig_parameter_names,
    solve,
)
from ..robot_errors import AbstractField, FieldChoice, RobotPrior
from ..runtime.blas_threads import on_one_blas_thread
from .averaged_fit import SecondPass, average_over_models, averaged_noise
from .directional_fit import fit_by_direction
from .directional_noise import DirectionalNoise, largest_noise
from .fisher_scoring import StandardDeviationPrior
from .free_poses import choice_for_free_poses, fit_free_poses
from .kenward_roger import SmallSampleCorrection
from .model_comparison import (
    Linearisation,
    ModelComparison,
    RequestedModels,
    compared_at,
    likeliest_white_noise,
    linearised_at_mode,
    target_scale_evidence,
    tested_sizes,
)
from .model_selection import (
    encompassing_field,
    initial_standard_deviations,
    standard_deviation_prior,
)
from .noise_estimate import CandidateResult, TargetScaleEvidence
from .standard_deviations import ROBOT_SIGMA_FLOOR, StandardDeviations
from .view_statistics import ViewStatistics, with_prior_sigmas


class CameraNoise(NamedTuple):
    """The noise of one camera, as far as its pictures alone tell it.

    Attributes:
        sum_of_squares: sum of squared residuals with a free pose for every view, px^2.
        pose_parameters: number of free parameters of these poses.
        pixel_sigma: standard deviation of u and of v about these poses, px.
    """

    sum_of_squares: float
    pose_parameters: int
    pixel_sigma: float


class RigNoiseEstimate(NamedTuple):
    """The noise model of a rig, averaged over models of the robot error by their probabilities.

    Attributes:
        name: name of the most probable model.
        noise: standard deviations of all errors in the averaged model.
        field: robot error field; None if the views need none.
        relative_sigmas: factor on the pixel sigma of each camera.
        candidates: all models of the robot error that were tried.
        target_scales: evidence on each target's size that was tested, by the parameter's name.
        converged: whether the standard deviations converged.
        built: the problem of the averaged model, with its standard deviations as priors.
        step: its solution.
        small_sample_correction: contribution of the uncertain standard deviations to the
            covariance of the shared parameters.
        between_models_covariance: covariance of the shared parameters between the models; in both
            the ratio of focal lengths is in the place of alpha_v where it is fitted.
        directions: the directions in which the robot's poses err most; None if they err alike in
            all. The standard deviations of poses in `noise` are then means over the axes.
        alike: the estimate for errors that are alike in all directions; None if this is it.
    """

    name: str
    noise: Noise
    field: AbstractField | None
    relative_sigmas: dict[str, float]
    candidates: tuple[CandidateResult, ...]
    target_scales: Mapping[str, TargetScaleEvidence]
    converged: bool
    built: BuiltRig
    step: Step
    small_sample_correction: SmallSampleCorrection
    between_models_covariance: Float[np.ndarray, "shared shared"]
    directions: DirectionalNoise | None = None
    alike: "RigNoiseEstimate | None" = None

    @property
    def largest_noise(self) -> Noise:
        """The noise, with the sizes of the poses' errors in the directions of the largest."""
        return largest_noise(self.noise, self.directions)


def estimate_rig_noise(
    rig: Rig,
    starts: Mapping[str, Calibration],
    *,
    field: FieldChoice = "auto",
    choice: ParameterChoice,
    progress: Callable[[str], None] | None = None,
    robot_prior: RobotPrior | None = None,
) -> RigNoiseEstimate:
    """Estimate the standard deviations of all errors of a rig by restricted likelihood.

    The pictures of each camera tell its own noise; one factor of all of them, the noise of the
    robot's poses and the sizes of its errors are estimated from all cameras together.

    Args:
        rig: data sets of the cameras.
        starts: calibration of each camera near the solution, as for `build_rig`.
        field: as in `estimate_noise`.
        choice: parameters to hold and to make free, and their priors, by the names of `build_rig`.
        progress: function that is called with a message on the current step.
        robot_prior: prior of the standard deviations of an arm's errors.
    """
    report, prior = progress or (lambda _: None), robot_prior or RobotPrior()
    cameras = {name: _camera_noise(rig, name, start) for name, start in starts.items()}
    first, relative = _compare(rig, starts, cameras, field, choice, prior)
    poses = sum(camera.pose_parameters for camera in cameras.values())
    second = average_over_models(first, choice.fixed, prior, poses, report)
    alike = _estimate_of(first, second, relative, prior)
    # Where no smooth error was compared, what follows the states would be taken for directions.
    by_direction = None if field is None else fit_by_direction(second, prior)
    if by_direction is None:
        return alike
    return _estimate_of(first, by_direction, relative, prior)._replace(alike=alike)


def _estimate_of(
    first: ModelComparison, second: SecondPass, relative: dict[str, float], prior: RobotPrior
) -> RigNoiseEstimate:
    """Return the estimate, given the fit of the averaged model.

    Args:
        first: the comparison of the models.
        second: the fit.
        relative: factor on the pixel sigma of each camera.
        prior: prior of the standard deviations of an arm's errors.
    """
    average, built = second.average, second.built
    assert isinstance(built, BuiltRig)
    target_scales = {
        **first.target_scales,
        **target_scale_evidence(
            built, average.views, average.z, average.fitted, average.probabilities
        ),
    }
    # The problem has the field that contains all models, and priors of these standard deviations.
    problem = with_prior_sigmas(
        second.views.with_noise_corrections(average.noise_corrections).problem,
        average.maximum.sigmas,
        second.views.group_index,
    )
    return RigNoiseEstimate(
        max(second.field_probabilities, key=lambda name: second.field_probabilities[name]),
        averaged_noise(average, second.views, second.field, prior),
        second.field,
        relative,
        first.candidates,
        target_scales,
        average.converged,
        dataclasses.replace(built, problem=problem),
        average.z,
        average.small_sample_correction,
        average.between_models_covariance,
        average.directions,
    )


def _camera_noise(rig: Rig, name: str, start: Calibration) -> CameraNoise:
    """Return the noise of one camera, as far as its pictures alone tell it.

    With one or two views it is the noise about the lens of the start.
    """
    data = rig.cameras[name]
    usable = data.usable_views()
    # The field has no effect, but with it the fit shares the program that removed gross errors.
    field = encompassing_field(data, len(usable)) if data.arm is None else None
    noise = Noise(1.0, 1.0, 1.0).with_unit_groups(field)
    choice = choice_for_free_poses(ParameterChoice.of(), start, len(usable))
    built = build_problem(data, start.uncorrected, noise=noise, field=field, **choice._asdict())
    fit = fit_free_poses(built, usable, None)
    poses = built.pose_parameters(usable)
    views = ViewStatistics(built, poses, fit.sum_of_squares)
    return CameraNoise(fit.sum_of_squares, poses, views.white_sigma)


@on_one_blas_thread
def _compare(
    rig: Rig,
    starts: Mapping[str, Calibration],
    cameras: Mapping[str, CameraNoise],
    field: FieldChoice,
    choice: ParameterChoice,
    prior: RobotPrior,
) -> tuple[ModelComparison, dict[str, float]]:
    """Compare the models of the robot error, as `compare_models` does for one camera.

    Returns:
        The comparison, and the factor on the pixel sigma of each camera.
    """
    requested = RequestedModels.of(field, rig, len(rig.view_ids), prior)
    names = rig_parameter_names(rig, starts)
    sizes = {name: None for of_camera in names.values() for name in of_camera if is_size(name)}
    tested, basis = tested_sizes(sizes, choice, prior, rig), requested.basis
    # In units of each camera's own noise, so that none outweighs the others.
    reference = float(np.sqrt(np.mean([camera.pixel_sigma**2 for camera in cameras.values()])))
    relative = {name: camera.pixel_sigma / reference for name, camera in cameras.items()}
    within = sum(camera.sum_of_squares / relative[name] ** 2 for name, camera in cameras.items())
    built = build_rig(
        rig,
        starts,
        noise=requested.unit_noise,
        field=basis,
        relative_sigmas=relative,
        **choice.freeing(*tested)._asdict(),
    )
    poses = sum(camera.pose_parameters for camera in cameras.values())
    views = ViewStatistics(built, poses, within, tested)
    sigma_prior = standard_deviation_prior(prior, basis, views.group_names)
    initial = initial_standard_deviations(sigma_prior, views.initial_sigma)
    linearisation = _linearised(built, views, initial, sigma_prior, prior)
    comparison = compared_at(
        linearisation, requested, initial, sigma_prior, prior.wrong_target_probability
    )
    return comparison, relative


def _linearised(
    built: BuiltRig,
    views: ViewStatistics,
    initial: StandardDeviations,
    sigma_prior: StandardDeviationPrior,
    prior: RobotPrior,
) -> Linearisation:
    """Linearise the views at the fit with white noise of the poses alone."""
    without_field = initial._replace(field=np.full_like(initial.field, ROBOT_SIGMA_FLOOR))
    problem = with_prior_sigmas(views.problem, without_field, views.group_index)
    solution, equations = solve(problem)
    at_start = views.linearised_at_fit(problem, solution.z, equations)
    white = likeliest_white_noise(at_start, views.group_names, initial, sigma_prior, prior)
    return Linearisation(
        built, *linearised_at_mode(views, built.shared_names, solution.z, at_start, white)
    )
