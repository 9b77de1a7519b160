"""Fit all parameters of the chain to every observation in one nonlinear least squares problem."""

import dataclasses
import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool

from ..argument_checks import require_instance, require_one_of
from ..calibration import SHAPE_NAMES, Calibration, TargetShape
from ..cameras import AbstractLens
from ..dataset import (
    Dataset,
    PoseDataset,
    chain_residuals,
    digests_to_keep,
    repeated_views,
)
from ..engine import (
    ROBOT_ERROR,
    AbstractLoss,
    BlockArrow,
    BuiltProblem,
    JointProblem,
    Noise,
    NormalEquations,
    ParameterChoice,
    Prior,
    ScaledJacobian,
    Solution,
    Step,
    build_problem,
    covariance,
    observability,
    per_view_std,
    reduced_equations,
    robust_variance,
    solve,
    solve_on,
    solve_with_estimated_sigma,
    squared_residuals,
    variance_factor,
    with_lens,
)
from ..fit_result import FitCode, FitResult, Rejection
from ..robot_errors import (
    AbstractField,
    FieldChoice,
    RobotError,
    RobotPrior,
    checked_field_choice,
)
from ..runtime.array_namespace import to_device
from ..runtime.blas_threads import on_one_blas_thread
from ..runtime.compilation import refuse_traced
from ..runtime.modules import with_fields
from ..staged import with_region
from ..variance import NoiseEstimate, estimate_noise
from .fitted_depth_sensor import fitted_depth_sensor, weighed_depths
from .gross_errors import remove_gross_errors, without_views
from .held_parameters import HeldValueTest, held_value_test
from .joint_fit import JointFit
from .plausibility import plausibility_warnings
from .undetermined import require_moving_robot, undetermined_motion, with_undetermined
from .view_rejection import (
    inconsistent_view,
    inflation_reason,
    judging_prior,
    suspect_view,
)

_log = logging.getLogger(__name__)

MAX_INLIER_CHI_SQUARE = 2.0 * np.log(1e4)
"""Squared whitened residual that one good point in ten thousand exceeds (chi-square, 2 dof)."""

GROSS_ERRORS_OPTIONS = ("auto", "keep", "leave_out")
"""The accepted values of `gross_errors`."""

MAX_SIGMA_FITS = 10
"""The largest number of fits with the pixel sigma re-estimated from the residuals."""

SIGMA_TOLERANCE = 1e-3
"""The relative change of the pixel sigma below which refitting stops."""


