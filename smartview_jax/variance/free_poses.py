"""Fit the camera, a free pose for every view, and the target's shape to the pixels alone.

No robot poses are used. The remaining residuals are the noise within the views.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..calibration import Calibration, TargetShape
from ..engine import (
    BuiltProblem,
    JointProblem,
    NormalEquations,
    ParameterChoice,
    Prior,
    Step,
    solve,
)
from .linearised_views import LinearisedViews
from .view_statistics import ViewStatistics, with_free_poses

MAX_SHAPE_FITS = 4
"""Largest number of fits, each with the target's shape estimated at the fit before."""

SHAPE_TOLERANCE = 0.1
"""Change of the shape's coefficients, in standard deviations, at which the fits have converged."""

VAGUE_SHAPE_STD = 1e-2
"""Prior standard deviation of the shape's coefficients, in half sizes of the target.

Vague, so that it holds only undetermined coefficients: sheets bow by a tenth of it.
"""


class FreePoseFit(NamedTuple):
    """The fit with free poses.

    Attributes:
        problem: the problem that was solved.
        z: its solution.
        equations: its normal equations there.
        sum_of_squares: sum of its squared residuals, px^2.
        shape: the target's shape; None if it is held as stated.
    """

    problem: JointProblem
    z: Step
    equations: NormalEquations
    sum_of_squares: float
    shape: TargetShape | None


def choice_for_free_poses(
    choice: ParameterChoice, start: Calibration, view_count: int
) -> ParameterChoice:
    """Return a choice of parameters with which any number of views can be fitted with free poses.

    One or two views do not tell a lens: it is held. The prior on the mount has no effect, since
    every view has a free pose, but so few views are refused without one.
    """
    if view_count >= 3:
        return choice
    mount = {start.transform_names[0]: Prior(std=1.0)}
    return choice.holding("camera")._replace(priors=choice.priors | mount)


def fit_free_poses(
    built: BuiltProblem,
    usable_views: Int[np.ndarray, "placed"],
    shape: TargetShape | None,
    start: Step | None = None,
) -> FreePoseFit:
    """Fit camera, poses and shape to the pixels alone.

    Args:
        built: problem, with a pixel sigma of 1 px.
        usable_views: indices of the views that are fitted.
        shape: shape of the target to begin with; None holds it as stated.
        start: step at which the fit begins; by default zero.
    """
    views, fits = ViewStatistics(built, built.pose_parameters(usable_views), 0.0, shape=shape), 0
    while True:
        problem = with_free_poses(views.one_camera)
        solution, equations = solve(problem, start=start)
        sum_of_squares, fits = 2.0 * float(equations.cost), fits + 1
        fit = FreePoseFit(problem, solution.z, equations, sum_of_squares, shape)
        if shape is None or fits == MAX_SHAPE_FITS:
            return fit
        variance = sum_of_squares / max(problem.number_count - views.statistic_count, 1)
        change, std = _shape_step(views, solution.z, shape, variance)
        if not np.isfinite(change).all() or (np.abs(change) <= SHAPE_TOLERANCE * std).all():
            return fit
        shape = shape.with_coefficients(np.asarray(shape.coefficients) + change)
        views, start = views.with_shape(shape), solution.z


def _shape_step(
    views: ViewStatistics, z: Step, shape: TargetShape, variance: float
) -> tuple[Float[np.ndarray, "5"], Float[np.ndarray, "5"]]:
    """Return the step of the shape to its best value, and its standard deviations.

    Args:
        views: statistics of the views.
        z: the fit with this shape.
        shape: the shape.
        variance: of a pixel's u and v, px^2.
    """
    linearised = views.linearise(z)
    if not np.isfinite(linearised.matrix.shared).all():
        return np.full(len(views.shape_names), np.nan), np.ones(len(views.shape_names))
    names = len(views.shape_names)
    # The chain is held, camera and poses are free, so only the shared parameters of camera and
    # shape remain.
    shared = np.arange(len(linearised.gradient.shared))
    is_camera = views.one_camera.is_camera[views.free]
    kept = np.append(np.flatnonzero(is_camera), shared[-names:])
    matrix, gradient = _without_poses(linearised, kept)
    vague = variance / (VAGUE_SHAPE_STD * float(shape.half_size)) ** 2
    matrix[-names:, -names:] += vague * np.eye(names)
    gradient[-names:] += vague * np.asarray(shape.coefficients)
    # Focal lengths and coefficients differ by many orders of magnitude.
    norms = np.sqrt(np.diagonal(matrix))
    covariance = np.linalg.pinv(matrix / np.outer(norms, norms), hermitian=True)
    covariance = covariance / np.outer(norms, norms)
    step, std = -covariance @ gradient, np.sqrt(variance * np.diagonal(covariance))
    return step[-names:], std[-names:]


def _without_poses(
    linearised: LinearisedViews, kept: Int[np.ndarray, "kept"]
) -> tuple[Float[np.ndarray, "kept kept"], Float[np.ndarray, "kept"]]:
    """Return the equations of some shared parameters, with free poses eliminated."""
    matrix, gradient = linearised.matrix, linearised.gradient
    border, free = matrix.border[:, :, kept], linearised.per_view_free
    # A held parameter has an empty row; 1 on its diagonal keeps the equations solvable.
    per_view = matrix.per_view + np.eye(6)[None] * np.where(free, 0.0, 1.0)[:, None]
    finite = np.isfinite(per_view).all(axis=(1, 2)) & np.isfinite(border).all(axis=(1, 2))
    determined = np.flatnonzero(finite)
    determined = determined[np.linalg.matrix_rank(per_view[determined], hermitian=True) == 6]
    gains = np.linalg.solve(per_view[determined], border[determined])
    return (
        matrix.shared[np.ix_(kept, kept)] - np.einsum("vki,vkj->ij", border[determined], gains),
        gradient.shared[kept] - np.einsum("vki,vk->i", gains, gradient.per_view[determined]),
    )
