"""Fit all views of a data set as they are: estimate the noise, build the problem and solve it."""

import dataclasses
import logging
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
import optimistix as optx
from jaxtyping import Bool, Float

from ..calibration import SHAPE_NAMES, Calibration, TargetShape
from ..dataset import Dataset, PoseDataset
from ..engine import (
    ROBOT_ERROR,
    AbstractLoss,
    BlockArrow,
    BuiltProblem,
    FitCovariance,
    JointProblem,
    Noise,
    NormalEquations,
    ParameterChoice,
    Solution,
    Step,
    build_problem,
    observability,
    robust_variance,
    solve,
    solve_on,
    solve_with_estimated_sigma,
    squared_residuals,
    variance_factor,
)
from ..fit_result import FitCode, FitResult, Rejection
from ..robot_errors import AbstractField, FieldChoice, RobotError, RobotPrior
from ..runtime.array_namespace import AnyArray, to_device
from ..runtime.modules import with_fields
from ..variance import NoiseEstimate, estimate_noise
from .fitted_depth_sensor import fitted_depth_sensor, weighed_depths
from .joint_fit import JointFit
from .undetermined import undetermined_motion, with_undetermined

_log = logging.getLogger(__name__)

MAX_INLIER_CHI_SQUARE = 2.0 * np.log(1e4)
"""Squared whitened residual that one good point in ten thousand exceeds (chi-square, 2 dof)."""

MAX_SIGMA_FITS = 10
"""The largest number of fits with the pixel sigma re-estimated from the residuals."""

SIGMA_TOLERANCE = 1e-3
"""The relative change of the pixel sigma below which refitting stops."""


class FitOptions(NamedTuple):
    """The options of `fit_joint` that do not depend on which views are left out.

    Attributes:
        start: a calibration near the solution, with the lens to fit, and without a target's shape.
        choice: parameters to hold and to free, and priors.
        noise: `"estimated"`, `"trusted"` or the noise.
        field: robot error field.
        loss: robust loss on the points.
        solver: any optimistix least-squares solver; None for the default one.
        devices: devices over which the views are distributed; None for the default one.
        target_shape: shape of the target, if it is stated.
        rejected_points: points that were left out before, for the result.
        progress: called with a line of text for each stage.
    """

    start: Calibration
    choice: ParameterChoice
    noise: str | Noise
    field: FieldChoice
    loss: str | AbstractLoss | None
    solver: optx.AbstractLeastSquaresSolver[Any, Any, Any, Any] | None
    devices: Sequence[Any] | None
    target_shape: TargetShape | None
    rejected_points: tuple[Rejection, ...]
    progress: Callable[[str], None]


class ViewFit(NamedTuple):
    """A joint fit, and the matrix of its normal equations.

    Attributes:
        fit: the fit.
        matrix: matrix of the normal equations at the solution.
    """

    fit: JointFit
    matrix: BlockArrow


def fit_views(
    data: Dataset,
    options: FitOptions,
    robot_prior: RobotPrior | None,
    noise_estimate: NoiseEstimate | None = None,
) -> ViewFit:
    """Fit all usable views of a data set.

    Args:
        data: the data.
        options: the options of the fit.
        robot_prior: prior on the sizes of the robot's errors, for estimated noise.
        noise_estimate: estimate of the noise from these data, if it is known already.
    """
    start, choice, noise, field, *_ = options
    open_motion = undetermined_motion(data, start, choice)
    choice = choice.holding(*open_motion.held)
    data = weighed_depths(data, start, choice, noise, field)
    if noise == "estimated" and noise_estimate is None:
        noise_estimate = estimate_noise(
            data,
            start,
            field=field,
            **choice._asdict(),
            progress=options.progress,
            robot_prior=robot_prior,
        )
    shape = options.target_shape
    if noise_estimate is not None and noise_estimate.target_shape is not None:
        shape = noise_estimate.target_shape.shape
    if shape is not None:
        data = with_fields(data, points=to_device(shape.displaced(data.points)))
    built = _built(data, options._replace(choice=choice), noise_estimate)
    count = (
        f"{len(data.usable_views())} pairs of poses"
        if isinstance(data, PoseDataset)
        else f"{data.observation_count} points"
    )
    options.progress(f"joint fit: {len(built.shared_names)} shared parameters, {count}")
    built, solution, equations = _solved(built, options)
    _log.info("%d steps to a cost of %.6g", solution.steps, solution.costs[-1])
    fit = _assemble_fit(
        data, built, solution, equations, noise_estimate, options.rejected_points, shape
    )
    return ViewFit(with_undetermined(fit, open_motion), equations.matrix)


