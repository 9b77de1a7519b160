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
from ..dataset import Dataset, chain_residuals
from ..engine import (
    AbstractLoss,
    BlockArrow,
    Built,
    JointProblem,
    Noise,
    NormalEquations,
    Observability,
    Parameters,
    Prior,
    Solution,
    Step,
    UnitColumns,
    build_problem,
    covariance,
    eliminate,
    observability,
    own_std,
    parameter_names,
    robust_variance,
    select,
    solve,
    solve_on,
    variance_factor,
    with_lens,
)
from ..fit_result import FitCode, FitResult, Rejection
from ..robot_errors import AbstractField, RobotPrior
from ..staged import FEWEST, with_region
from ..variance import FINEST, NoiseEstimate, estimate_noise, p_value
from .influence import Influence, moves_without, pose_scores
from .plausibility import UNUSUAL, doubts
from .screening import screened, without_views

GATE = 2.0 * np.log(1e4)
"""The squared whitened residual that one good point in ten thousand exceeds (chi-square, 2 dof)."""

ABSURD = 1e-6
"""The probability, over all views, of a pose error as large as that of a view that is left out.

It is far below the usual significance level because real robots' errors have longer tails than the
normal distribution.
"""

SPOILS = 3.0
"""The ratio of pose standard deviations with and without a view above which its pose is wrong."""

BAD_VIEWS = ("keep", "leave_out")
"""The accepted values of `bad_views`."""

SIGMA_ROUNDS = 10
"""The largest number of refits with the pixel sigma re-estimated from the residuals."""

SIGMA_SETTLED = 1e-3
"""The relative change of the pixel sigma below which refitting stops."""


