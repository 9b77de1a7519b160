"""The joint fit: every observation through the whole chain at once."""

from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration
from ..cameras import AbstractLens, start_lens
from ..dataset import Dataset, Observations
from ..staged import FitResult
from .covariance import covariance
from .losses import AbstractLoss, loss_by_name
from .noise import Noise
from .observability import Observability, observability
from .parameters import Parameters, parameter_names, select
from .priors import Prior
from .problem import JointProblem, valid_at_start
from .solver import Solution, linearise, solve

GATE = 2.0 * np.log(1e4)
"""Squared whitened deviation that one good point in ten thousand exceeds (chi-square, 2 dof)."""


class JointFit(eqx.Module):
    """What the joint fit found.

    Attributes:
        calibration: camera, hand-eye, world (and target scale, if free).
        covariance: of the free parameters, in the order of `parameter_names`, own units.
        std: standard deviation by name; infinite where the data do not tell.
        noise: as assumed; None where the robot was trusted.
        pixel_sigma: of u and of v, px: as given, or from the residuals' degrees of freedom.
        residuals: measured minus predicted through the chain *without* pose corrections, px.
        inliers: observations within the gate around the fit.
        rejected: view id, point index (None for a whole view), reason.
        pose_corrections: per view, translation (m) then rotation (rad), at the tool.
        observability: what the data cannot tell.
        parameter_names: of the free parameters.
        start: where the fit began.
        solution: iterations and costs.
        result: whether it converged.
    """

    calibration: Calibration
    covariance: Float[np.ndarray, "free free"]
    pixel_sigma: float = eqx.field(static=True)
    residuals: Float[Array, "views points 2"]
    inliers: Bool[Array, "views points"]
    pose_corrections: Float[Array, "views 6"]
    start: Calibration
    solution: Solution
    std: dict[str, float]
    noise: Noise | None = eqx.field(static=True)
    rejected: tuple[tuple[str, int | None, str], ...] = eqx.field(static=True)
    observability: Observability = eqx.field(static=True)
    parameter_names: tuple[str, ...] = eqx.field(static=True)
    result: FitResult = eqx.field(static=True)


def fit_joint(
    data: Dataset,
    start: Calibration,
    lens: str | AbstractLens | None = None,
    noise: str | Noise = "trusted",
    loss: str | AbstractLoss | None = None,
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    progress: Callable[[str], None] | None = None,
) -> JointFit:
    """Fit camera, hand-eye and world (and more, if asked) to all pixels at once.

    Args:
        data: at least three views with four visible points each, unless priors say the rest.
        start: any calibration near enough, such as the staged fit's.
        lens: another model than the start's own.
        noise: `"trusted"` takes the reported poses as exact; a `Noise` lets every view correct its
            pose under a prior.
        loss: robust loss on the points: a name or an `AbstractLoss`.
        fixed: paths of parameters that keep the start's value.
        free: paths to free that are held by default: `"target_scale"`.
        priors: a `Prior` by path.
        solver: any optimistix least-squares solver.
        progress: told what is being done.

    Raises:
        ValueError: an unknown path or name, too few views, or a start from which a view's points
            cannot be projected at all.
    """
    say = progress or (lambda _: None)
    if not (noise == "trusted" or isinstance(noise, Noise)):
        raise ValueError(
            f'noise is "trusted" or a Noise(pixel, translation, rotation); found {noise!r}'
        )
    if start.mount != data.mount:
        raise ValueError(f"the start is {start.mount}, the data {data.mount}")
    if lens is not None:
        camera = eqx.tree_at(lambda c: c.lens, start.camera, start_lens(lens, start.camera.lens))
        start = eqx.tree_at(lambda c: c.camera, start, camera)
    priors = dict(priors or {})
    views = data.usable_views()
    if len(views) < 3 and not priors:
        raise ValueError(
            f"a joint fit needs at least 3 views with 4 points each, or priors; found {len(views)}"
        )
    problem, names, lost = _problem(data, start, noise, loss_by_name(loss), fixed, free, priors)
    say(f"joint fit: {len(problem.free)} parameters, {data.observation_count} observations")
    solution = solve(problem, solver)
    return _assemble(data, problem, solution, names, noise, lost)


def _problem(
    data: Dataset,
    start: Calibration,
    noise: str | Noise,
    loss: AbstractLoss | None,
    fixed: Sequence[str],
    free: Sequence[str],
    priors: Mapping[str, Prior],
) -> tuple[JointProblem, tuple[str, ...], np.ndarray]:
    corrected = data.view_ids if isinstance(noise, Noise) else ()
    names = parameter_names(start, corrected)
    parameters = Parameters(start)
    moves = ~select(names, ("target_scale",)) | select(names, free)
    moves &= ~select(names, fixed)
    index = tuple(int(k) for k in np.flatnonzero(moves))

    mean, weight = _priors(names, parameters, priors)
    sigma = 1.0
    if isinstance(noise, Noise):
        sigma = noise.pixel
        shared = parameters.shared_size
        deviations = np.repeat([noise.translation, noise.rotation], 3)
        weight[shared:] = np.tile(1.0 / deviations, len(corrected))
    problem = JointProblem(
        parameters,
        data.observations,
        jnp.asarray(sigma),
        index,
        jnp.asarray(mean),
        jnp.asarray(weight),
        jnp.ones(len(index)),
        loss,
    )
    lost = np.asarray(data.visible & ~valid_at_start(problem))
    _refuse_blind_views(data, lost)
    visible = data.visible & ~jnp.asarray(lost)
    problem = eqx.tree_at(lambda p: p.observations.visible, problem, visible)
    _, J = linearise(problem, jnp.zeros(len(index)))
    lengths = np.linalg.norm(np.asarray(J), axis=0)
    scale = 1.0 / np.where(lengths > 0.0, lengths, 1.0)
    return eqx.tree_at(lambda p: p.scale, problem, jnp.asarray(scale)), names, lost