def _built(data: Dataset, options: FitOptions, estimate: NoiseEstimate | None) -> BuiltProblem:
    """Build the problem, from the estimate of the noise if there is one."""
    start, choice, noise, field, loss, *_ = options
    initial = start
    if estimate is not None:
        initial, noise, field, unused = _embedded(estimate)
        # The target's size is averaged over models if the views may contradict the stated size.
        choice = choice.holding(*unused).freeing(*estimate.free)
        choice = choice._replace(priors=choice.priors | estimate.priors(start))
    built = build_problem(data, initial, noise=noise, loss=loss, **choice._asdict(), field=field)
    # The estimate of the noise moves the start, but not the centre of the priors.
    built = built.with_prior_centre(start)
    if estimate is not None and estimate.noise_corrections is not None:
        built = built.with_noise_corrections(estimate.noise_corrections)
    if estimate is not None and estimate.directions is not None:
        built = built.with_correction_roots(estimate.directions.roots)
    return built


def _solved(
    built: BuiltProblem, options: FitOptions
) -> tuple[BuiltProblem, Solution, NormalEquations]:
    """Solve the problem; return it with the pixel sigma that it was solved with.

    Levenberg-Marquardt on whitened residuals, with C a 6 x 6 block C_v per view:
        (H + lambda I) step = -g,  H = [[A, B^T], [B, C]]
    Per step tried: one linearisation. Per damping lambda: one Cholesky factor of
        A + lambda I - sum_v B_v^T (C_v + lambda I)^-1 B_v
    """

    def solve_problem(problem: JointProblem, step: Step) -> tuple[Solution, NormalEquations]:
        if options.devices is None:
            return solve(problem, options.solver, start=step)
        return solve_on(options.devices, problem, options.solver, start=step)

    if built.sigma_known or not built.depends_on_sigma:
        return built, *solve_problem(built.problem, built.problem.zero_step())
    problem, solution, equations, _ = solve_with_estimated_sigma(
        built.problem, solve_problem, variance_factor, SIGMA_TOLERANCE, MAX_SIGMA_FITS
    )
    return with_fields(built, problem=problem), solution, equations


def _embedded(
    estimate: NoiseEstimate,
) -> tuple[Calibration, Noise, AbstractField | None, tuple[str, ...]]:
    """Expand the estimate to the largest field, with unused groups held at zero.

    So all fits of a calibration share one compiled program.

    Returns:
        The calibration, the noise, the field, and the paths of the groups to hold at zero.
    """
    field, calibration = estimate.encompassing_field, estimate.calibration
    if field is None:
        return calibration, estimate.noise, None, ()
    error = calibration.robot_error
    embedded = RobotError.zero(field) if error is None else error.converted_to(field)
    names = () if estimate.field is None else estimate.field.group_names
    sigmas = dict(zip(names, estimate.noise.field, strict=True))
    groups = field.group_names
    return (
        with_fields(calibration, robot_error=embedded),
        # The standard deviation of a held group has no effect.
        dataclasses.replace(estimate.noise, field=tuple(sigmas.get(name, 1.0) for name in groups)),
        field,
        tuple(f"{ROBOT_ERROR}.{name}" for name in groups if name not in sigmas),
    )


def _assemble_fit(
    data: Dataset,
    built: BuiltProblem,
    solution: Solution,
    equations: NormalEquations,
    noise_estimate: NoiseEstimate | None,
    rejected_points: tuple[Rejection, ...],
    shape: TargetShape | None,
) -> JointFit:
    """Build the result: covariances, degrees of freedom, inliers and rejections at the solution."""
    problem, chain = built.problem, solution.chain
    squares = squared_residuals(problem, chain)
    factor = 1.0 if built.sigma_known else float(variance_factor(problem, squares))
    uncertainty = _uncertainty(built, solution.z, equations, factor, noise_estimate)
    shape_std, shape_freedom = _shape_uncertainty(noise_estimate)
    calibration = _fitted_calibration(chain.calibration, noise_estimate, shape)
    corrections = chain.pose_corrections
    return JointFit(
        calibration=calibration,
        covariance=uncertainty.shared,
        pixel_sigma=float(problem.pixel_sigma) * float(np.sqrt(factor)),
        residuals=data.pixels,
        inliers=to_device(_inliers(built, squares)),
        pose_corrections=to_device(
            corrections if len(corrections) else np.zeros((data.view_count, 6))
        ),
        field_corrections=to_device(chain.field_corrections),
        start=problem.parameters.start if noise_estimate is None else noise_estimate.calibration,
        problem=problem,
        solution=solution,
        std=uncertainty.std_by_name(built) | shape_std,
        degrees_of_freedom=uncertainty.freedom_by_name(built) | shape_freedom,
        noise=built.noise if noise_estimate is None else noise_estimate.noise,
        noise_estimate=noise_estimate,
        rejected=_all_rejections(data, rejected_points, built.unprojectable),
        observability=observability(uncertainty.jacobian, built.shared_names, chain.calibration),
        parameter_names=built.shared_names,
        view_ids=data.view_ids,
        result=solver_result(solution),
        sensor=fitted_depth_sensor(data, calibration, built.shared_names, uncertainty.shared),
    )