class JointFit(eqx.Module):
    """The result of a joint fit.

    Attributes:
        calibration: camera, hand-eye transform, target pose (and target scale, if free).
        covariance: covariance of the free parameters that all views have in common, in the order of
            `parameter_names`, own units.
        std: standard deviation by name, of pose corrections too; infinite for parameters that the
            data do not determine.
        freedom: degrees of freedom of each common parameter's standard deviation, by name; infinite
            where the variance components were not estimated.
        noise: the noise model, given or estimated; None with `noise="trusted"`. Where the
            likelihood finds the robot exact, the standard deviations of its errors are close to
            zero.
        estimate: the estimate of the noise model and its alternatives; None where it was not
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
    freedom: dict[str, float]
    noise: Noise | None = eqx.field(static=True)
    estimate: NoiseEstimate | None
    rejected: tuple[Rejection, ...] = eqx.field(static=True)
    observability: Observability = eqx.field(static=True)
    parameter_names: tuple[str, ...] = eqx.field(static=True)
    view_ids: tuple[str, ...] = eqx.field(static=True)
    result: FitResult = eqx.field(static=True)

    @property
    def warnings(self) -> tuple[str, ...]:
        """The reasons to doubt the answer, a sentence each; empty where there are none."""
        return doubts(self)

    def margin(self, name: str, level: float = 0.95) -> float:
        """Return the half width of a parameter's confidence interval, in its own unit.

        Args:
            name: as in `parameter_names`.
            level: probability that the interval contains the true value, by Student's t with the
                parameter's `freedom`.
        """
        freedom, p = self.freedom[name], 0.5 + 0.5 * level
        return self.std[name] * float(stdtrit(freedom, p) if np.isfinite(freedom) else ndtri(p))

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
        chosen = np.flatnonzero(select(self.parameter_names, paths))
        names = [self.parameter_names[k] for k in chosen]
        unseen = [name for name in names if not np.isfinite(self.std[name])]
        if unseen:
            raise ValueError(f"the data leave {', '.join(unseen)} open: see `observability`")
        known, there = (parameter_names(c) for c in (self.calibration, truth))
        if known != there:
            raise ValueError(
                f"truth: its parameters are {', '.join(there)}; those of the fit {', '.join(known)}"
            )
        # d^T P^-1 d for the difference d under its covariance P: chi-square where the variance
        # components are known, otherwise F with the Kenward-Roger correction (`doubt`).
        offset = np.asarray(Parameters(truth).step_to(self.calibration))
        return p_value(
            offset[[known.index(name) for name in names]],
            self.covariance[np.ix_(chosen, chosen)],
            None if self.estimate is None else self.estimate.doubt_of(names),
        )


def fit_joint(
    data: Dataset,
    start: Calibration,
    lens: str | AbstractLens | None = None,
    noise: str | Noise = "estimated",
    field: AbstractField | Literal[False] | None = None,
    loss: str | AbstractLoss | None = None,
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    devices: Sequence[Any] | None = None,
    bad_views: str | None = None,
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
        field: the robot error field: one of `robot_errors`, or your own. None: chosen by likelihood
            where the noise is estimated, otherwise the start's own is kept; False: none.
        loss: robust loss on the points: a name or an `AbstractLoss`. Its scale, and the weight of
            priors, are in standard deviations of a pixel: the noise model's, or with a trusted
            robot those estimated from the residuals.
        fixed: paths of parameters that keep the start's value.
        free: paths to free that are held by default: `"target_scale"`.
        priors: a `Prior` by path.
        solver: any optimistix least-squares solver; by default `StructuredLM`.
        devices: devices over which the views are distributed, such as `jax.devices()`, also those
            of other processes; by default the fit runs on one.
        bad_views: `"leave_out"` also leaves out gross outliers and views whose pose contradicts the
            others', and lists them in `rejected`; `"keep"` takes the data as they are, and so does
            None unless the noise is estimated.
        progress: called with a line of text for each stage.
        robot_prior: prior on the standard deviations of the robot's errors where the noise is
            estimated; by default that of good industrial arms.

    Raises:
        ValueError: an unknown path or name, too few views, or a start from which a view's points
            cannot be projected at all.
    """
    if bad_views not in (None, *BAD_VIEWS):
        raise ValueError(f"bad_views is one of {', '.join(BAD_VIEWS)}; found {bad_views!r}")
    say, start = progress or (lambda _: None), with_lens(start, lens)

    def fit(data: Dataset, apart: tuple[Rejection, ...]) -> tuple[JointFit, BlockArrow]:
        model, begin, smooth, estimate, opened = noise, start, field, None, tuple(free)
        if noise == "estimated":
            estimate = estimate_noise(
                data, begin, field, fixed, free, priors, progress, robot_prior
            )
            model, smooth, begin = estimate.noise, estimate.field, estimate.start
            # The target's size is free if the views favour another one than stated.
            opened += estimate.free
        if smooth is False:
            begin, smooth = begin.uncorrected, None
        built = build_problem(data, begin, None, model, loss, fixed, opened, priors, smooth)
        count = len(built.names) + len(built.own_names)
        say(f"joint fit: {count} parameters, {data.observation_count} observations")

        # Levenberg-Marquardt on whitened residuals, with C a 6 x 6 block C_v per view:
        #     (H + lambda I) step = -g,  H = [[A, B^T], [B, C]]
        # Per step tried: one linearisation. Per damping lambda: one Cholesky factor of
        #     A + lambda I - sum_v B_v^T (C_v + lambda I)^-1 B_v
        def run(problem: JointProblem) -> tuple[Solution, NormalEquations]:
            if devices is None:
                return solve(problem, solver)
            return solve_on(devices, problem, solver)

        built, solution, equations = _settled(built, run)
        found = _assemble(data, built, solution, equations, estimate, apart)
        return found, equations.matrix

    if bad_views == "keep" or (bad_views is None and noise != "estimated"):
        return _seen(fit(data, ())[0], data)
    # Gross errors first, then one view at a time: the view rejected by its posterior pose
    # correction, or, where all poses look poor, the view without which the pose standard deviations
    # collapse. The noise is estimated anew after each, since one wrong pose inflates it for all
    # views.
    used, apart = screened(data, start, fixed, priors, progress)
    found, matrix = fit(used, apart)
    while True:
        # The data of the view are hidden, not weighted down: a pose from another picture holds no
        # information.
        if (doubt := _doubtful_view(used, found, matrix)) is not None:
            used = without_views(used, dict([doubt]))
            found, matrix = fit(used, apart)
        elif (suspect := _suspect_view(used, found, matrix)) is not None:
            # One wrong pose inflates the pose standard deviations of all views, so no view exceeds
            # the test. Compare the fits with and without the suspect instead.
            without = without_views(used, {suspect: ""})
            other, matrix = fit(without, apart)
            if (reason := _spoiled(found, other)) is None:
                break
            used = without_views(used, {suspect: reason})
            found, matrix = fit(used, apart)
        else:
            break
    # Residuals are reported for rejected observations too.
    everything = chain_residuals(found.calibration, data.observations)
    return _seen(eqx.tree_at(lambda f: f.residuals, found, everything), used)


