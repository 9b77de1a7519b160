"""Fit all parameters of the chain to every observation in one nonlinear least squares problem."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float
from scipy.special import ndtri, stdtrit

from ..calibration import Calibration
from ..cameras import AbstractLens
from ..compilation import compiled
from ..dataset import MINIMUM_RELIABLE_VIEWS, Dataset, chain_residuals
from ..deprecation import DeprecatedAttribute, warn_deprecated
from ..engine import (
    AbstractLoss,
    BlockArrow,
    BuiltProblem,
    JointProblem,
    Noise,
    NormalEquations,
    Observability,
    Parameters,
    Prior,
    ScaledJacobian,
    Solution,
    Step,
    build_problem,
    covariance,
    eliminate,
    observability,
    parameter_mask,
    parameter_names,
    per_view_std,
    robust_variance,
    solve,
    solve_on,
    variance_factor,
    with_lens,
)
from ..fit_result import FitCode, FitResult, Rejection
from ..robot_errors import FieldChoice, RobotPrior
from ..staged import with_region
from ..variance import SIGMA_FLOOR, NoiseEstimate, estimate_noise, p_value
from .gross_errors import remove_gross_errors, without_views
from .influence import Influence, deletion_changes, pose_outlier_test
from .plausibility import MAX_PRIOR_SIGMAS, plausibility_warnings

MAX_INLIER_CHI_SQUARE = 2.0 * np.log(1e4)
"""The squared whitened residual that one good point in ten thousand exceeds (chi-square, 2 dof)."""

FALSE_ALARM_PROBABILITY = 1e-6
"""The probability, over all views, of a pose error as large as that of a view that is left out.

