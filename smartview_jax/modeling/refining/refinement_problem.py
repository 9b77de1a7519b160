"""Minimise the squared residuals of all pictures of an object under its constraints."""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ...engine import AbstractLoss
from ...fit_result import FitCode, FitResult
from ..calibration_uncertainty import CalibrationUncertainty
from .constrained_system import ConstrainedSystem, FeatureBlocks
from .constraint_geometry import Shape
from .constraints import AbstractConstraint
from .picture_equations import CheckedObservations, PictureEquations, picture_equations

MAX_STEPS = 50
"""Largest number of Gauss-Newton steps."""

CONVERGED_STEP = 1e-8
"""Squared step of a feature, in its standard deviations by the pictures, that ends the steps."""

MERIT_VARIANCE, MERIT_SLACK = 1e-2, 0.1
"""Variance of exact constraints when steps are judged, over the variance that the pictures leave
them; and the tolerated increase of half the chi-square: steps near the optimum are all taken."""


class RefinementProblem(NamedTuple):
    """The fixed parts of a refinement.

    Attributes:
        uncertainty: numbers of the calibration.
        roots: combinations of the numbers with unit prior variance.
        free: which of these are estimated.
        planes: index of each constraint's own plane; -1 for none.
        weak: indices of points in the border.
        start: initial points, the mean of the weak prior.
        weak_sigma: standard deviation of the weak prior, m.
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


class RefinementState(NamedTuple):
    """A state of the search: the shape, and all combinations of the numbers."""

    shape: Shape
    combinations: Float[np.ndarray, "combinations"]


class RefinementEquations(NamedTuple):
    """The linearised problem at a state.

    Attributes:
        reduced_right: right-hand side of border and constraints.
        rows: the rows of each constraint.
        point_rows: numbers of each point's coordinates among the unknowns: features, then border.
        cost: half the squares of pictures and priors.
    """

    pictures: PictureEquations
    system: ConstrainedSystem
    feature_right: np.ndarray
    reduced_right: np.ndarray
    values: np.ndarray
    rows: tuple[slice, ...]
    point_rows: Int[np.ndarray, "points 3"]
    cost: float


def linearise(
    problem: RefinementProblem, state: RefinementState, free: Bool[np.ndarray, "combinations"]
) -> RefinementEquations:
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
    # The border holds the free numbers, the planes and the weak points, in this order.
    numbers, rows = int(free.sum()), pictures.features.size
    first_weak = numbers + 3 * len(shape.normals)
    border_size = first_weak + 3 * len(weak)
    point_rows = np.arange(3 * len(shape.points)).reshape(-1, 3)
    weak_rows, weak_places = point_rows[weak].ravel(), np.arange(first_weak, border_size)
    point_rows[weak] = rows + weak_places.reshape(-1, 3)
    border = np.zeros((border_size, border_size))
    # Combinations have unit variance, so that the precision of their prior is the identity.
    border[:numbers, :numbers] = pictures.numbers + np.eye(numbers)
    gradient = np.zeros(border_size)
    gradient[:numbers] = pictures.number_gradient + state.combinations[free]
    blocks = FeatureBlocks(pictures.features.points.copy(), pictures.features.lines.copy())
    coupling = np.zeros((rows, border_size))
    coupling[:, :numbers] = pictures.coupling
    feature_gradient = pictures.feature_gradient.copy()
    # Lines that no view sees and points that move to the border are inactive here.
    blocks.lines[~problem.observed.segments_visible.any(axis=0)] = np.eye(4)
    prior = 1.0 / problem.weak_sigma**2
    # A point that its pictures do not determine has a singular block, which cannot be eliminated
    # first. In the border, its constraints and a very weak prior make the system regular.
    for point, place in zip(weak, weak_places.reshape(-1, 3), strict=True):
        border[np.ix_(place, place)] = blocks.points[point] + prior * np.eye(3)
    border[weak_places, :numbers] = coupling[weak_rows, :numbers]
    border[:numbers, weak_places] = coupling[weak_rows, :numbers].T
    weak_offset = shape.points[weak] - problem.start[weak]
    gradient[weak_places] = feature_gradient[weak_rows] + prior * weak_offset.ravel()
    blocks.points[weak] = np.eye(3)
    coupling[weak_rows], feature_gradient[weak_rows] = 0.0, 0.0

    columns = _FirstColumns(point_rows[:, 0], 3 * len(shape.points), rows + numbers)
    by_unknowns, values, variance, slices = _constraint_rows(
        problem, shape, columns, rows + border_size
    )
    A, C = by_unknowns[:, :rows], by_unknowns[:, rows:]
    cost = (
        pictures.cost
        + 0.5 * float(np.sum(state.combinations**2))
        + 0.5 * prior * float(np.sum(weak_offset**2))
    )
    return RefinementEquations(
        pictures,
        ConstrainedSystem(blocks, coupling, border, A, C, variance),
        -feature_gradient,
        -np.concatenate([gradient, values]),
        values,
        slices,
        point_rows,
        cost,
    )


class _FirstColumns(NamedTuple):
    """The first columns of the unknowns in the derivatives of constraints."""

    points: Int[np.ndarray, "points"]
    lines: int
    planes: int

    def of(self, kind: str, index: int) -> int:
        """Return the first column of a point, line or plane."""
        if kind == "point":
            return int(self.points[index])
        return self.lines + 4 * index if kind == "line" else self.planes + 3 * index


def _constraint_rows(
    problem: RefinementProblem, shape: Shape, columns: _FirstColumns, count: int
) -> tuple[
    Float[np.ndarray, "rows unknowns"],
    Float[np.ndarray, "rows"],
    Float[np.ndarray, "rows"],
    tuple[slice, ...],
]:
    """Return derivatives, values and variances of all constraints, and the rows of each."""
    evaluations = [
        constraint.evaluate(shape, plane)
        for constraint, plane in zip(problem.constraints, problem.planes, strict=True)
    ]
    sizes = [len(evaluation.values) for evaluation in evaluations]
    ends = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    by_unknowns = np.zeros((ends[-1], count))
    variance, values = np.zeros(ends[-1]), np.zeros(ends[-1])
    slices = tuple(slice(*pair) for pair in itertools.pairwise(ends))
    for where, constraint, evaluation in zip(slices, problem.constraints, evaluations, strict=True):
        values[where] = evaluation.values
        variance[where] = 0.0 if constraint.sigma is None else constraint.sigma**2
        for (kind, k), jacobian in evaluation.jacobians.items():
            first = columns.of(kind, k)
            by_unknowns[where, first : first + jacobian.shape[1]] += jacobian
    return by_unknowns, values, variance, slices


def minimise(
    problem: RefinementProblem, start: RefinementState
) -> tuple[RefinementState, FitResult]:
    """Take damped Gauss-Newton steps until all features stay where they are."""
    state, damping = start, 0.0
    # Gauss-Newton with Levenberg's damping; constraints are linearised again in every step.
    at = linearise(problem, state, problem.free)
    if not np.isfinite(at.cost):
        return state, FitResult(FitCode.DIVERGED, "a point starts behind a camera that sees it")
    for _ in range(MAX_STEPS):
        factors = at.system.factorised(damping)
        step, rest = factors.solve(at.feature_right, at.reduced_right)
        trial = _moved(problem, state, at, np.concatenate([step, rest[: factors.border_size]]))
        new = linearise(problem, trial, problem.free)
        # The last step is taken whatever the cost: it differs only by rounding.
        small = _largest_step(at.system, step, rest) < CONVERGED_STEP
        if small or _merit(new) <= _merit(at) + MERIT_SLACK:
            state, at, damping = trial, new, 0.1 * damping if damping > 1e-6 else 0.0
            if small and damping == 0.0:
                return state, FitResult(FitCode.CONVERGED, "all features stay where they are")
        else:
            # Undamped first: from triangulated points a full step is nearly always right.
            damping = max(10.0 * damping, 1e-4)
            if damping > 1e8:
                break
    return state, FitResult(
        FitCode.STOPPED_EARLY, "the steps did not settle: are the start and the constraints right?"
    )


def _merit(at: RefinementEquations) -> float:
    """Return the cost including the squares of all constraints; NaN where a step went astray."""
    # A step may leave what the cameras see, where the pictures say nothing.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inverse = at.system.features.inverse()
        # For this, exact constraints get a variance that balances them with the pictures.
        variance = np.maximum(
            at.system.constraint_variance, MERIT_VARIANCE * at.system.variance_by_pictures(inverse)
        )
        return at.cost + 0.5 * float(np.sum(at.values**2 / variance))


def _moved(
    problem: RefinementProblem,
    state: RefinementState,
    at: RefinementEquations,
    step: Float[np.ndarray, "unknowns"],
) -> RefinementState:
    """Return the state after a step of all unknowns: the features and the border."""
    features, border = np.split(step, [at.system.features.size])
    numbers, planes = int(problem.free.sum()), len(state.shape.normals)
    combinations = state.combinations.copy()
    combinations[problem.free] += border[:numbers]
    shape = state.shape.moved(
        step[at.point_rows],
        features[3 * len(state.shape.points) :].reshape(-1, 4),
        border[numbers : numbers + 3 * planes].reshape(planes, 3),
    )
    return RefinementState(shape, combinations)


def _largest_step(
    system: ConstrainedSystem, step: Float[np.ndarray, "rows"], rest: Float[np.ndarray, "reduced"]
) -> float:
    """Return the largest squared step of a feature, in its standard deviations by the pictures."""
    # dx^T H dx of each feature: one means one standard deviation, whatever the unit.
    weighted = step * system.features.times(step)
    split = 3 * len(system.features.points)
    sizes = [
        weighted[:split].reshape(-1, 3).sum(axis=1),
        weighted[split:].reshape(-1, 4).sum(axis=1),
    ]
    border = rest[: len(system.border)] ** 2 * np.diagonal(system.border)
    return float(np.max(np.concatenate([*sizes, border, [0.0]])))