def _seen(fit: JointFit, data: Dataset) -> JointFit:
    """Return the fit with the region of viewpoints that the data cover in its calibration."""
    return dataclasses.replace(fit, calibration=with_region(fit.calibration, data))


def _settled(
    built: Built, run: Callable[[JointProblem], tuple[Solution, NormalEquations]]
) -> tuple[Built, Solution, NormalEquations]:
    """Solve, with a pixel sigma that agrees with the residuals where the answer depends on it.

    It does with a robust loss or priors and an unknown sigma: both weigh residuals in units of
    sigma.
    """
    solution, equations = run(built.problem)
    if built.sigma_known or not built.sigma_matters:
        return built, solution, equations
    for _ in range(SIGMA_ROUNDS):
        # sigma <- sigma sqrt(f), with f the variance factor: residual sum of squares over degrees
        # of freedom.
        before = float(built.problem.pixel_sigma)
        factor = float(_variance_factor(built.problem, solution.z))
        sigma = max(before * np.sqrt(factor), FINEST)
        built = eqx.tree_at(lambda b: b.problem.pixel_sigma, built, jnp.asarray(sigma))
        solution, equations = run(built.problem)
        if abs(sigma - before) <= SIGMA_SETTLED * before:
            break
    return built, solution, equations


def view_influence(fit: JointFit) -> Influence:
    """Return how far each view moves the fit: its change without that view, to first order."""
    moves = np.asarray(moves_without(fit.problem, fit.solution.z))
    std = np.array([fit.std[name] for name in fit.parameter_names])
    mount = fit.calibration.transform_names[0]
    return Influence(moves, std, fit.parameter_names, fit.view_ids, mount)


def _doubtful_view(data: Dataset, fit: JointFit, matrix: BlockArrow) -> tuple[int, str] | None:
    """Return the view whose pose is least compatible with the others', and why.

    None where even that one is not significant, where poses have no prior, or with too few views to
    decide which of them is wrong.
    """
    if fit.noise is None or len(data.usable_views()) <= FEWEST:
        return None
    scores = pose_scores(fit.problem, fit.solution.z, matrix, fit.estimate is None)
    distance, chance = np.asarray(scores.distance), np.asarray(scores.p_value)
    worst = int(np.argmin(chance))
    # Bonferroni: the smallest p-value of n views is tested at the level ABSURD / n.
    if not chance[worst] * len(data.usable_views()) < ABSURD:
        return None
    return worst, (
        f"its pose lies {distance[worst]:.0f} standard deviations from where the other views put "
        f"it: mispaired or moved?"
    )


def _suspect_view(data: Dataset, fit: JointFit, matrix: BlockArrow) -> int | None:
    """Return the view whose pose is least compatible with the others', if poses err too much.

    None where the pose standard deviations are within what robots usually have.
    """
    estimate, noise = fit.estimate, fit.noise
    if estimate is None or noise is None or len(data.usable_views()) <= FEWEST:
        return None
    # The log-normal prior's upper limit: median times exp(UNUSUAL * spread).
    usual = estimate.prior.medians(None) * np.exp(UNUSUAL * estimate.prior.spreads(None))
    if noise.translation <= usual[0] and noise.rotation <= usual[1]:
        return None
    scores = pose_scores(fit.problem, fit.solution.z, matrix, sizes_known=False)
    return int(np.argmin(np.asarray(scores.p_value)))


def _spoiled(fit: JointFit, without: JointFit) -> str | None:
    """Return why a view is left out, from the other views' pose errors with it and without it.

    None where the view is to be kept.
    """
    assert fit.noise is not None
    assert without.noise is not None
    for name, unit, times in (
        ("translation", "mm", 1e3),
        ("rotation", "degrees", float(np.rad2deg(1.0))),
    ):
        before, after = (times * getattr(f.noise, name) for f in (fit, without))
        if before > SPOILS * after:
            return (
                f"its pose contradicts the others': with it reported poses err by {before:.3g} "
                f"{unit}, without it by {after:.3g}: mispaired or moved?"
            )
    return None