@on_one_blas_thread
def fit_joint(
    data: Dataset,
    start: Calibration,
    *,
    lens: str | AbstractLens | None = None,
    noise: str | Noise = "estimated",
    field: FieldChoice = "auto",
    loss: str | AbstractLoss | None = None,
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    solver: optx.AbstractLeastSquaresSolver[Any, Any, Any, Any] | None = None,
    devices: Sequence[Any] | None = None,
    gross_errors: str = "auto",
    inliers: Bool[Array, "views points"] | Bool[np.ndarray, "views points"] | None = None,
    progress: Callable[[str], None] | None = None,
    robot_prior: RobotPrior | None = None,
) -> JointFit:
    """Fit camera, hand-eye transform, target pose and optional parameters to all pixels at once.

    Args:
        data: at least three views with four visible points each, unless priors determine the rest.
        start: a calibration near the solution, such as the staged fit's.
        lens: a lens model that differs from the start's.
        noise: `"estimated"` estimates the variance components, and chooses a robot error field, by
            restricted likelihood; a `Noise` states the standard deviations and gives every view a
            pose correction with a prior; `"trusted"` takes the reported poses as exact.
        field: the robot error field: one of `robot_errors`, or a custom one; None for none.
            `"auto"` averages over models by likelihood if the noise is estimated, and otherwise
            keeps the start's field fixed.
        loss: robust loss on the points: a name or an `AbstractLoss`. Its scale, and the weight of
            priors, are relative to the pixel sigma: the noise model's or, with a trusted robot,
            estimated from the residuals.
        fixed: paths of parameters that keep the start's value.
        free: paths to free that are held by default: `"target_scale"`.
        priors: a `Prior` by path.
        solver: any optimistix least-squares solver; by default `StructuredLM`.
        devices: devices over which the views are distributed, such as `jax.devices()`, also of
            other processes; by default the fit runs on one.
        gross_errors: `"leave_out"` leaves out gross outliers and views whose pose contradicts the
            others, and lists them in `rejected`; `"keep"` uses all data; `"auto"` leaves out if
            the noise is estimated.
        inliers: mask of the visible observations to fit, such as the inliers of an earlier step; by
            default all. Residuals are reported for all observations.
        progress: called with a line of text for each stage.
        robot_prior: prior on the standard deviations of the robot's errors, for estimated noise; by
            default for good industrial arms.

    Raises:
        TypeError: an argument of a wrong type.
        ValueError: an unknown path or name, too few views, or a start at which no point of a view
            can be projected.

    For example:

        >>> joint = sv.fit_joint(data, truth, noise=noise, fixed=("camera",))
        >>> print(joint.result.message, len(joint.parameter_names))
        converged in 3 steps 12
    """
    require_one_of("gross_errors", gross_errors, GROSS_ERRORS_OPTIONS)
    refuse_traced("fit_joint", data, start)
    require_instance("data", data, Dataset)
    if isinstance(data, PoseDataset) and "camera" not in fixed:
        raise TypeError("data: tracked poses are fitted by fit_poses; found a PoseDataset")
    require_instance("start", start, Calibration, "a fit has its calibration as `.calibration`")
    if solver is not None:
        hint = "such as optimistix.LevenbergMarquardt(rtol, atol)"
        require_instance("solver", solver, optx.AbstractLeastSquaresSolver, hint)
    field, all_data = checked_field_choice(field), data
    choice = ParameterChoice.of(fixed, free, priors)
    if start.base_from_other_base is not None:
        data = data.with_bases(start.base_from_other_base)
    if inliers is not None:
        data = data.with_visible(np.asarray(data.visible) & np.asarray(inliers))
    require_moving_robot(data, start, choice)
    has_pixels = not isinstance(data, PoseDataset)
    if has_pixels:
        data = without_views(data, repeated_views(data))
    report, start = progress or (lambda _: None), with_lens(start, lens)
    # The engine works with true points; the shape is estimated with the noise.
    stated_shape = None if noise == "estimated" else start.target_shape
    start = with_fields(start, target_shape=None)

    keeps_all = gross_errors == "keep" or (gross_errors == "auto" and noise != "estimated")
    used_data, rejected_points = data, ()
    if has_pixels and not keeps_all:
        used_data, rejected_points = remove_gross_errors(data, start, fixed, priors, progress)

    def fit_once(
        data: Dataset,
        robot_prior: RobotPrior | None = robot_prior,
        noise_estimate: NoiseEstimate | None = None,
    ) -> tuple[JointFit, BlockArrow]:
        initial, noise_model, error_field, shape = start, noise, field, stated_shape
        open_motion = undetermined_motion(data, start, choice)
        chosen = choice.holding(*open_motion.held)
        data = weighed_depths(data, start, chosen, noise, field)
        if noise == "estimated":
            noise_estimate = noise_estimate or estimate_noise(
                data,
                initial,
                field=field,
                **chosen._asdict(),
                progress=progress,
                robot_prior=robot_prior,
            )
            initial, noise_model, error_field, unused = _embedded(noise_estimate)
            if noise_estimate.target_shape is not None:
                shape = noise_estimate.target_shape.shape
            # The target's size is averaged over models if the views may contradict the stated size.
            chosen = chosen.holding(*unused).freeing(*noise_estimate.free)
            chosen = chosen._replace(priors=chosen.priors | noise_estimate.priors(start))
        if shape is not None:
            data = with_fields(data, points=to_device(shape.displaced(data.points)))
        built = build_problem(
            data,
            initial,
            noise=noise_model,
            loss=loss,
            **chosen._asdict(),
            field=error_field,
        )
        # The estimate of the noise moves the start, but not the centre of the priors.
        built = built.with_prior_centre(start)
        if noise_estimate is not None and noise_estimate.noise_corrections is not None:
            built = built.with_noise_corrections(noise_estimate.noise_corrections)
        if noise_estimate is not None and noise_estimate.directions is not None:
            built = built.with_correction_roots(noise_estimate.directions.roots)
        count = (
            f"{data.observation_count} points"
            if has_pixels
            else f"{len(data.usable_views())} pairs of poses"
        )
        report(f"joint fit: {len(built.shared_names)} shared parameters, {count}")

        # Levenberg-Marquardt on whitened residuals, with C a 6 x 6 block C_v per view:
        #     (H + lambda I) step = -g,  H = [[A, B^T], [B, C]]
        # Per step tried: one linearisation. Per damping lambda: one Cholesky factor of
        #     A + lambda I - sum_v B_v^T (C_v + lambda I)^-1 B_v
        def solve_problem(problem: JointProblem, step: Step) -> tuple[Solution, NormalEquations]:
            if devices is None:
                return solve(problem, solver, start=step)
            return solve_on(devices, problem, solver, start=step)

        if built.sigma_known or not built.depends_on_sigma:
            solution, equations = solve_problem(built.problem, built.problem.zero_step())
        else:
            problem, solution, equations, _ = solve_with_estimated_sigma(
                built.problem, solve_problem, variance_factor, SIGMA_TOLERANCE, MAX_SIGMA_FITS
            )
            built = with_fields(built, problem=problem)
        _log.info("%d steps to a cost of %.6g", solution.steps, solution.costs[-1])
        joint_fit = _assemble_fit(
            data, built, solution, equations, noise_estimate, rejected_points, shape
        )
        return with_undetermined(joint_fit, open_motion), equations.matrix

    # Gross errors first, then one view at a time: a view rejected by its posterior pose correction
    # or, if all poses look poor, the view without which the pose standard deviations collapse.
    # After each view the noise is estimated again, since one wrong pose inflates it for all views.
    accepted, matrix = fit_once(used_data)
    first, first_data, judging = accepted, used_data, robot_prior
    estimate = accepted.noise_estimate
    if estimate is not None and estimate.alike is not None:
        judging = judging_prior(robot_prior)
        accepted, matrix = fit_once(used_data, judging, estimate.alike)
    while not keeps_all:
        # The view is left out, not down-weighted: a pose of another picture has no information.
        if (inconsistent := inconsistent_view(used_data, accepted, matrix)) is not None:
            wrong = dict([inconsistent])
        elif (suspect := suspect_view(used_data, accepted, matrix)) is not None:
            # One wrong pose inflates the pose standard deviations of all views, so that no view
            # fails the test. Compare the fits with and without the suspect instead.
            refitted, _ = fit_once(without_views(used_data, {suspect: ""}), judging)
            if (reason := inflation_reason(accepted.noise, refitted.noise)) is None:
                break
            wrong = {suspect: reason}
        else:
            break
        used_data = without_views(used_data, wrong)
        accepted, matrix = fit_once(used_data, judging)
    judged = accepted
    if judging is not robot_prior:
        accepted = first if used_data is first_data else fit_once(used_data)[0]
    stated = None if isinstance(used_data, PoseDataset) else held_value_test(judged)
    return _finish_fit(accepted, used_data, all_data, stated)


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
    names = () if estimate.field is None else tuple(name for name, _ in estimate.field.groups)
    sigmas = dict(zip(names, estimate.noise.field, strict=True))
    groups = [name for name, _ in field.groups]
    return (
        with_fields(calibration, robot_error=embedded),
        # The standard deviation of a held group has no effect.
        dataclasses.replace(estimate.noise, field=tuple(sigmas.get(name, 1.0) for name in groups)),
        field,
        tuple(f"{ROBOT_ERROR}.{name}" for name in groups if name not in sigmas),
    )


