"""Refine all points and lines of an object together, using prior knowledge of it.

The squared whitened residuals of all pictures are minimised under soft and exact constraints. On
request the poses of the views, or the whole calibration, are free under their prior, so that they
are improved by all features together. Every constraint is then judged by the chi-square that
releasing it would save: one that contradicts the pictures costs more than chance explains.

Reference: Nocedal and Wright, Numerical optimization, 2006, section 18.1 (Lagrange-Newton).
"""

from collections.abc import Sequence
from typing import Literal, Protocol, TypeAlias, Unpack, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from ...engine import AbstractLoss, covariance_factor
from ...fit_result import FitResult
from ...runtime.blas_threads import on_one_blas_thread
from ..calibration_uncertainty import CalibrationUncertainty, UncertaintyOptions
from ..estimated_features import MAX_RELATIVE_STD, PointStatus
from ..line_jacobians import Lines
from ..line_triangulation import triangulate_lines, world_rays
from ..triangulation import solve_points
from .constrained_system import Factorisation
from .constraint_geometry import Shape
from .constraints import AbstractConstraint, check_constraints, check_edges
from .picture_equations import CheckedObservations, ModelObservations, picture_equations
from .refined_features import RefinedFeatures, constraint_verdicts
from .refinement_problem import (
    RefinementEquations,
    RefinementProblem,
    RefinementState,
    linearise,
    minimise,
)

Freedom: TypeAlias = Literal["nothing", "poses", "calibration"]
"""Estimated together with the features: nothing, the views' own noise, or all uncertain numbers."""

WEAK_PRIOR_STD = 10.0
"""Standard deviation, over the distance, of a prior that keeps unmeasured points finite.

It is far above `MAX_RELATIVE_STD`, so that points held only by this prior are reported."""

FALSE_ALARM_PROBABILITY = 0.01
"""Probability that any constraint is said to contradict the pictures although all are true."""


@runtime_checkable
class HasVertices(Protocol):
    """A model whose vertices are the initial points of the refinement."""

    @property
    def vertices(self) -> Float[np.ndarray, "points 3"]: ...


@on_one_blas_thread
def refine(
    start: HasVertices | Float[np.ndarray, "points 3"] | None,
    observations: ModelObservations,
    constraints: Sequence[AbstractConstraint] = (),
    *,
    free: Freedom = "nothing",
    loss: AbstractLoss | None = None,
    false_alarm: float = FALSE_ALARM_PROBABILITY,
    **uncertainty: Unpack[UncertaintyOptions],
) -> RefinedFeatures:
    """Refine all points and lines together, under constraints.

    A point that fewer than two views see can still be determined by constraints; it needs an
    initial value, or one view whose ray gives one.

    Args:
        start: a model with `vertices`, or points, m; None or NaN where they are triangulated first.
        constraints: known properties of the object, each soft or exact.
        free: `"poses"` also estimates the robot's own noise in each view, `"calibration"`
            everything that `covariance` and `noise` call uncertain, under their prior.
        loss: robust loss of the points' whitened residuals; None is least squares.
        false_alarm: probability that any true constraint is said to contradict the pictures.
        uncertainty: `covariance` and `noise`, as in `triangulate_points`.

    Raises:
        ValueError: bad observations or constraints, a start with a wrong number of points, a point
            without start and view, a line of a constraint that cannot be triangulated, or `free`
            without an uncertainty.
    """
    observed = CheckedObservations.of(observations)
    count, line_count = observed.visible.shape[1], observed.segments_visible.shape[1]
    check_constraints(constraints, count, line_count)
    # One description for both: free numbers are estimated under it, fixed ones are propagated by
    # it.
    known = CalibrationUncertainty.of(observed.views, observations.calibration, **uncertainty)
    if free != "nothing" and not known.names:
        raise ValueError(f"free={free!r}: give covariance or noise, their prior")
    points, weak = _initial_points(start, observed)
    check_edges(constraints, points)
    lines, line_status = _initial_lines(observations, observed, constraints)
    shape, planes = _with_planes(points, lines, constraints)
    roots = _prior_roots(known)
    # The views' own noise comes after the numbers that all views share.
    index = np.arange(roots.shape[1])
    chosen = {
        "nothing": index < 0,
        "poses": index >= known.shared_count,
        "calibration": index >= 0,
    }[free]
    distance = _typical_distance(observed, points)
    problem = RefinementProblem(
        observed, known, roots, chosen, tuple(constraints), planes, weak, points,
        WEAK_PRIOR_STD * distance, loss,
    )  # fmt: skip
    state, result = minimise(problem, RefinementState(shape, np.zeros(len(chosen))))
    return _summarise(problem, state, result, line_status, distance, false_alarm)