It is far below the usual significance level because real robots' errors have longer tails than the
normal distribution.
"""

MAX_POSE_SIGMA_RATIO = 3.0
"""The ratio of pose standard deviations with and without a view above which its pose is wrong."""

GROSS_ERRORS_OPTIONS = ("auto", "keep", "leave_out")
"""The accepted values of `gross_errors`."""

MAX_SIGMA_ITERATIONS = 10
"""The largest number of refits with the pixel sigma re-estimated from the residuals."""

SIGMA_TOLERANCE = 1e-3
"""The relative change of the pixel sigma below which refitting stops."""


class JointFit(eqx.Module):
    """The result of a joint fit.

    Attributes:
        calibration: camera, hand-eye transform, target pose (and target scale, if free).
        covariance: covariance of the free parameters that all views have in common, in the order of
            `parameter_names`, own units.
        std: standard deviation by name, of pose corrections too; infinite for parameters that the
            data do not determine.
        degrees_of_freedom: degrees of freedom of each common parameter's standard deviation, by
            name; infinite where the variance components were not estimated.
        noise: the noise model, given or estimated; None with `noise="trusted"`. Where the
            likelihood finds the robot exact, the standard deviations of its errors are close to
            zero.
        noise_estimate: the estimate of the noise model and its candidates; None where it was not
            estimated.
        pixel_sigma: standard deviation of u and of v, px: as given, or from the residuals and their
            degrees of freedom.
        residuals: measured minus predicted through the chain *without* pose corrections, px.
        inliers: observations within the chi-square gate around the fit; those outside it were still
            used.
        rejected: observations left out: view id, point index (None for a whole view), reason.
        pose_corrections: one twist per view, translation (m) then rotation (rad), at the tool.
        observability: the directions that the data do not determine.
        parameter_names: names of the free parameters that all views have in common.
        view_ids: names of the data's views.
        start: the calibration from which the fit started; with estimated noise, where the estimate
            ended.
        problem: the least squares problem that was solved.
        solution: the final step, with iterations and costs.
        result: whether the fit converged.
    """

    calibration: Calibration
    covariance: Float[np.ndarray, "free free"]
    pixel_sigma: float = eqx.field(static=True)
    residuals: Float[Array, "views points 2"]
    inliers: Bool[Array, "views points"]
    pose_corrections: Float[Array, "views 6"]
    start: Calibration
    problem: JointProblem
    solution: Solution
    std: dict[str, float]
    degrees_of_freedom: dict[str, float]
    noise: Noise | None = eqx.field(static=True)
    noise_estimate: NoiseEstimate | None
    rejected: tuple[Rejection, ...] = eqx.field(static=True)
    observability: Observability = eqx.field(static=True)
    parameter_names: tuple[str, ...] = eqx.field(static=True)
    view_ids: tuple[str, ...] = eqx.field(static=True)
    result: FitResult = eqx.field(static=True)

    freedom = DeprecatedAttribute("degrees_of_freedom")
    estimate = DeprecatedAttribute("noise_estimate")
    margin = DeprecatedAttribute("confidence_half_width")

    @property
    def warnings(self) -> tuple[str, ...]:
        """The reasons to doubt the answer, a sentence each; empty where there are none."""
        return plausibility_warnings(self)

    def confidence_half_width(self, name: str, level: float = 0.95) -> float:
        """Return the half width of a parameter's confidence interval, in its own unit.

        Args:
            name: as in `parameter_names`.
            level: probability that the interval contains the true value, by Student's t with the
                parameter's `degrees_of_freedom`.
        """
        degrees_of_freedom, p = self.degrees_of_freedom[name], 0.5 + 0.5 * level
        return self.std[name] * float(
            stdtrit(degrees_of_freedom, p) if np.isfinite(degrees_of_freedom) else ndtri(p)
        )

    def p_value(self, truth: Calibration, paths: Sequence[str] | None = None) -> float:
        """Return the p-value of the hypothesis that some of the parameters are those of `truth`.

        It is the probability of a fit at least as far from `truth` as this one if `truth` were
        true. A small value, say below 0.05, means that the pictures contradict `truth`, for
        instance a mount taken from a drawing, or one measured before a collision.

        Args:
            truth: a calibration with the same lens, mount and field; only the parameters that the
                paths name are compared.
            paths: paths of fitted parameters, tested jointly; by default the hand-eye transform.

        Raises:
            ValueError: calibrations of different parameters, an unknown path or one that was not
                fitted, or parameters that the data do not determine.
        """
        paths = self.calibration.transform_names[:1] if paths is None else paths
        indices = np.flatnonzero(parameter_mask(self.parameter_names, paths))
        names = [self.parameter_names[k] for k in indices]
        undetermined = [name for name in names if not np.isfinite(self.std[name])]
        if undetermined:
            raise ValueError(f"the data leave {', '.join(undetermined)} open: see `observability`")
        fit_names, truth_names = (parameter_names(c) for c in (self.calibration, truth))
        if fit_names != truth_names:
            raise ValueError(
                f"truth: its parameters are {', '.join(truth_names)}; those of the fit "
                f"{', '.join(fit_names)}"
            )
        # d^T P^-1 d for the difference d under its covariance P: chi-square where the variance
        # components are known, otherwise F with the Kenward-Roger correction.
        difference = np.asarray(Parameters(truth).step_to(self.calibration))
        return p_value(
            difference[[fit_names.index(name) for name in names]],
            self.covariance[np.ix_(indices, indices)],
            None if self.noise_estimate is None else self.noise_estimate.correction_of(names),
        )


def fit_joint(
    data: Dataset,
    start: Calibration,
    *,
    lens: str | AbstractLens | None = None,
    noise: str | Noise = "estimated",
    field: FieldChoice | Literal[False] = "auto",
    loss: str | AbstractLoss | None = None,
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    devices: Sequence[Any] | None = None,
    gross_errors: str = "auto",
    progress: Callable[[str], None] | None = None,
    robot_prior: RobotPrior | None = None,
) -> JointFit:
    """Fit camera, hand-eye transform, target pose and optional parameters to all pixels at once.

    Args:
        data: at least three views with four visible points each, unless priors determine the rest.
        start: any calibration near enough, such as the staged fit's.
        lens: another lens model than the start's own.
        noise: `"estimated"` estimates the variance components, and chooses a robot error field, by
            restricted likelihood; a `Noise` states the standard deviations and gives every view a
            pose correction with a prior; `"trusted"` takes the reported poses as exact.
        field: the robot error field: one of `robot_errors`, or your own; None
            for none. `"auto"`: chosen and averaged by likelihood where the noise is estimated,
            otherwise the start's own is kept fixed.
        loss: robust loss on the points: a name or an `AbstractLoss`. Its scale, and the weight of
            priors, are in standard deviations of a pixel: the noise model's, or with a trusted
            robot those estimated from the residuals.
        fixed: paths of parameters that keep the start's value.
        free: paths to free that are held by default: `"target_scale"`.
        priors: a `Prior` by path.
        solver: any optimistix least-squares solver; by default `StructuredLM`.
        devices: devices over which the views are distributed, such as `jax.devices()`, also those
            of other processes; by default the fit runs on one.
        gross_errors: `"leave_out"` leaves out points that are too far off to be noise and views
            whose pose contradicts the others', and lists them in `rejected`; `"keep"` takes the
            data as they are; `"auto"` leaves out where the noise is estimated.
        progress: called with a line of text for each stage.
        robot_prior: prior on the standard deviations of the robot's errors where the noise is
            estimated; by default that of good industrial arms.

    Raises:
        ValueError: an unknown path or name, too few views, or a start from which a view's points
            cannot be projected at all.
    """
    if gross_errors not in GROSS_ERRORS_OPTIONS:
        raise ValueError(
            f"gross_errors is one of {', '.join(GROSS_ERRORS_OPTIONS)}; found {gross_errors!r}"
        )
    if field is False:
        warn_deprecated("field=False", "field=None", stacklevel=3)
        field = None
    say, start = progress or (lambda _: None), with_lens(start, lens)

    def fit_once(
        data: Dataset, rejected_points: tuple[Rejection, ...]
    ) -> tuple[JointFit, BlockArrow]:
        initial, noise_model, error_field = start, noise, field
        noise_estimate, free_paths = None, tuple(free)
        if noise == "estimated":
            noise_estimate = estimate_noise(
                data,
                initial,
                field=field,
                fixed=fixed,
                free=free,
                priors=priors,
                progress=progress,
                robot_prior=robot_prior,
            )
            initial, noise_model = noise_estimate.calibration, noise_estimate.noise
            error_field = noise_estimate.field
            # The target's size is free if the views favour another one than stated.
            free_paths += noise_estimate.free
        built = build_problem(
            data,
            initial,
            noise=noise_model,
            loss=loss,
            fixed=fixed,
            free=free_paths,
            priors=priors,
            field=error_field,
        )
        parameter_count = len(built.shared_names) + len(built.per_view_names)
        say(f"joint fit: {parameter_count} parameters, {data.observation_count} observations")

        # Levenberg-Marquardt on whitened residuals, with C a 6 x 6 block C_v per view:
        #     (H + lambda I) step = -g,  H = [[A, B^T], [B, C]]
        # Per step tried: one linearisation. Per damping lambda: one Cholesky factor of
        #     A + lambda I - sum_v B_v^T (C_v + lambda I)^-1 B_v
        def solve_problem(problem: JointProblem) -> tuple[Solution, NormalEquations]:
            if devices is None:
                return solve(problem, solver)
            return solve_on(devices, problem, solver)

        built, solution, equations = _solve_with_sigma(built, solve_problem)
        joint_fit = _assemble_fit(data, built, solution, equations, noise_estimate, rejected_points)
        return joint_fit, equations.matrix

    if gross_errors == "keep" or (gross_errors == "auto" and noise != "estimated"):
        return _with_viewpoint_region(fit_once(data, ())[0], data)
    # Gross errors first, then one view at a time: the view rejected by its posterior pose
    # correction, or, where all poses look poor, the view without which the pose standard deviations
    # collapse. The noise is estimated anew after each, since one wrong pose inflates it for all
    # views.
    used_data, rejected_points = remove_gross_errors(data, start, fixed, priors, progress)
    accepted, matrix = fit_once(used_data, rejected_points)
    while True:
        # The data of the view are hidden, not weighted down: a pose from another picture holds no
        # information.
        if (inconsistent := _inconsistent_view(used_data, accepted, matrix)) is not None:
            used_data = without_views(used_data, dict([inconsistent]))
            accepted, matrix = fit_once(used_data, rejected_points)
        elif (suspect := _suspect_view(used_data, accepted, matrix)) is not None:
            # One wrong pose inflates the pose standard deviations of all views, so no view exceeds
            # the test. Compare the fits with and without the suspect instead.
            data_without_suspect = without_views(used_data, {suspect: ""})
            refitted, matrix = fit_once(data_without_suspect, rejected_points)
            if (reason := _inflation_reason(accepted, refitted)) is None:
                break
            used_data = without_views(used_data, {suspect: reason})
            accepted, matrix = fit_once(used_data, rejected_points)
        else:
            break
    # Residuals are reported for rejected observations too.
    all_residuals = chain_residuals(accepted.calibration, data.observations)
    return _with_viewpoint_region(
        eqx.tree_at(lambda f: f.residuals, accepted, all_residuals), used_data
    )


def _with_viewpoint_region(fit: JointFit, data: Dataset) -> JointFit:
    """Return the fit with the region of viewpoints that the data cover in its calibration."""
    return dataclasses.replace(fit, calibration=with_region(fit.calibration, data))


def _solve_with_sigma(
    built: BuiltProblem, solve_problem: Callable[[JointProblem], tuple[Solution, NormalEquations]]
) -> tuple[BuiltProblem, Solution, NormalEquations]:
    """Solve, with a pixel sigma that agrees with the residuals where the answer depends on it.

    It does with a robust loss or priors and an unknown sigma: both weigh residuals in units of
    sigma.
    """
    solution, equations = solve_problem(built.problem)
    if built.sigma_known or not built.depends_on_sigma:
        return built, solution, equations
    for _ in range(MAX_SIGMA_ITERATIONS):
        # sigma <- sigma sqrt(f), with f the variance factor: residual sum of squares over degrees
        # of freedom.
        previous_sigma = float(built.problem.pixel_sigma)
        factor = float(_variance_factor(built.problem, solution.z))
        sigma = max(previous_sigma * np.sqrt(factor), SIGMA_FLOOR)
        built = eqx.tree_at(lambda b: b.problem.pixel_sigma, built, jnp.asarray(sigma))
        solution, equations = solve_problem(built.problem)
        if abs(sigma - previous_sigma) <= SIGMA_TOLERANCE * previous_sigma:
            break
    return built, solution, equations


def view_influence(fit: JointFit) -> Influence:
    """Return how far each view moves the fit: its change without that view, to first order."""
    changes = np.asarray(deletion_changes(fit.problem, fit.solution.z))
    std = np.array([fit.std[name] for name in fit.parameter_names])
    mount_path = fit.calibration.transform_names[0]
    return Influence(changes, std, fit.parameter_names, fit.view_ids, mount_path)


def _inconsistent_view(data: Dataset, fit: JointFit, matrix: BlockArrow) -> tuple[int, str] | None:
    """Return the view whose pose is least compatible with the others', and why.

    None where even that one is not significant, where poses have no prior, or with too few views to
    decide which of them is wrong.
    """
    if fit.noise is None or len(data.usable_views()) <= MINIMUM_RELIABLE_VIEWS:
        return None
    scores = pose_outlier_test(fit.problem, fit.solution.z, matrix, fit.noise_estimate is None)
    distance, p_values = np.asarray(scores.distance), np.asarray(scores.p_value)
    worst = int(np.argmin(p_values))
    # Bonferroni: the smallest of n p-values is tested at the level FALSE_ALARM_PROBABILITY / n.
    if not p_values[worst] * len(data.usable_views()) < FALSE_ALARM_PROBABILITY:
        return None
    return worst, (
        f"its pose lies {distance[worst]:.0f} standard deviations from where the other views put "
        f"it: mispaired or moved?"
    )


def _suspect_view(data: Dataset, fit: JointFit, matrix: BlockArrow) -> int | None:
    """Return the view whose pose is least compatible with the others', if poses err too much.

    None where the pose standard deviations are within what robots usually have.
    """
    noise_estimate, noise = fit.noise_estimate, fit.noise
    if (
        noise_estimate is None
        or noise is None
        or len(data.usable_views()) <= MINIMUM_RELIABLE_VIEWS
    ):
        return None
    # The log-normal prior's upper limit: median times exp(MAX_PRIOR_SIGMAS * spread).
    max_plausible = noise_estimate.robot_prior.medians(None) * np.exp(
        MAX_PRIOR_SIGMAS * noise_estimate.robot_prior.log_stds(None)
    )
    if noise.translation <= max_plausible[0] and noise.rotation <= max_plausible[1]:
        return None
    scores = pose_outlier_test(fit.problem, fit.solution.z, matrix, sigmas_known=False)
    return int(np.argmin(np.asarray(scores.p_value)))


def _inflation_reason(fit: JointFit, refitted: JointFit) -> str | None:
    """Return why a view is left out, from the other views' pose errors with it and without it.

    None where the view is to be kept.
    """
    assert fit.noise is not None
    assert refitted.noise is not None
    for name, unit, unit_scale in (
        ("translation", "mm", 1e3),
        ("rotation", "degrees", float(np.rad2deg(1.0))),
    ):
        before, after = (unit_scale * getattr(f.noise, name) for f in (fit, refitted))
        if before > MAX_POSE_SIGMA_RATIO * after:
            return (
                f"its pose contradicts the others': with it reported poses err by {before:.3g} "
                f"{unit}, without it by {after:.3g}: mispaired or moved?"
            )
    return None


def _assemble_fit(
    data: Dataset,
    built: BuiltProblem,
    solution: Solution,
    equations: NormalEquations,
    noise_estimate: NoiseEstimate | None,
    rejected_points: tuple[Rejection, ...],
) -> JointFit:
    """Build the result: covariances, degrees of freedom, inliers and rejections at the solution."""
    problem = built.problem
    at_solution = _solution_quantities(problem, solution.z, equations.matrix)
    (
        calibration,
        corrections,
        squared_residuals,
        estimated_factor,
        residual_variance,
        elimination,
        per_view_inverse,
    ) = at_solution
    visible, squared_residuals = (
        np.asarray(problem.observations.visible),
        np.asarray(squared_residuals),
    )
    factor = 1.0 if built.sigma_known else float(estimated_factor)

    # Covariance f R^-1, with R the Schur complement of the corrections, f the variance factor. Unit
    # columns keep pixels and radians apart in the singular values.
    column_norms = np.sqrt(np.diagonal(np.asarray(equations.matrix.shared)))
    scaled_jacobian = ScaledJacobian(np.asarray(elimination.schur_complement), column_norms)
    common_covariance, std = covariance(scaled_jacobian, factor)
    degrees_of_freedom = np.full(len(std), np.inf)
    if noise_estimate is not None:
        # Estimated variance components add the Kenward-Roger term and finite degrees of freedom.
        small_sample = noise_estimate.correction_of(built.shared_names)
        common_covariance, degrees_of_freedom = (
            common_covariance + small_sample.added_covariance,
            small_sample.degrees_of_freedom,
        )
        std = np.sqrt(std**2 + np.diagonal(small_sample.added_covariance))
    # Corrections: diag(f C_v^-1 + G_v P G_v^T), with G_v = C_v^-1 B_v and P the common covariance.
    correction_std = per_view_std(
        np.asarray(per_view_inverse), np.asarray(elimination.gain), common_covariance, factor
    )
    correction_std = correction_std[np.asarray(problem.per_view_free)]

    # The robust variance widens the gate where residuals are larger than the noise model states.
    gate = MAX_INLIER_CHI_SQUARE * (
        max(1.0, float(residual_variance)) if built.sigma_known else float(residual_variance)
    )
    inliers = visible & (squared_residuals <= gate)
    names = (*built.shared_names, *built.per_view_names)
    return JointFit(
        calibration=calibration,
        covariance=common_covariance,
        pixel_sigma=float(problem.pixel_sigma) * float(np.sqrt(factor)),
        residuals=chain_residuals(calibration, problem.observations),
        inliers=jnp.asarray(inliers),
        pose_corrections=corrections if len(corrections) else jnp.zeros((data.view_count, 6)),
        start=problem.parameters.start,
        problem=problem,
        solution=solution,
        std=dict(zip(names, map(float, (*std, *correction_std)), strict=True)),
        degrees_of_freedom=dict(
            zip(built.shared_names, map(float, degrees_of_freedom), strict=True)
        ),
        noise=built.noise,
        noise_estimate=noise_estimate,
        rejected=_all_rejections(data, rejected_points, built.unprojectable),
        observability=observability(scaled_jacobian, built.shared_names, calibration),
        parameter_names=built.shared_names,
        view_ids=data.view_ids,
        result=_solver_result(solution),
    )


@compiled
def _solution_quantities(problem: JointProblem, z: Step, matrix: BlockArrow) -> tuple:
    """Compute what the result needs from the normal equations and residuals at the solution."""
    calibration, corrections = problem.calibration(z)
    elimination = eliminate(matrix)
    squares = problem.squared_residuals(z)
    return (
        calibration,
        corrections,
        squares,
        variance_factor(problem, squares),
        robust_variance(squares, problem.observations.visible),
        elimination,
        elimination.per_view_inverse,
    )


@compiled
def _variance_factor(problem: JointProblem, z: Step) -> Float[Array, ""]:
    """Return the ratio of the residuals' variance to the assumed one."""
    return variance_factor(problem, problem.squared_residuals(z))


def _all_rejections(
    data: Dataset, rejected_points: tuple[Rejection, ...], unprojectable: np.ndarray
) -> tuple[Rejection, ...]:
    """Return all rejections: whole views, single points, and points outside the start's domain."""
    view_rejections = [Rejection(view, None, reason) for view, reason in data.masked_views]
    unprojectable_rejections = [
        Rejection(data.view_ids[view], int(point), "cannot be projected from the start")
        for view, point in np.argwhere(unprojectable)
    ]
    return (*view_rejections, *rejected_points, *unprojectable_rejections)


def _solver_result(solution: Solution) -> FitResult:
    """Return whether the solver converged, with a message."""
    # The solution only is checked: a calibration may hold infinite joint limits of an arm.
    finite = all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(solution.z))
    if not finite:
        return FitResult(FitCode.DIVERGED, "the fit diverged: its parameters are not finite")
    if solution.converged:
        return FitResult(FitCode.CONVERGED, f"converged in {solution.steps} steps")
    return FitResult(
        FitCode.STOPPED_EARLY,
        f"not converged after {solution.steps} steps: one more would still lower the cost by "
        f"{solution.relative_decrease:.1g} of it; look at observability, free less or add a prior",
    )
