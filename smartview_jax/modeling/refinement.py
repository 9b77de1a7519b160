"""Refine all points and lines of an object together, with what a person knows of it.

The squared whitened residuals of all pictures are minimised under soft and exact constraints. On
request the poses of the views, or the whole calibration, are free under their prior, so that what
many features say together improves them. Every constraint is then judged by the chi-square that
releasing it would save: one that contradicts the pictures costs more than chance explains.

Reference: Nocedal and Wright, Numerical optimization, 2006, section 18.1 (Lagrange-Newton); Rao,
Large sample tests of statistical hypotheses, 1948 (the score test of a constraint).
"""

import itertools
from collections.abc import Sequence
from typing import Literal, NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtrc

from ..engine import AbstractLoss, Noise
from ..evaluation import CalibrationEstimate
from ..fit_result import FitCode, FitResult
from .calibration_uncertainty import CalibrationUncertainty
from .constrained_system import EXACT_VARIANCE, ConstrainedSystem, Factorisation, FeatureBlocks
from .constraints import AbstractConstraint, Shape, check_constraints
from .line_jacobians import Lines
from .line_triangulation import triangulate_lines, world_rays
from .picture_equations import (
    CheckedObservations,
    ModelObservations,
    PictureEquations,
    picture_equations,
)
from .point_estimation import MAX_RELATIVE_STD, PointStatus
from .triangulation import solve_points

Freedom: TypeAlias = Literal["nothing", "poses", "calibration"]
"""Estimated besides the features: nothing, the views' own noise, or all that is uncertain."""

MAX_STEPS = 50
"""Largest number of Gauss-Newton steps."""

CONVERGED_STEP = 1e-8
"""Squared step of a feature, in standard deviations that its pictures give, that ends the steps."""

MERIT_VARIANCE, MERIT_SLACK = 1e-2, 0.1
"""The variance of exact constraints over what the pictures leave them, by which steps are judged,
and the rise of half the chi-square that is let pass: steps near the optimum are all taken."""

WEAK_STD = 10.0
"""Standard deviation of a prior, over the distance, that keeps points finite that nothing measures.

It is far above `MAX_RELATIVE_STD`, so that whatever only this prior holds is named."""

VIOLATION = 1e-2
"""Largest violation of an exact constraint, in standard deviations that the pictures leave it."""

FALSE_ALARM = 0.01
"""Probability that any constraint is said to contradict the pictures when all are true."""


@runtime_checkable
class HasVertices(Protocol):
    """A model whose vertices are a start of the refinement."""

    @property
    def vertices(self) -> Float[np.ndarray, "points 3"]: ...


class ConstraintVerdict(NamedTuple):
    """The agreement of a constraint with the pictures and with the other constraints.

    Attributes:
        constraint: the constraint.
        residuals: its numbers at the solution, m or rad; zero if it holds exactly.
        cost: chi-square that releasing it alone would save.
        degrees_of_freedom: number of independent numbers that it fixes; zero where the others imply
            it.
        p_value: probability of such a cost if the constraint is true.
        contradicts: whether it is to be doubted, at the false-alarm probability of the call.
        violated: whether it is exact and does not hold, because others contradict it.
    """

    constraint: AbstractConstraint
    residuals: Float[np.ndarray, "numbers"]
    cost: float
    degrees_of_freedom: int
    p_value: float
    contradicts: bool
    violated: bool

    def __str__(self) -> str:
        if self.violated:
            return f"{self.constraint} cannot hold together with the other exact constraints"
        return (
            f"{self.constraint} costs {self.cost:.1f} (chi-square of {self.degrees_of_freedom}), "
            f"p = {self.p_value:.2g}"
        )