def _uncertainty(
    built: BuiltProblem,
    z: Step,
    equations: NormalEquations,
    variance_factor: float,
    noise_estimate: NoiseEstimate | None,
) -> FitCovariance:
    """Return the covariance of the fit, with what an estimate of the noise adds.

    Estimated variance components add the Kenward-Roger term and finite degrees of freedom, and
    uncertainty between models adds a covariance.
    """
    by_fitted = built.problem.host_named_by_fitted(z)
    uncertainty = FitCovariance.of(equations.matrix, variance_factor).by_names(by_fitted)
    if noise_estimate is None:
        return uncertainty
    small_sample = noise_estimate.correction_of(built.shared_names)
    added = small_sample.added_covariance
    added = added + noise_estimate.covariance_of_choices(built.shared_names)
    return uncertainty.with_added(added, small_sample.degrees_of_freedom)


def _inliers(
    built: BuiltProblem, squares: Float[AnyArray, "views points"]
) -> Bool[np.ndarray, "views points"]:
    """Return the points that agree with the fit, from their squared whitened residuals."""
    visible = np.asarray(built.problem.observations.visible)
    # The robust variance widens the gate if residuals are larger than the noise model states.
    variance = float(robust_variance(squares, visible))
    gate = MAX_INLIER_CHI_SQUARE * (max(1.0, variance) if built.sigma_known else variance)
    return visible & np.asarray(squares <= gate)


def _fitted_calibration(
    calibration: Calibration, noise_estimate: NoiseEstimate | None, shape: TargetShape | None
) -> Calibration:
    """Return the calibration with the shape, and with those robot errors that were fitted."""
    error = calibration.robot_error
    if noise_estimate is not None and error is not None:
        field = noise_estimate.field
        error = None if field is None else error.converted_to(field)
        calibration = with_fields(calibration, robot_error=error)
    return with_fields(calibration, target_shape=shape)


def _shape_uncertainty(
    noise_estimate: NoiseEstimate | None,
) -> tuple[dict[str, float], dict[str, float]]:
    """Return standard deviations and degrees of freedom of the target's shape, by name."""
    if noise_estimate is None or noise_estimate.target_shape is None:
        return {}, {}
    names = noise_estimate.parameter_names[-len(SHAPE_NAMES) :]
    small_sample = noise_estimate.correction_of(names)
    covariance = noise_estimate.covariance_of_choices(names) + small_sample.added_covariance
    return (
        dict(zip(names, map(float, np.sqrt(np.diagonal(covariance))), strict=True)),
        dict(zip(names, map(float, small_sample.degrees_of_freedom), strict=True)),
    )


def _all_rejections(
    data: Dataset, rejected_points: tuple[Rejection, ...], unprojectable: np.ndarray
) -> tuple[Rejection, ...]:
    """Return all rejections: whole views, single points, and points that cannot be projected."""
    view_rejections = [Rejection(view, None, reason) for view, reason in data.masked_views]
    unprojectable_rejections = [
        Rejection(data.view_ids[view], int(point), "cannot be projected from the start")
        for view, point in np.argwhere(unprojectable)
    ]
    return (*view_rejections, *rejected_points, *unprojectable_rejections)


def solver_result(solution: Solution) -> FitResult:
    """Return whether the solver converged, with a message."""
    # Only the solution is checked: a calibration may contain infinite joint limits of an arm.
    finite = all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(solution.z))
    if not finite:
        return FitResult(FitCode.DIVERGED, "the fit diverged: its parameters are not finite")
    if solution.converged:
        return FitResult(FitCode.CONVERGED, f"converged in {solution.steps} steps")
    return FitResult(
        FitCode.STOPPED_EARLY,
        f"not converged after {solution.steps} steps: one more would still lower the cost by a "
        f"fraction of {solution.relative_decrease:.1g}; see `observability`, hold more parameters, "
        "or add a prior",
    )