def _initial_points(
    start: HasVertices | np.ndarray | None, observed: CheckedObservations
) -> tuple[Float[np.ndarray, "points 3"], np.ndarray]:
    """Return initial points, and the indices of points that the pictures do not determine."""
    count = observed.visible.shape[1]
    triangulated, _, _, status = solve_points(
        observed.views, observed.pixels, observed.whitening, observed.visible
    )
    # A given start takes precedence over the triangulation: a person may have chosen it among
    # several.
    points = np.where((status == PointStatus.OK)[:, None], triangulated, np.nan)
    if start is not None:
        initial = start.vertices if isinstance(start, HasVertices) else start
        initial = np.asarray(initial, dtype=float)
        if initial.shape != (count, 3):
            raise ValueError(
                f"start: expected {(count, 3)} as there are pixels; found {initial.shape}"
            )
        points = np.where(np.isfinite(initial), initial, points)
    # Points of one view start on its ray, at the distance of the other points.
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
    visible = np.arange(len(observed.visible))[:, None] == view
    rays, _ = world_rays(observed.views, segments, visible)
    ray, origin = rays[view, 0, 0], observed.views.centres[view]
    return origin + ((centre - origin) @ ray) * ray


def _initial_lines(
    observations: ModelObservations,
    observed: CheckedObservations,
    constraints: Sequence[AbstractConstraint],
) -> tuple[Lines, np.ndarray]:
    """Return initial lines, and the status of each; failed lines have no segments left."""
    if not observed.segments.shape[1]:
        return Lines(np.zeros((0, 3)), np.zeros((0, 3))), np.zeros(0, dtype=int)
    triangulated = triangulate_lines(
        observations.calibration,
        observations.poses,
        observed.segments,
        observed.segments_visible,
        pixel_sigma=observed.covariances,
    )
    for constraint in constraints:
        for line in constraint.lines:
            if line in triangulated.failures:
                raise ValueError(f"{constraint}: line {line}: {triangulated.failures[line]}")
    # Failed lines stay in the arrays, so that the caller's indices remain valid.
    failed = ~triangulated.ok
    observed.segments_visible[:, failed] = False
    filler = observed.views.centres[0] + observed.views.camera_from_world[0, 2, :3]
    lines = Lines(
        np.where(failed[:, None], filler, triangulated.lines.points),
        np.where(failed[:, None], [1.0, 0.0, 0.0], triangulated.lines.directions),
    )
    return lines, triangulated.status


def _with_planes(
    points: Float[np.ndarray, "points 3"],
    lines: Lines,
    constraints: Sequence[AbstractConstraint],
) -> tuple[Shape, tuple[int, ...]]:
    """Return the shape with the planes of all constraints, and each constraint's plane index."""
    constraint_planes, indices = [], []
    for constraint in constraints:
        plane = constraint.initial_plane(points)
        indices.append(-1 if plane is None else len(constraint_planes))
        constraint_planes += [] if plane is None else [plane]
    centres = np.array([centre for centre, _ in constraint_planes]).reshape(-1, 3)
    normals = np.array([normal for _, normal in constraint_planes]).reshape(-1, 3)
    return Shape(points, lines, normals, np.zeros(len(constraint_planes)), centres), tuple(indices)


def _prior_roots(uncertainty: CalibrationUncertainty) -> Float[np.ndarray, "numbers combinations"]:
    """Return L with covariance `L L^T`; the last columns belong to the views' own noise."""
    covariance, shared = uncertainty.covariance, uncertainty.shared_count
    std = np.sqrt(np.diagonal(covariance))
    root = np.diag(std)
    part = np.ix_(range(shared), range(shared))
    root[part] = covariance_factor(covariance[part])
    return root


def _typical_distance(
    observed: CheckedObservations, points: Float[np.ndarray, "points 3"]
) -> float:
    """Return the median distance of the points from the cameras, m."""
    # The scale for "far" and "undetermined", in the units of the poses.
    offsets = points[None] - observed.views.centres[:, None]
    return float(np.median(np.linalg.norm(offsets, axis=-1))) if len(points) else 1.0