def _finish_fit(
    fit: JointFit, used_data: Dataset, all_data: Dataset, stated: HeldValueTest | None
) -> JointFit:
    """Return the fit with the residuals of all data, its region of viewpoints and its warnings."""
    # Residuals include rejected observations. The region is added after they are computed, because
    # it changes the structure of the calibration, and so would need a new program.
    residuals = to_device(chain_residuals(fit.calibration, all_data.observations))
    calibration = with_region(fit.calibration, used_data)
    digests = () if isinstance(all_data, PoseDataset) else digests_to_keep(all_data)
    fit = with_fields(fit, residuals=residuals, calibration=calibration, picture_digests=digests)
    if stated is None or not stated.warnings:
        return with_fields(fit, warnings=plausibility_warnings(fit))
    # The warnings judge what the views tell: more views do not narrow what wrong values widen.
    warnings = plausibility_warnings(fit, stated.warnings)
    wider = stated.widened(fit.covariance, fit.std, fit.parameter_names)
    return with_fields(fit, covariance=wider[0], std=wider[1], warnings=warnings)


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
    squares, visible = squared_residuals(problem, chain), np.asarray(problem.observations.visible)
    factor = 1.0 if built.sigma_known else float(variance_factor(problem, squares))
    reduced = reduced_equations(equations.matrix)

    # Covariance f R^-1, with R the Schur complement of the corrections, f the variance factor.
    # Scaling to unit columns makes the singular values independent of units.
    column_norms = np.sqrt(np.diagonal(np.asarray(equations.matrix.shared)))
    scaled_jacobian = ScaledJacobian(reduced.schur_complement, column_norms)
    common_covariance, std = covariance(scaled_jacobian, factor)
    degrees_of_freedom = np.full(len(std), np.inf)
    if noise_estimate is not None:
        # Estimated variance components add the Kenward-Roger term and finite degrees of freedom;
        # uncertainty between models adds a covariance.
        small_sample = noise_estimate.correction_of(built.shared_names)
        added = small_sample.added_covariance
        added = added + noise_estimate.covariance_of_choices(built.shared_names)
        common_covariance = common_covariance + added
        degrees_of_freedom = small_sample.degrees_of_freedom
        std = np.sqrt(std**2 + np.diagonal(added))
    # Corrections: diag(f C_v^-1 + G_v P G_v^T), with G_v = C_v^-1 B_v and P the common covariance.
    correction_std = per_view_std(
        reduced,
        common_covariance,
        factor,
        problem.host_correction_roots,
    )
    correction_std = correction_std[np.asarray(problem.per_view_free)]

    # The robust variance widens the gate if residuals are larger than the noise model states.
    residual_variance = float(robust_variance(squares, visible))
    gate = MAX_INLIER_CHI_SQUARE * (
        max(1.0, residual_variance) if built.sigma_known else residual_variance
    )
    names = (*built.shared_names, *built.per_view_names)
    shape_std, shape_freedom = _shape_uncertainty(noise_estimate)
    # The robot error of the result has only the groups that were fitted.
    calibration, error = chain.calibration, chain.calibration.robot_error
    if noise_estimate is not None and error is not None:
        field = noise_estimate.field
        error = None if field is None else error.converted_to(field)
        calibration = with_fields(calibration, robot_error=error)
    calibration = with_fields(calibration, target_shape=shape)
    return JointFit(
        calibration=calibration,
        covariance=common_covariance,
        pixel_sigma=float(problem.pixel_sigma) * float(np.sqrt(factor)),
        residuals=data.pixels,
        inliers=to_device(visible & (squares <= gate)),
        pose_corrections=to_device(
            chain.pose_corrections
            if len(chain.pose_corrections)
            else np.zeros((data.view_count, 6))
        ),
        field_corrections=to_device(chain.field_corrections),
        start=problem.parameters.start if noise_estimate is None else noise_estimate.calibration,
        problem=problem,
        solution=solution,
        std=dict(zip(names, map(float, (*std, *correction_std)), strict=True)) | shape_std,
        degrees_of_freedom={
            **dict(zip(built.shared_names, map(float, degrees_of_freedom), strict=True)),
            **shape_freedom,
        },
        noise=built.noise if noise_estimate is None else noise_estimate.noise,
        noise_estimate=noise_estimate,
        rejected=_all_rejections(data, rejected_points, built.unprojectable),
        observability=observability(scaled_jacobian, built.shared_names, chain.calibration),
        parameter_names=built.shared_names,
        view_ids=data.view_ids,
        result=solver_result(solution),
        sensor=fitted_depth_sensor(data, calibration, built.shared_names, common_covariance),
    )


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