def _priors(
    names: tuple[str, ...], parameters: Parameters, priors: Mapping[str, Prior]
) -> tuple[np.ndarray, np.ndarray]:
    values = np.asarray(parameters.values())
    mean = np.concatenate([values, np.zeros(len(names) - len(values))])
    weight = np.zeros(len(names))
    for path, prior in priors.items():
        chosen = select(names, (path,))
        turning = [names[k] for k in np.flatnonzero(chosen) if ".rotation." in names[k]]
        if prior.mean is not None and turning:
            raise ValueError(f"prior on {path!r}: a rotation's prior is about the start; no mean")
        weight[chosen] = 1.0 / prior.std
        if prior.mean is not None:
            mean[chosen] = prior.mean
    return mean, weight


def _refuse_blind_views(data: Dataset, lost: np.ndarray) -> None:
    seen = np.asarray(data.visible).sum(axis=1)
    blind = [data.view_ids[k] for k in range(len(seen)) if seen[k] > 0 and lost[k].sum() == seen[k]]
    if blind:
        raise ValueError(
            f"start: every point of view {', '.join(blind)} lies behind the camera or outside the "
            f"lens's domain; start nearer to the truth (fit_staged), or check the poses"
        )


def _assemble(
    data: Dataset,
    problem: JointProblem,
    solution: Solution,
    names: tuple[str, ...],
    noise: str | Noise,
    lost: np.ndarray,
) -> JointFit:
    calibration, corrections, whitened, chained = _at_solution(problem, solution.z)
    J, scale = np.asarray(linearise(problem, solution.z)[1]), np.asarray(problem.scale)
    visible = np.asarray(problem.observations.visible)
    known = isinstance(noise, Noise)
    factor, sigma = _variance(np.asarray(whitened), visible, len(problem.free), problem, known)
    free_names = tuple(names[k] for k in problem.free)
    full, std = covariance(J, scale, factor)

    size = np.sum(np.asarray(whitened) ** 2, axis=-1)
    spread = (
        _robust_variance(size[visible]) if not known else max(1.0, _robust_variance(size[visible]))
    )
    inliers = visible & (size <= GATE * spread)
    return JointFit(
        calibration=calibration,
        covariance=full,
        pixel_sigma=sigma,
        residuals=chained,
        inliers=jnp.asarray(inliers),
        pose_corrections=_all_views(corrections, data.view_count),
        start=problem.parameters.start,
        solution=solution,
        std={name: float(value) for name, value in zip(free_names, std, strict=True)},
        noise=noise if isinstance(noise, Noise) else None,
        rejected=_rejected(data, visible & ~inliers, lost),
        observability=observability(J, scale, free_names, calibration),
        parameter_names=free_names,
        result=_result(solution, calibration),
    )


@eqx.filter_jit
def _at_solution(problem: JointProblem, z: Float[Array, "free"]) -> tuple:
    calibration, corrections = problem.calibration(z)
    observations: Observations = problem.observations
    chained = observations.residuals(
        *calibration.project(observations.base_from_tool, observations.points)
    )
    return calibration, corrections, problem.whitened(z), chained


def _all_views(corrections: Array, views: int) -> Float[Array, "views 6"]:
    return corrections if len(corrections) else jnp.zeros((views, 6))


def _variance(
    whitened: np.ndarray, visible: np.ndarray, free: int, problem: JointProblem, known: bool
) -> tuple[float, float]:
    """Factor on the assumed variances, and the pixel sigma."""
    sigma = float(problem.pixel_sigma)
    if known:
        return 1.0, sigma
    dof = max(2 * int(visible.sum()) - free + int(np.count_nonzero(problem.prior_weight)), 1)
    factor = float(np.sum(whitened[visible] ** 2)) / dof
    return factor, sigma * float(np.sqrt(factor))


def _robust_variance(square: np.ndarray) -> float:
    """Variance per component from the median: half the points lie within 2 log 2 of it."""
    return max(float(np.median(square)) / (2.0 * np.log(2.0)), 1e-24) if square.size else 1.0


def _rejected(
    data: Dataset, outside: np.ndarray, lost: np.ndarray
) -> tuple[tuple[str, int | None, str], ...]:
    whole = [(view, None, reason) for view, reason in data.masked_views]
    blind = [
        (data.view_ids[view], int(point), "cannot be projected from the start")
        for view, point in np.argwhere(lost)
    ]
    far = [
        (data.view_ids[view], int(point), "far from the fit")
        for view, point in np.argwhere(outside)
    ]
    return tuple(whole + blind + far)


def _result(solution: Solution, calibration: Calibration) -> FitResult:
    finite = all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(calibration))
    if not finite:
        return FitResult(False, "the fit diverged: its parameters are not finite")
    if solution.converged:
        return FitResult(True, f"converged in {solution.steps} steps")
    return FitResult(
        False,
        f"not converged after {solution.steps} steps: one more would still lower the cost by "
        f"{solution.decrease:.1g} of it; look at observability, free less or add a prior",
    )