class RefinedFeatures(NamedTuple):
    """Refined points and lines, with their errors by cause.

    Attributes:
        points: in the world, m; NaN where `status` is not OK.
        lines: refined lines; NaN likewise.
        status: a `PointStatus` for each point.
        line_status: a `PointStatus` for each line.
        residuals: measured minus predicted pixels, NaN where not visible.
        line_residuals: distances of segments' ends from their lines, px; NaN where not visible.
        picture_covariance: covariance of each point due to the pictures, the constraints and
            what was free, m^2.
        line_covariance: likewise of each line's four numbers.
        calibration_jacobian: derivatives of each point by the numbers that were not free.
        calibration_covariance: covariance of these numbers.
        calibration_names: names of these numbers.
        number_offsets: estimated offsets of the numbers that were free, by name.
        verdicts: one for each constraint, in order.
        constraints_p_value: probability of the cost of all constraints together if they are true.
        result: whether it converged.
        posterior: the factorised equations, from which covariances between features come.
        weak: indices of points that are determined by constraints or not at all.
    """

    points: Float[np.ndarray, "points 3"]
    lines: Lines
    status: np.ndarray
    line_status: np.ndarray
    residuals: Float[np.ndarray, "views points 2"]
    line_residuals: Float[np.ndarray, "views lines 2"]
    picture_covariance: Float[np.ndarray, "points 3 3"]
    line_covariance: Float[np.ndarray, "lines 4 4"]
    calibration_jacobian: Float[np.ndarray, "points 3 numbers"]
    calibration_covariance: Float[np.ndarray, "numbers numbers"]
    calibration_names: tuple[str, ...]
    number_offsets: dict[str, float]
    verdicts: tuple[ConstraintVerdict, ...]
    constraints_p_value: float
    result: FitResult
    posterior: Factorisation
    weak: np.ndarray

    @property
    def vertices(self) -> Float[np.ndarray, "points 3"]:
        """The points, by the name that models use."""
        return self.points

    @property
    def ok(self) -> Bool[np.ndarray, "points"]:
        """Whether each point is determined."""
        return self.status == PointStatus.OK

    @property
    def failures(self) -> dict[int, str]:
        """The reason, in words, of every point that is not determined, by its index."""
        return {int(k): PointStatus(self.status[k]).message for k in np.flatnonzero(~self.ok)}

    @property
    def contradictions(self) -> tuple[ConstraintVerdict, ...]:
        """The constraints to be doubted, the most expensive first."""
        doubted = [one for one in self.verdicts if one.contradicts or one.violated]
        return tuple(sorted(doubted, key=lambda one: (one.violated, one.cost), reverse=True))

    @property
    def rms(self) -> float:
        """The root mean square reprojection error of the points, px."""
        squared = np.sum(self.residuals**2, axis=-1)
        return float(np.sqrt(np.nanmean(squared))) if np.isfinite(squared).any() else float("nan")

    def covariance(self) -> Float[np.ndarray, "points 3 3"]:
        """Return the covariance of each point due to all causes, m^2."""
        J = self.calibration_jacobian
        return self.picture_covariance + J @ self.calibration_covariance @ J.swapaxes(1, 2)

    def joint_covariance(
        self, points: Sequence[int] | None = None
    ) -> Float[np.ndarray, "coordinates coordinates"]:
        """Return the covariance of the coordinates of some points, or of all, m^2."""
        chosen = np.arange(len(self.points)) if points is None else np.asarray(points, dtype=int)
        rows = (
            np.concatenate([self._rows(int(k)) for k in chosen])
            if len(chosen)
            else np.zeros(0, int)
        )
        J = self.calibration_jacobian[chosen].reshape(3 * len(chosen), -1)
        return self.posterior.covariance(rows) + J @ self.calibration_covariance @ J.T

    def _rows(self, point: int) -> np.ndarray:
        """Return the rows of a point's coordinates among the unknowns of the posterior."""
        if point in self.weak:
            place = int(np.flatnonzero(self.weak == point)[0])
            first = self.posterior.features.size + self.posterior.border_size
            return first - 3 * (len(self.weak) - place) + np.arange(3)
        return 3 * point + np.arange(3)


class _Problem(NamedTuple):
    """The fixed parts of a refinement.

    Attributes:
        observed: observations.
        uncertainty: numbers of the calibration.
        roots: combinations of the numbers with unit prior variance.
        free: which of these are estimated.
        constraints: the constraints.
        planes: index of each constraint's own plane; -1 for none.
        weak: indices of points in the border.
        start: points at the start, the mean of the weak prior.
        weak_sigma: its standard deviation, m.
        loss: robust loss.
    """

    observed: CheckedObservations
    uncertainty: CalibrationUncertainty
    roots: Float[np.ndarray, "numbers combinations"]
    free: Bool[np.ndarray, "combinations"]
    constraints: tuple[AbstractConstraint, ...]
    planes: tuple[int, ...]
    weak: np.ndarray
    start: Float[np.ndarray, "points 3"]
    weak_sigma: float
    loss: AbstractLoss | None


