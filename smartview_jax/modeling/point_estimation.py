"""Estimate points from the pixels of several views by least squares, as one batched program.

The start is linear: the point nearest to all rays. Levenberg-Marquardt then minimises the squared
whitened pixel residuals with the real lens, for all points at once. The result is differentiable
through one Newton step from the optimum, whose derivative equals the optimum's derivative to first
order in the residuals.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..cameras import AnyCamera
from ..engine import AbstractLoss
from ..runtime.compilation import compiled
from .estimated_features import MAX_RELATIVE_STD, PointStatus
from .point_equations import Linearisation, PointProblem, inverse, linearise, mean_distance, solve

MAX_STEPS = 30
"""Largest number of Levenberg-Marquardt steps."""

CONVERGED_DECREMENT = 1e-10
"""Squared length of a step, in standard deviations of the point, at which the iterations end."""

INITIAL_DAMPING, MIN_DAMPING = 1e-6, 1e-12
"""Initial and smallest damping, relative to the diagonal of the normal matrix."""

CHUNK = 2048
"""Number of points that are estimated at once."""

_TINY = 1e-300
"""A divisor in place of zero, where the quotient is not used."""


class PointSolution(NamedTuple):
    """The estimated points as JAX arrays; the values of failed points are arbitrary.

    Attributes:
        points: in the world, m.
        covariance: covariance of each point due to its pixels, m^2.
        residuals: measured minus predicted pixels, zero where not visible.
        status: a `PointStatus` each.
    """

    points: Float[Array, "points 3"]
    covariance: Float[Array, "points 3 3"]
    residuals: Float[Array, "views points 2"]
    status: Array


@compiled
def estimate_points(
    camera: AnyCamera,
    camera_from_world: Float[Array, "views 4 4"],
    pixels: Float[Array, "views points 2"],
    whitening: Float[Array, "#views #points 2 2"],
    visible: Bool[Array, "views points"],
    loss: AbstractLoss | None = None,
) -> PointSolution:
    """Estimate points from their pixels in views of known pose.

    It supports `jit`, `vmap` and differentiation by all arrays and the camera's parameters.

    Args:
        camera: intrinsics and lens, of all views or of each.
        pixels: px; any finite number where not visible.
        whitening: matrices that scale pixel errors to unit covariance.
        loss: robust loss of the whitened residuals; None is least squares.
    """
    problem = PointProblem(camera, camera_from_world, pixels, whitening, visible, loss)
    count = pixels.shape[1]
    if count <= CHUNK:
        return _estimate(problem)
    # Points are independent: one chunk at a time stays in the processor's cache, and iterates only
    # until its own points converge.
    chunks = -(-count // CHUNK)

    def in_chunks(array: Array) -> Array:
        # Whitening may be the same for all points, and is not repeated in memory.
        if array.shape[1] == 1:
            return jnp.broadcast_to(array[None], (chunks, *array.shape))
        rest = ((0, 0), (0, chunks * CHUNK - count), *((0, 0),) * (array.ndim - 2))
        parts = jnp.pad(array, rest).reshape(array.shape[0], chunks, CHUNK, *array.shape[2:])
        return jnp.moveaxis(parts, 1, 0)

    def estimate_chunk(chunk: tuple[Array, Array, Array]) -> PointSolution:
        pixels, whitening, visible = chunk
        return _estimate(problem._replace(pixels=pixels, whitening=whitening, visible=visible))

    chunked = jax.lax.map(estimate_chunk, tuple(map(in_chunks, (pixels, whitening, visible))))
    residuals = jnp.moveaxis(chunked.residuals, 0, 1).reshape(len(pixels), -1, 2)
    points, covariance, status = (
        array.reshape(-1, *array.shape[2:])[:count]
        for array in (chunked.points, chunked.covariance, chunked.status)
    )
    return PointSolution(points, covariance, residuals[:, :count], status)


@jax.custom_jvp
def _estimate(problem: PointProblem) -> PointSolution:
    start, degenerate, enough = nearest_to_rays(problem)
    points, at, decrement = _minimise(problem, start, degenerate | ~enough)
    return _solution(problem, points, at, (decrement, degenerate, enough))


@_estimate.defjvp
def _estimate_jvp(
    primals: tuple[PointProblem], tangents: tuple[PointProblem]
) -> tuple[PointSolution, PointSolution]:
    """Return the estimate and its directional derivative; the iterations are not differentiated."""
    (problem,), solution = primals, _estimate(*primals)
    points = jax.lax.stop_gradient(solution.points)

    def one_step(problem: PointProblem) -> PointSolution:
        # One more Newton step, x - H^-1 g(x) with H held constant, stays at the optimum and has the
        # optimum's derivative.
        at = linearise(problem, points)
        _, step = solve(jax.lax.stop_gradient(at.normal), at.gradient)
        moved = points - jnp.where(at.valid[:, None], jnp.stack(step, axis=-1), 0.0)
        settled = jnp.zeros(len(points)), jnp.zeros(len(points), bool), jnp.ones(len(points), bool)
        return _solution(problem, moved, at, settled)

    return solution, jax.jvp(one_step, (problem,), tangents)[1]


def _solution(
    problem: PointProblem,
    points: Float[Array, "points 3"],
    at: Linearisation,
    outcome: tuple[Float[Array, "points"], Bool[Array, "points"], Bool[Array, "points"]],
) -> PointSolution:
    """Return points with covariance and status, from the last linearisation and the outcome."""
    decrement, degenerate, enough = outcome
    distance = mean_distance(problem, points)
    trace, (a, b, c, d, e, f) = inverse(at.normal)
    # Tested at the optimum, too: the start uses only angles between rays.
    degenerate |= at.valid & (trace > (MAX_RELATIVE_STD * distance) ** 2)
    # The last assignment wins, so that the first cause is reported: too few views before all
    # others.
    status = jnp.where(decrement > CONVERGED_DECREMENT, PointStatus.NOT_CONVERGED, PointStatus.OK)
    status = jnp.where(at.valid, status, PointStatus.BEHIND_CAMERA)
    status = jnp.where(degenerate, PointStatus.DEGENERATE_BASELINE, status)
    status = jnp.where(enough, status, PointStatus.TOO_FEW_VIEWS)
    covariance = jnp.stack(
        [jnp.stack(row, axis=-1) for row in ((a, b, c), (b, d, e), (c, e, f))], axis=-2
    )
    return PointSolution(points, covariance, jnp.stack(at.residuals, axis=-1), status)


def _minimise(
    problem: PointProblem, start: Float[Array, "points 3"], skip: Bool[Array, "points"]
) -> tuple[Float[Array, "points 3"], Linearisation, Float[Array, "points"]]:
    """Minimise the costs of all points together, each with its own damping.

    With points and linearisation comes the squared next undamped step, in standard deviations.
    """
    # Each trial is linearised immediately: nearly all are accepted, so one pass over the pixels
    # gives both cost and derivatives.
    first = linearise(problem, start)
    damping = jnp.full(start.shape[0], INITIAL_DAMPING)

    def decrement(at: Linearisation) -> Float[Array, "points"]:
        _, step = solve(at.normal, at.gradient)
        length = sum(g * s for g, s in zip(at.gradient, step, strict=True))
        return jnp.where(at.valid, length, jnp.inf)

    def unfinished(state: tuple) -> Bool[Array, ""]:
        count, _, at, _ = state
        # Points that failed already do not delay the others.
        open_points = ~skip & at.valid & (decrement(at) > CONVERGED_DECREMENT)
        return (count < MAX_STEPS) & jnp.any(open_points)

    def step(state: tuple) -> tuple:
        count, points, at, damping = state
        a, b, c, d, e, f = at.normal
        more = 1.0 + damping
        # Marquardt's scaling: damping in proportion to the diagonal, without units.
        _, change = solve((a * more, b, c, d * more, e, f * more), at.gradient)
        trial_points = points - jnp.stack(change, axis=-1)
        trial = linearise(problem, trial_points)
        # A trial behind a camera has infinite cost and is never accepted.
        better = trial.cost <= at.cost
        kept = jax.tree.map(
            lambda new, old: jnp.where(
                better.reshape((1,) * (new.ndim - 1) + better.shape), new, old
            ),
            trial,
            at,
        )
        points = jnp.where(better[:, None], trial_points, points)
        # Rejected steps are rare, and mostly far off: damping rises faster than it falls.
        damping = jnp.where(better, jnp.maximum(0.1 * damping, MIN_DAMPING), 100.0 * damping)
        return count + 1, points, kept, damping

    _, points, at, _ = jax.lax.while_loop(unfinished, step, (0, start, first, damping))
    return points, at, decrement(at)


def nearest_to_rays(
    problem: PointProblem,
) -> tuple[Float[Array, "points 3"], Bool[Array, "points"], Bool[Array, "points"]]:
    """Return the points nearest to their rays, whether the rays are parallel, and whether enough.

    A ray from centre c along the unit vector d is at the distance `|(I - d d^T)(x - c)|` from x,
    which is linear in x. The second pass divides each distance by the distance from the camera, so
    that angles count instead of metres.
    """
    camera, pose, whitening = problem.camera, problem.camera_from_world, problem.whitening
    rays, valid = camera.unproject(problem.pixels)
    used = problem.visible & valid
    # Rays of unused pixels are zero, and so are their weights.
    rays = jnp.where(used[..., None], rays, 0.0)
    d = [sum(pose[:, j, i, None] * rays[..., j] for j in range(3)) for i in range(3)]
    centres = [-sum(pose[:, j, i] * pose[:, j, 3] for j in range(3)) for i in range(3)]
    middle = [jnp.mean(c) for c in centres]
    c = [(centre - m)[:, None] for centre, m in zip(centres, middle, strict=True)]
    # An angle of one pixel is about 1 / sqrt(alpha_u alpha_v) rad.
    information = jnp.abs(
        whitening[..., 0, 0] * whitening[..., 1, 1] - whitening[..., 0, 1] * whitening[..., 1, 0]
    ) * (camera.alpha_u * camera.alpha_v).reshape(-1, 1)
    # The first pass weights all rays alike; only the second knows the distances.
    weight = jnp.where(used, information, 0.0)
    x = [jnp.zeros(problem.pixels.shape[1])] * 3
    relative_variance = x[0]
    # Normal equations of the squared distances: (sum w P) x = sum w P c with P = I - d d^T.
    for k in range(2):
        along = [sum(d[j] * c[j] for j in range(3)), d]
        normal = tuple(
            jnp.sum(weight * ((1.0 if i == j else 0.0) - d[i] * d[j]), axis=0)
            for i in range(3)
            for j in range(i, 3)
        )
        right = tuple(jnp.sum(weight * (c[i] - along[0] * d[i]), axis=0) for i in range(3))
        trace, solution = solve(normal, right)
        x = list(solution)
        if k == 0:
            relative_variance = trace
            squared_distance = sum((x[j][None] - c[j]) ** 2 for j in range(3))
            weight = weight / jnp.maximum(squared_distance, _TINY)
    # Relative to the middle of the cameras, the squares above keep more digits.
    start = jnp.stack([x[j] + middle[j] for j in range(3)], axis=-1)
    # A single ray has no nearest point; 1.5 separates one ray from two.
    enough = jnp.sum(used.astype(float), axis=0) > 1.5
    return start, ~(relative_variance < MAX_RELATIVE_STD**2), enough