def _assemble(
    data: Dataset,
    built: Built,
    solution: Solution,
    equations: NormalEquations,
    estimate: NoiseEstimate | None,
    apart: tuple[Rejection, ...],
) -> JointFit:
    """Build the result: covariances, degrees of freedom, inliers and rejections at the solution."""
    problem = built.problem
    at_solution = _at_solution(problem, solution.z, equations.matrix)
    calibration, corrections, square, estimated, spread, parts, own_inverse = at_solution
    visible, square = np.asarray(problem.observations.visible), np.asarray(square)
    factor = 1.0 if built.sigma_known else float(estimated)

    # Covariance f R^-1, with R the Schur complement of the corrections, f the variance factor. Unit
    # columns keep pixels and radians apart in the singular values.
    lengths = np.sqrt(np.diagonal(np.asarray(equations.matrix.shared)))
    columns = UnitColumns(np.asarray(parts.reduced), lengths)
    full, std = covariance(columns, factor)
    freedom = np.full(len(std), np.inf)
    if estimate is not None:
        # Estimated variance components add the Kenward-Roger term and finite degrees of freedom.
        doubt = estimate.doubt_of(built.names)
        full, freedom = full + doubt.covariance, doubt.freedom
        std = np.sqrt(std**2 + np.diagonal(doubt.covariance))
    # Corrections: diag(f C_v^-1 + G_v P G_v^T), with G_v = C_v^-1 B_v and P the common covariance.
    own = own_std(np.asarray(own_inverse), np.asarray(parts.gain), full, factor)
    own = own[np.asarray(problem.own_free)]

    # The robust variance widens the gate where residuals are larger than the noise model states.
    limit = GATE * (max(1.0, float(spread)) if built.sigma_known else float(spread))
    inliers = visible & (square <= limit)
    names = (*built.names, *built.own_names)
    return JointFit(
        calibration=calibration,
        covariance=full,
        pixel_sigma=float(problem.pixel_sigma) * float(np.sqrt(factor)),
        residuals=chain_residuals(calibration, problem.observations),
        inliers=jnp.asarray(inliers),
        pose_corrections=corrections if len(corrections) else jnp.zeros((data.view_count, 6)),
        start=problem.parameters.start,
        problem=problem,
        solution=solution,
        std=dict(zip(names, map(float, (*std, *own)), strict=True)),
        freedom=dict(zip(built.names, map(float, freedom), strict=True)),
        noise=built.noise,
        estimate=estimate,
        rejected=_rejected(data, apart, built.lost),
        observability=observability(columns, built.names, calibration),
        parameter_names=built.names,
        view_ids=data.view_ids,
        result=_result(solution),
    )


@compiled
def _at_solution(problem: JointProblem, z: Step, matrix: BlockArrow) -> tuple:
    """Compute what the result needs from the normal equations and residuals at the solution."""
    calibration, corrections = problem.calibration(z)
    parts = eliminate(matrix)
    squares = problem.squares(z)
    return (
        calibration,
        corrections,
        squares,
        variance_factor(problem, squares),
        robust_variance(squares, problem.observations.visible),
        parts,
        parts.own_inverse,
    )


@compiled
def _variance_factor(problem: JointProblem, z: Step) -> Float[Array, ""]:
    """Return the ratio of the residuals' variance to the assumed one."""
    return variance_factor(problem, problem.squares(z))


def _rejected(
    data: Dataset, apart: tuple[Rejection, ...], lost: np.ndarray
) -> tuple[Rejection, ...]:
    """Return all rejections: whole views, single points, and points outside the start's domain."""
    whole = [Rejection(view, None, reason) for view, reason in data.masked_views]
    blind = [
        Rejection(data.view_ids[view], int(point), "cannot be projected from the start")
        for view, point in np.argwhere(lost)
    ]
    return (*whole, *apart, *blind)


def _result(solution: Solution) -> FitResult:
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
        f"{solution.decrease:.1g} of it; look at observability, free less or add a prior",
    )