class _State(NamedTuple):
    """A point of the search: the shape, and the combinations of the numbers, all of them."""

    shape: Shape
    combinations: Float[np.ndarray, "combinations"]


class _Equations(NamedTuple):
    """The linearised problem at a state.

    Attributes:
        pictures: the part of the pictures.
        system: the matrix.
        feature_right: right-hand side of the features.
        reduced_right: right-hand side of border and constraints.
        values: the constraints' numbers.
        rows: the rows of each constraint.
        cost: half the squares of pictures and priors.
    """

    pictures: PictureEquations
    system: ConstrainedSystem
    feature_right: np.ndarray
    reduced_right: np.ndarray
    values: np.ndarray
    rows: tuple[slice, ...]
    cost: float


def refine(
    start: HasVertices | Float[np.ndarray, "points 3"] | None,
    observations: ModelObservations,
    constraints: Sequence[AbstractConstraint] = (),
    *,
    free: Freedom = "nothing",
    covariance: CalibrationEstimate | None = None,
    noise: Noise | None = None,
    loss: AbstractLoss | None = None,
    false_alarm: float = FALSE_ALARM,
) -> RefinedFeatures:
    """Refine all points and lines together, under constraints.

    A point that fewer than two views see is determined too if constraints determine it; it needs a
    start, or one view whose ray gives one.

    Args:
        start: a model with `vertices`, or points, m; None or NaN where they are triangulated first.
        observations: the pictures.
        constraints: what is known of the object, each soft or exact.
        free: `"poses"` also estimates the robot's own noise in each view, `"calibration"`
            everything that `covariance` and `noise` say is uncertain, under their prior.
        covariance: how well the calibration is known, as in `triangulate_points`.
        noise: sizes of the robot's noise, likewise.
        loss: robust loss of the points' whitened residuals; None is least squares.
        false_alarm: probability that any true constraint is said to contradict the pictures.

    Raises:
        ValueError: bad observations or constraints, a start of another number of points, a point
            without start and view, a line of a constraint that cannot be triangulated, or `free`
            without anything that says how uncertain it is.
    """
    observed = CheckedObservations.of(observations)
    count, line_count = observed.visible.shape[1], observed.segments_visible.shape[1]
    check_constraints(constraints, count, line_count)
    uncertainty = CalibrationUncertainty.of(
        observed.views, observations.calibration, covariance, noise
    )
    if free != "nothing" and not uncertainty.names:
        raise ValueError(f"free={free!r}: covariance or noise says how uncertain that is")
    points, weak = _initial_points(start, observed)
    lines, line_status = _initial_lines(observations, observed, constraints)
    shape, planes = _with_planes(points, lines, constraints)
    roots = _prior_roots(uncertainty)
    index = np.arange(roots.shape[1])
    chosen = {
        "nothing": index < 0,
        "poses": index >= uncertainty.shared_count,
        "calibration": index >= 0,
    }[free]
    distance = _typical_distance(observed, points)
    problem = _Problem(
        observed, uncertainty, roots, chosen, tuple(constraints), planes, weak, points,
        WEAK_STD * distance, loss,
    )  # fmt: skip
    state, result = _minimise(problem, _State(shape, np.zeros(len(chosen))))
    return _summarise(problem, state, result, line_status, distance, false_alarm)


def _initial_points(
    start: HasVertices | np.ndarray | None, observed: CheckedObservations
) -> tuple[Float[np.ndarray, "points 3"], np.ndarray]:
    """Return points to start from, and the indices of those that the pictures leave open."""
    count = observed.visible.shape[1]
    found, _, _, status = solve_points(
        observed.views, observed.pixels, observed.whitening, observed.visible
    )
    points = np.where((status == PointStatus.OK)[:, None], found, np.nan)
    if start is not None:
        given = start.vertices if isinstance(start, HasVertices) else start
        given = np.asarray(given, dtype=float)
        if given.shape != (count, 3):
            raise ValueError(
                f"start: expected {(count, 3)} as there are pixels; found {given.shape}"
            )
        points = np.where(np.isfinite(given), given, points)
    centre = np.nanmean(points, axis=0) if np.isfinite(points).any() else np.full(3, np.nan)
    for k in np.flatnonzero(np.isnan(points).any(axis=1)):
        points[k] = _on_a_ray(observed, int(k), centre)
    return points, np.flatnonzero(status != PointStatus.OK)