def _summarise(
    problem: RefinementProblem,
    state: RefinementState,
    result: FitResult,
    line_status: np.ndarray,
    distance: float,
    false_alarm: float,
) -> RefinedFeatures:
    """Return the result with covariances, verdicts and statuses."""
    # Damping is for steps, not for covariances.
    at = linearise(problem, state, problem.free)
    posterior = at.system.factorised()
    blocks = posterior.feature_blocks()
    for point in problem.weak:
        blocks.points[point] = posterior.covariance(at.point_rows[point])
    # The prior of unmeasured points is no measurement.
    status = np.full(len(state.shape.points), int(PointStatus.OK))
    open_points = np.trace(blocks.points, axis1=1, axis2=2) > (MAX_RELATIVE_STD * distance) ** 2
    status[open_points] = PointStatus.DEGENERATE_BASELINE
    few = open_points & (problem.observed.visible.sum(axis=0) < 2)
    status[few] = PointStatus.TOO_FEW_VIEWS
    if not result.converged:
        status[:] = PointStatus.NOT_CONVERGED
        line_status = np.full_like(line_status, PointStatus.NOT_CONVERGED)
    # From here on failed features are NaN, with the reason in their status.
    ok, lines_ok = status == PointStatus.OK, line_status == PointStatus.OK
    fixed = ~problem.free
    names, covariance, jacobian = _calibration_part(problem, state, at, posterior, fixed)
    verdicts, p_value = constraint_verdicts(problem, state, false_alarm)
    return RefinedFeatures(
        points=np.where(ok[:, None], state.shape.points, np.nan),
        lines=Lines(*(np.where(lines_ok[:, None], a, np.nan) for a in state.shape.lines)),
        status=status,
        line_status=line_status,
        residuals=np.where(
            (problem.observed.visible & ok)[..., None], at.pictures.residuals, np.nan
        ),
        picture_covariance=np.where(ok[:, None, None], blocks.points, np.nan),
        line_covariance=np.where(lines_ok[:, None, None], blocks.lines, np.nan),
        calibration_jacobian=np.where(ok[:, None, None], jacobian, np.nan),
        calibration_covariance=covariance,
        calibration_names=names,
        verdicts=verdicts,
        constraints_p_value=p_value,
        result=result,
        posterior=posterior,
        point_rows=at.point_rows,
    )


def _calibration_part(
    problem: RefinementProblem,
    state: RefinementState,
    at: RefinementEquations,
    posterior: Factorisation,
    fixed: Bool[np.ndarray, "combinations"],
) -> tuple[
    tuple[str, ...], Float[np.ndarray, "numbers numbers"], Float[np.ndarray, "points 3 numbers"]
]:
    """Return names and covariance of the fixed numbers, and the points' derivatives by them."""
    names = tuple(n for n, held in zip(problem.uncertainty.names, fixed, strict=True) if held)
    covariance = problem.uncertainty.covariance[np.ix_(fixed, fixed)]
    count = len(state.shape.points)
    if not names:
        return names, covariance, np.zeros((count, 3, 0))
    # Numbers, not combinations: the fixed ones are either all shared numbers or all numbers.
    everything = picture_equations(
        problem.observed,
        state.shape,
        problem.uncertainty,
        problem.roots @ state.combinations,
        np.eye(len(problem.uncertainty.names)),
        problem.loss,
    )
    # Mixed derivatives of the fixed numbers with features and with free numbers.
    free_roots = problem.roots[:, problem.free]
    mixed = everything.coupling[:, fixed].copy()
    reduced = np.zeros((len(posterior.reduced), len(names)))
    numbers = free_roots.shape[1]
    reduced[:numbers] = free_roots.T @ everything.numbers[:, fixed]
    for point in problem.weak:
        rows = slice(3 * point, 3 * point + 3)
        reduced[at.point_rows[point] - posterior.features.size] = mixed[rows]
        mixed[rows] = 0.0
    # At the optimum the gradient is zero; a change of the fixed numbers changes it by these
    # columns, and the solution by minus the inverse times them.
    by_numbers = np.concatenate(posterior.solve(-mixed, -reduced))
    return names, covariance, by_numbers[at.point_rows]