def _on_a_ray(
    observed: CheckedObservations, point: int, centre: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Return the point of the first ray of a point that is nearest to the other points."""
    views = np.flatnonzero(observed.visible[:, point])
    if not len(views) or np.isnan(centre).any():
        raise ValueError(
            f"start: point {point} needs a start: {len(views)} views see it, and "
            f"{'no other point is known' if len(views) else 'none gives a ray'}"
        )
    view = views[0]
    pixel = observed.pixels[view, point]
    segments = np.tile(pixel, (len(observed.visible), 1, 2, 1))
    seen = np.arange(len(observed.visible))[:, None] == view
    rays, _ = world_rays(observed.views, segments, seen)
    ray, origin = rays[view, 0, 0], observed.views.centres[view]
    return origin + ((centre - origin) @ ray) * ray


def _initial_lines(
    observations: ModelObservations,
    observed: CheckedObservations,
    constraints: Sequence[AbstractConstraint],
) -> tuple[Lines, np.ndarray]:
    """Return lines to start from, and the status of each; one that failed has no segments left."""
    if not observed.segments.shape[1]:
        return Lines(np.zeros((0, 3)), np.zeros((0, 3))), np.zeros(0, dtype=int)
    found = triangulate_lines(
        observations.calibration,
        observations.poses,
        observed.segments,
        observed.segments_visible,
        pixel_sigma=observed.covariances,
    )
    for constraint in constraints:
        for line in constraint.lines:
            if line in found.failures:
                raise ValueError(f"{constraint}: line {line}: {found.failures[line]}")
    failed = ~found.ok
    observed.segments_visible[:, failed] = False
    filler = observed.views.centres[0] + observed.views.camera_from_world[0, 2, :3]
    lines = Lines(
        np.where(failed[:, None], filler, found.lines.points),
        np.where(failed[:, None], [1.0, 0.0, 0.0], found.lines.directions),
    )
    return lines, found.status


def _with_planes(
    points: Float[np.ndarray, "points 3"],
    lines: Lines,
    constraints: Sequence[AbstractConstraint],
) -> tuple[Shape, tuple[int, ...]]:
    """Return the shape with the planes of all constraints, and the index of each one's plane."""
    found, indices = [], []
    for constraint in constraints:
        plane = constraint.initial_plane(points)
        indices.append(-1 if plane is None else len(found))
        found += [] if plane is None else [plane]
    centres = np.array([centre for centre, _ in found]).reshape(-1, 3)
    normals = np.array([normal for _, normal in found]).reshape(-1, 3)
    return Shape(points, lines, normals, np.zeros(len(found)), centres), tuple(indices)


def _prior_roots(uncertainty: CalibrationUncertainty) -> Float[np.ndarray, "numbers combinations"]:
    """Return L with covariance `L L^T`, whose last columns are those of the views' own noise."""
    covariance, shared = uncertainty.covariance, uncertainty.shared_count
    std = np.sqrt(np.diagonal(covariance))
    root = np.diag(std)
    part = np.ix_(range(shared), range(shared))
    values, vectors = np.linalg.eigh(covariance[part] / np.outer(std[:shared], std[:shared]))
    root[part] = std[:shared, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def _typical_distance(
    observed: CheckedObservations, points: Float[np.ndarray, "points 3"]
) -> float:
    """Return the median distance of the points from the cameras, m."""
    offsets = points[None] - observed.views.centres[:, None]
    return float(np.median(np.linalg.norm(offsets, axis=-1))) if len(points) else 1.0


def _linearise(
    problem: _Problem, state: _State, free: Bool[np.ndarray, "combinations"]
) -> _Equations:
    """Return the linear equations at a state, for some of the combinations."""
    shape, weak = state.shape, problem.weak
    pictures = picture_equations(
        problem.observed,
        shape,
        problem.uncertainty,
        problem.roots @ state.combinations,
        problem.roots[:, free],
        problem.loss,
    )
    numbers, planes = int(free.sum()), len(shape.normals)
    border_size = numbers + 3 * planes + 3 * len(weak)
    first_weak = numbers + 3 * planes
    rows = pictures.features.size
    border = np.zeros((border_size, border_size))
    border[:numbers, :numbers] = pictures.numbers + np.eye(numbers)
    gradient = np.zeros(border_size)
    gradient[:numbers] = pictures.number_gradient + state.combinations[free]
    blocks = FeatureBlocks(pictures.features.points.copy(), pictures.features.lines.copy())
    coupling = np.zeros((rows, border_size))
    coupling[:, :numbers] = pictures.coupling
    feature_gradient = pictures.feature_gradient.copy()
    # Lines that no view sees any more, and points that move to the border, are idle here.
    blocks.lines[~problem.observed.segments_visible.any(axis=0)] = np.eye(4)
    prior = 1.0 / problem.weak_sigma**2
    for k, point in enumerate(weak):
        place, own = (
            slice(first_weak + 3 * k, first_weak + 3 * k + 3),
            slice(3 * point, 3 * point + 3),
        )
        border[place, place] = blocks.points[point] + prior * np.eye(3)
        border[place, :numbers] = coupling[own, :numbers]
        border[:numbers, place] = coupling[own, :numbers].T
        gradient[place] = feature_gradient[own] + prior * (
            shape.points[point] - problem.start[point]
        )
        blocks.points[point], coupling[own], feature_gradient[own] = np.eye(3), 0.0, 0.0

    evaluations = [
        one.evaluate(shape, plane)
        for one, plane in zip(problem.constraints, problem.planes, strict=True)
    ]
    sizes = [len(one.values) for one in evaluations]
    ends = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    A, C = np.zeros((ends[-1], rows)), np.zeros((ends[-1], border_size))
    variance, values = np.zeros(ends[-1]), np.zeros(ends[-1])
    weak_place = {int(point): first_weak + 3 * k for k, point in enumerate(weak)}
    first_line = 3 * len(shape.points)
    slices = tuple(slice(*pair) for pair in itertools.pairwise(ends))
    for where, constraint, one in zip(slices, problem.constraints, evaluations, strict=True):
        values[where] = one.values
        variance[where] = 0.0 if constraint.sigma is None else constraint.sigma**2
        for (kind, k), jacobian in one.jacobians.items():
            width = jacobian.shape[1]
            if kind == "plane":
                C[where, numbers + 3 * k : numbers + 3 * k + width] += jacobian
            elif kind == "point" and k in weak_place:
                C[where, weak_place[k] : weak_place[k] + width] += jacobian
            else:
                first = 3 * k if kind == "point" else first_line + 4 * k
                A[where, first : first + width] += jacobian
    weak_offset = shape.points[weak] - problem.start[weak]
    cost = (
        pictures.cost
        + 0.5 * float(np.sum(state.combinations**2))
        + 0.5 * prior * float(np.sum(weak_offset**2))
    )
    return _Equations(
        pictures,
        ConstrainedSystem(blocks, coupling, border, A, C, variance),
        -feature_gradient,
        -np.concatenate([gradient, values]),
        values,
        slices,
        cost,
    )


def _minimise(problem: _Problem, start: _State) -> tuple[_State, FitResult]:
    """Take damped Gauss-Newton steps until all features stay where they are."""
    state, damping = start, 0.0
    at = _linearise(problem, state, problem.free)
    if not np.isfinite(at.cost):
        return state, FitResult(FitCode.DIVERGED, "a point starts behind a camera that sees it")
    for _ in range(MAX_STEPS):
        factors = at.system.factorised(damping)
        step, rest = factors.solve(at.feature_right, at.reduced_right)
        trial = _moved(problem, state, step, rest[: factors.border_size])
        new = _linearise(problem, trial, problem.free)
        small = _largest_step(at.system, step, rest) < CONVERGED_STEP
        if small or _merit(new) <= _merit(at) + MERIT_SLACK:
            state, at, damping = trial, new, 0.1 * damping if damping > 1e-6 else 0.0
            if small and damping == 0.0:
                return state, FitResult(FitCode.CONVERGED, "all features stay where they are")
        else:
            damping = max(10.0 * damping, 1e-4)
            if damping > 1e8:
                break
    return state, FitResult(
        FitCode.STOPPED_EARLY, "the steps did not settle: are the start and the constraints right?"
    )


def _merit(at: _Equations) -> float:
    """Return the cost with the squares of all constraints; exact ones have a sigma for this."""
    inverse = at.system.features.inverse()
    variance = np.maximum(
        at.system.constraint_variance, MERIT_VARIANCE * at.system.left_open(inverse)
    )
    return at.cost + 0.5 * float(np.sum(at.values**2 / variance))


def _moved(problem: _Problem, state: _State, step: np.ndarray, border: np.ndarray) -> _State:
    """Return the state after a step of the features and of the border."""
    count, planes = len(state.shape.points), len(state.shape.normals)
    numbers = int(problem.free.sum())
    points = step[: 3 * count].reshape(count, 3).copy()
    points[problem.weak] = border[numbers + 3 * planes :].reshape(-1, 3)
    combinations = state.combinations.copy()
    combinations[problem.free] += border[:numbers]
    shape = state.shape.moved(
        points,
        step[3 * count :].reshape(-1, 4),
        border[numbers : numbers + 3 * planes].reshape(planes, 3),
    )
    return _State(shape, combinations)


def _largest_step(
    system: ConstrainedSystem, step: Float[np.ndarray, "rows"], rest: Float[np.ndarray, "reduced"]
) -> float:
    """Return the largest squared step of a feature, in its standard deviations by the pictures."""
    weighted = step * system.features.times(step)
    split = 3 * len(system.features.points)
    sizes = [
        weighted[:split].reshape(-1, 3).sum(axis=1),
        weighted[split:].reshape(-1, 4).sum(axis=1),
    ]
    border = rest[: len(system.border)] ** 2 * np.diagonal(system.border)
    return float(np.max(np.concatenate([*sizes, border, [0.0]])))


def _summarise(
    problem: _Problem,
    state: _State,
    result: FitResult,
    line_status: np.ndarray,
    distance: float,
    false_alarm: float,
) -> RefinedFeatures:
    """Return the answer with covariances, verdicts and statuses."""
    at = _linearise(problem, state, problem.free)
    posterior = at.system.factorised()
    blocks = posterior.feature_blocks()
    weak = problem.weak
    first = posterior.features.size + posterior.border_size - 3 * len(weak)
    for k, point in enumerate(weak):
        blocks.points[point] = posterior.covariance(first + 3 * k + np.arange(3))
    # The prior of points that nothing measures is not a measurement.
    status = np.full(len(state.shape.points), int(PointStatus.OK))
    open_points = np.trace(blocks.points, axis1=1, axis2=2) > (MAX_RELATIVE_STD * distance) ** 2
    status[open_points] = PointStatus.DEGENERATE_BASELINE
    few = open_points & (problem.observed.visible.sum(axis=0) < 2)
    status[few] = PointStatus.TOO_FEW_VIEWS
    if not result.converged:
        status[:] = PointStatus.NOT_CONVERGED
    ok, lines_ok = status == PointStatus.OK, line_status == PointStatus.OK
    fixed = ~problem.free
    names, covariance, jacobian = _calibration_part(problem, state, at, posterior, fixed)
    offsets = problem.roots[:, problem.free] @ state.combinations[problem.free]
    verdicts, p_value = _verdicts(problem, state, false_alarm)
    free_names = set(problem.uncertainty.names) - set(names)
    return RefinedFeatures(
        np.where(ok[:, None], state.shape.points, np.nan),
        Lines(*(np.where(lines_ok[:, None], a, np.nan) for a in state.shape.lines)),
        status,
        line_status,
        np.where((problem.observed.visible & ok)[..., None], at.pictures.residuals, np.nan),
        np.where(
            (problem.observed.segments_visible & lines_ok)[..., None],
            at.pictures.distances,
            np.nan,
        ),
        np.where(ok[:, None, None], blocks.points, np.nan),
        np.where(lines_ok[:, None, None], blocks.lines, np.nan),
        np.where(ok[:, None, None], jacobian, np.nan),
        covariance,
        names,
        {
            name: float(value)
            for name, value in zip(problem.uncertainty.names, offsets, strict=True)
            if name in free_names
        },
        verdicts,
        p_value,
        result,
        posterior,
        weak,
    )


def _calibration_part(
    problem: _Problem,
    state: _State,
    at: _Equations,
    posterior: Factorisation,
    fixed: Bool[np.ndarray, "combinations"],
) -> tuple[
    tuple[str, ...], Float[np.ndarray, "numbers numbers"], Float[np.ndarray, "points 3 numbers"]
]:
    """Return names and covariance of the numbers that were held, and the points' derivatives."""
    names = tuple(n for n, held in zip(problem.uncertainty.names, fixed, strict=True) if held)
    covariance = problem.uncertainty.covariance[np.ix_(fixed, fixed)]
    count = len(state.shape.points)
    if not names:
        return names, covariance, np.zeros((count, 3, 0))
    # Numbers, not combinations: those that are held are all the shared ones, or all.
    everything = picture_equations(
        problem.observed,
        state.shape,
        problem.uncertainty,
        problem.roots @ state.combinations,
        np.eye(len(problem.uncertainty.names)),
        problem.loss,
    )
    free_roots = problem.roots[:, problem.free]
    mixed = everything.coupling[:, fixed].copy()
    reduced = np.zeros((len(posterior.reduced), len(names)))
    numbers = free_roots.shape[1]
    reduced[:numbers] = free_roots.T @ everything.numbers[:, fixed]
    first = posterior.border_size - 3 * len(problem.weak)
    for k, point in enumerate(problem.weak):
        own = slice(3 * point, 3 * point + 3)
        reduced[first + 3 * k : first + 3 * k + 3] = mixed[own]
        mixed[own] = 0.0
    # The gradients change by these columns; the solution by minus the inverse times them.
    features, rest = posterior.solve(-mixed, -reduced)
    jacobian = features[: 3 * count].reshape(count, 3, -1).copy()
    jacobian[problem.weak] = rest[first : posterior.border_size].reshape(-1, 3, len(names))
    return names, covariance, jacobian


def _verdicts(
    problem: _Problem, state: _State, false_alarm: float
) -> tuple[tuple[ConstraintVerdict, ...], float]:
    """Return the verdict on every constraint, and the p-value of all of them together."""
    if not problem.constraints:
        return (), 1.0
    # Everything uncertain is free here, whatever was free before: a calibration that is slightly
    # off must not be taken for a wrong constraint.
    at = _linearise(problem, state, np.ones(len(problem.free), dtype=bool))
    factors = at.system.factorised()
    _, rest = factors.solve(at.feature_right, at.reduced_right)
    multipliers = rest[factors.border_size :]
    information = -factors.reduced[factors.border_size :, factors.border_size :]
    left_open = at.system.left_open(factors.features)
    per_test = false_alarm / len(problem.constraints)
    verdicts = []
    for constraint, rows in zip(problem.constraints, at.rows, strict=True):
        cost, freedom = _score(multipliers[rows], information[rows, rows], left_open[rows])
        p_value = float(chdtrc(freedom, cost)) if freedom else 1.0
        values = at.values[rows]
        tolerance = VIOLATION * np.sqrt(left_open[rows])
        violated = constraint.sigma is None and bool(np.any(np.abs(values) > tolerance))
        verdicts.append(
            ConstraintVerdict(
                constraint, values, cost, freedom, p_value, p_value < per_test, violated
            )
        )
    cost, freedom = _score(multipliers, information, left_open)
    return tuple(verdicts), float(chdtrc(freedom, cost)) if freedom else 1.0


def _score(
    multipliers: Float[np.ndarray, "rows"],
    information: Float[np.ndarray, "rows rows"],
    left_open: Float[np.ndarray, "rows"],
) -> tuple[float, int]:
    """Return the chi-square that releasing some rows saves, and its degrees of freedom."""
    # m^T (Cov m)^-1 m, with the covariance of the multipliers the block of the inverse matrix. In
    # units of what the pictures leave open, it has eigenvalues of one and more for independent
    # rows, zero for directions that an unknown plane takes up, and those of exact rows that follow
    # from others are limited by `EXACT_VARIANCE` alone.
    scale = np.sqrt(left_open)
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    used = (values > 1e-6) & (values < 1e-2 / EXACT_VARIANCE)
    parts = vectors.T @ (multipliers * scale)
    return float(np.sum(parts[used] ** 2 / values[used])), int(used.sum())
