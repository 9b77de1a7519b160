"""Estimate points from the pixels of several views by least squares, as one batched program.

The start is linear: the point nearest to all rays. Each step of Levenberg-Marquardt then minimises
the squared whitened pixel residuals through the real lens, for all points at once. The result is
differentiable, by one Newton step from the optimum, whose derivative is that of the optimum itself
to first order in the residuals.
"""

from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..cameras import Camera
from ..compilation import compiled
from ..engine import AbstractLoss

MAX_RELATIVE_STD = 0.25
"""The standard deviation of a point's distance, over the distance, beyond which it is not returned.

Its rays are then parallel within their errors, and no Gaussian describes where it is."""

MAX_STEPS = 30
"""The largest number of steps of Levenberg-Marquardt."""

CONVERGED_DECREMENT = 1e-10
"""The squared length of a step, in standard deviations of the point, that ends the iterations."""

INITIAL_DAMPING, MIN_DAMPING = 1e-6, 1e-12
"""Damping relative to the diagonal of the normal matrix, at the start and at its smallest."""

CHUNK = 2048
"""Points that are estimated at once."""

_TINY = 1e-300
"""A divisor that stands for zero, where the quotient is not used."""


class PointStatus(IntEnum):
    """The outcome of the estimation of one point or line."""

    OK = 0
    TOO_FEW_VIEWS = 1
    DEGENERATE_BASELINE = 2
    BEHIND_CAMERA = 3
    NOT_CONVERGED = 4
    EPIPOLAR_PLANE = 5

    @property
    def message(self) -> str:
        """A sentence for people that says what is wrong."""
        return _MESSAGES[self]


_MESSAGES = {
    PointStatus.OK: "it was estimated",
    PointStatus.TOO_FEW_VIEWS: "fewer than two views see it where their lens is valid",
    PointStatus.DEGENERATE_BASELINE: "its rays are parallel within their errors, so that its "
    "distance is open: views from further apart are needed",
    PointStatus.BEHIND_CAMERA: "its rays meet behind a camera that sees it, or outside its "
    "lens: the correspondence or a pose is wrong",
    PointStatus.NOT_CONVERGED: "the least-squares estimate did not converge",
    PointStatus.EPIPOLAR_PLANE: "it lies in the epipolar plane of its views within its errors: "
    "any line of that plane explains them, and a view from outside it is needed",
}


def failure_messages(status: Int[np.ndarray, "features"]) -> dict[int, str]:
    """Return the reason, in words, of every point or line that was not estimated, by its index."""
    failed = np.flatnonzero(status != PointStatus.OK)
    return {int(k): PointStatus(status[k]).message for k in failed}


class PointSolution(NamedTuple):
    """The estimated points as JAX arrays; numbers of points that failed are arbitrary.

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
    camera: Camera,
    camera_from_world: Float[Array, "views 4 4"],
    pixels: Float[Array, "views points 2"],
    whitening: Float[Array, "#views #points 2 2"],
    visible: Bool[Array, "views points"],
    loss: AbstractLoss | None = None,
) -> PointSolution:
    """Estimate points from their pixels in views of known pose.

    It works under `jit`, `vmap` and differentiation by all arrays and the camera's parameters.

    Args:
        camera: intrinsics and lens.
        camera_from_world: extrinsics.
        pixels: px; any finite number where not visible.
        whitening: matrices that scale pixel errors to unit covariance.
        visible: where a point is seen.
        loss: robust loss of the whitened residuals; None is least squares.
    """
    problem = _Problem(camera, camera_from_world, pixels, whitening, visible, loss)
    count = pixels.shape[1]
    if count <= CHUNK:
        return _estimate(problem)
    # Points are independent: a chunk at a time stays in the processor's cache, and ends its
    # iterations when its own points are done.
    chunks = -(-count // CHUNK)

    def in_chunks(array: Array) -> Array:
        if array.shape[1] == 1:
            return jnp.broadcast_to(array[None], (chunks, *array.shape))
        rest = ((0, 0), (0, chunks * CHUNK - count), *((0, 0),) * (array.ndim - 2))
        parts = jnp.pad(array, rest).reshape(array.shape[0], chunks, CHUNK, *array.shape[2:])
        return jnp.moveaxis(parts, 1, 0)

    def one(chunk: tuple[Array, Array, Array]) -> PointSolution:
        pixels, whitening, visible = chunk
        return _estimate(problem._replace(pixels=pixels, whitening=whitening, visible=visible))

    found = jax.lax.map(one, tuple(map(in_chunks, (pixels, whitening, visible))))
    residuals = jnp.moveaxis(found.residuals, 0, 1).reshape(len(pixels), -1, 2)
    points, covariance, status = (
        array.reshape(-1, *array.shape[2:])[:count]
        for array in (found.points, found.covariance, found.status)
    )
    return PointSolution(points, covariance, residuals[:, :count], status)


@jax.custom_jvp
def _estimate(problem: "_Problem") -> PointSolution:
    """Estimate all points of a problem at once."""
    start, degenerate, enough = _nearest_to_rays(problem)
    points, at, decrement = _minimise(problem, start, degenerate | ~enough)
    return _solution(problem, points, at, (decrement, degenerate, enough))


@_estimate.defjvp
def _estimate_jvp(
    primals: tuple["_Problem"], tangents: tuple["_Problem"]
) -> tuple[PointSolution, PointSolution]:
    """Return the estimate and its directional derivative, without those of the iterations."""
    (problem,), found = primals, _estimate(*primals)
    points = jax.lax.stop_gradient(found.points)

    def one_step(problem: _Problem) -> PointSolution:
        # One more Newton step, x - H^-1 g(x) with H held, stays at the optimum, and its derivative
        # is that of the optimum.
        at = _linearise(problem, points)
        _, step = _solve(jax.lax.stop_gradient(at.normal), at.gradient)
        moved = points - jnp.where(at.valid[:, None], jnp.stack(step, axis=-1), 0.0)
        settled = jnp.zeros(len(points)), jnp.zeros(len(points), bool), jnp.ones(len(points), bool)
        return _solution(problem, moved, at, settled)

    return found, jax.jvp(one_step, (problem,), tangents)[1]


def _solution(
    problem: "_Problem",
    points: Float[Array, "points 3"],
    at: "_Linearisation",
    outcome: tuple[Float[Array, "points"], Bool[Array, "points"], Bool[Array, "points"]],
) -> PointSolution:
    """Return points with covariance and status, from the last linearisation and the outcome."""
    decrement, degenerate, enough = outcome
    distance = _mean_distance(problem, points)
    trace, (a, b, c, d, e, f) = _inverse(at.normal)
    degenerate |= at.valid & (trace > (MAX_RELATIVE_STD * distance) ** 2)
    status = jnp.where(decrement > CONVERGED_DECREMENT, PointStatus.NOT_CONVERGED, PointStatus.OK)
    status = jnp.where(at.valid, status, PointStatus.BEHIND_CAMERA)
    status = jnp.where(degenerate, PointStatus.DEGENERATE_BASELINE, status)
    status = jnp.where(enough, status, PointStatus.TOO_FEW_VIEWS)
    covariance = jnp.stack(
        [jnp.stack(row, axis=-1) for row in ((a, b, c), (b, d, e), (c, e, f))], axis=-2
    )
    return PointSolution(points, covariance, jnp.stack(at.residuals, axis=-1), status)


class _Problem(NamedTuple):
    """The arguments of `estimate_points`."""

    camera: Camera
    camera_from_world: Float[Array, "views 4 4"]
    pixels: Float[Array, "views points 2"]
    whitening: Float[Array, "#views #points 2 2"]
    visible: Bool[Array, "views points"]
    loss: AbstractLoss | None


class _Linearisation(NamedTuple):
    """The cost of points, with gradient and normal matrix as tuples of their components.

    Components rather than small matrices, because XLA's batched products of those are slow on CPUs.
    """

    cost: Float[Array, "points"]
    gradient: tuple[Array, ...]
    normal: tuple[Array, ...]
    residuals: tuple[Array, Array]
    valid: Bool[Array, "points"]


def _to_camera(
    problem: _Problem, points: Float[Array, "points 3"]
) -> Float[Array, "views points 3"]:
    """Return points in the frames of all cameras."""
    pose = problem.camera_from_world
    return jnp.stack(
        [
            sum(pose[:, i, j, None] * points[None, :, j] for j in range(3)) + pose[:, i, 3, None]
            for i in range(3)
        ],
        axis=-1,
    )


def _linearise(problem: _Problem, points: Float[Array, "points 3"]) -> _Linearisation:
    """Compute the cost of all points with its gradient and Gauss-Newton matrix."""
    # Masked pixels are zero before they are multiplied: zero times NaN would be NaN.
    in_camera, visible = _to_camera(problem, points), problem.visible
    pose, whitening = problem.camera_from_world, problem.whitening
    predicted, valid = problem.camera.project(in_camera)
    # d(pixel)/dx_k: the tangent of camera coordinates is column k of the rotation.
    columns = [
        jax.jvp(
            lambda p: problem.camera.project(p)[0],
            (in_camera,),
            (jnp.broadcast_to(pose[:, None, :3, k], in_camera.shape),),
        )[1]
        for k in range(3)
    ]
    used = visible & valid

    def whitened(pixel: Array) -> tuple[Array, Array]:
        u, v = (jnp.where(used, pixel[..., k], 0.0) for k in (0, 1))
        return (
            whitening[..., 0, 0] * u + whitening[..., 0, 1] * v,
            whitening[..., 1, 0] * u + whitening[..., 1, 1] * v,
        )

    residual = problem.pixels - predicted
    ru, rv = whitened(residual)
    squared = ru * ru + rv * rv
    cost, weight = squared, jnp.ones_like(squared)
    if problem.loss is not None:
        # Iteratively reweighted least squares: the weight is the loss's derivative, rho'(s).
        cost, weight = jax.jvp(problem.loss.rho, (squared,), (jnp.ones_like(squared),))
    J = [whitened(column) for column in columns]
    gradient = tuple(-jnp.sum(weight * (ju * ru + jv * rv), axis=0) for ju, jv in J)
    normal = tuple(
        jnp.sum(weight * (J[i][0] * J[k][0] + J[i][1] * J[k][1]), axis=0)
        for i in range(3)
        for k in range(i, 3)
    )
    # A visible pixel without a prediction has no cost that could be compared: infinite.
    all_valid = jnp.all(valid | ~visible, axis=0)
    plain = (jnp.where(used, residual[..., 0], 0.0), jnp.where(used, residual[..., 1], 0.0))
    total = jnp.where(all_valid, jnp.sum(cost, axis=0), jnp.inf)
    return _Linearisation(total, gradient, normal, plain, all_valid)


def _inverse(normal: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
    """Return trace and components of the inverses of symmetric 3x3 matrices, by their adjugates.

    Where a matrix is singular the trace is infinite and the inverse zero.
    """
    a, b, c, d, e, f = normal
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * A + b * B + c * C
    # Below the rounding error of its terms a determinant is zero.
    regular = determinant > 1e-14 * a * d * f
    factor = jnp.where(regular, 1.0 / jnp.where(regular, determinant, 1.0), 0.0)
    trace = jnp.where(regular, (A + D + F) * factor, jnp.inf)
    return trace, tuple(one * factor for one in (A, B, C, D, E, F))


def _solve(
    normal: tuple[Array, ...], right: tuple[Array, ...]
) -> tuple[Array, tuple[Array, Array, Array]]:
    """Return the trace of the inverses of symmetric 3x3 matrices, and the systems' solutions."""
    trace, (A, B, C, D, E, F) = _inverse(normal)
    x, y, z = right
    return trace, (A * x + B * y + C * z, B * x + D * y + E * z, C * x + E * y + F * z)


def _nearest_to_rays(
    problem: _Problem,
) -> tuple[Float[Array, "points 3"], Bool[Array, "points"], Bool[Array, "points"]]:
    """Return the points nearest to their rays, whether these are parallel, and whether enough.

    A ray from centre c along the unit vector d is at the distance `|(I - d d^T)(x - c)|` from x,
    which is linear in x. The second pass divides each distance by that from the camera, so that
    angles count instead of metres.
    """
    camera, pose, whitening = problem.camera, problem.camera_from_world, problem.whitening
    rays, valid = camera.unproject(problem.pixels)
    used = problem.visible & valid
    rays = jnp.where(used[..., None], rays, 0.0)
    d = [sum(pose[:, j, i, None] * rays[..., j] for j in range(3)) for i in range(3)]
    centres = [-sum(pose[:, j, i] * pose[:, j, 3] for j in range(3)) for i in range(3)]
    middle = [jnp.mean(c) for c in centres]
    c = [(one - m)[:, None] for one, m in zip(centres, middle, strict=True)]
    # An angle of one pixel is about 1 / sqrt(alpha_u alpha_v) rad.
    information = jnp.abs(
        whitening[..., 0, 0] * whitening[..., 1, 1] - whitening[..., 0, 1] * whitening[..., 1, 0]
    ) * (camera.alpha_u * camera.alpha_v)
    # Angles are the same near and far; only the second pass knows the distances.
    weight = jnp.where(used, information, 0.0)
    x = [jnp.zeros(problem.pixels.shape[1])] * 3
    relative_variance = x[0]
    for k in range(2):
        along = [sum(d[j] * c[j] for j in range(3)), d]
        normal = tuple(
            jnp.sum(weight * ((1.0 if i == j else 0.0) - d[i] * d[j]), axis=0)
            for i in range(3)
            for j in range(i, 3)
        )
        right = tuple(jnp.sum(weight * (c[i] - along[0] * d[i]), axis=0) for i in range(3))
        trace, solution = _solve(normal, right)
        x = list(solution)
        if k == 0:
            relative_variance = trace
            squared_distance = sum((x[j][None] - c[j]) ** 2 for j in range(3))
            weight = weight / jnp.maximum(squared_distance, _TINY)
    # Relative to the cameras' middle the squares above keep more digits.
    start = jnp.stack([x[j] + middle[j] for j in range(3)], axis=-1)
    enough = jnp.sum(used.astype(float), axis=0) > 1.5
    return start, ~(relative_variance < MAX_RELATIVE_STD**2), enough


def _mean_distance(problem: _Problem, points: Float[Array, "points 3"]) -> Float[Array, "points"]:
    """Return the mean distance of points from the cameras that see them."""
    distance = jnp.linalg.norm(_to_camera(problem, points), axis=-1)
    # Views that do not see it have no say in how far a point may be off.
    seen = problem.visible.astype(float)
    return jnp.sum(seen * distance, axis=0) / jnp.maximum(jnp.sum(seen, axis=0), 1.0)


def _minimise(
    problem: _Problem, start: Float[Array, "points 3"], skip: Bool[Array, "points"]
) -> tuple[Float[Array, "points 3"], _Linearisation, Float[Array, "points"]]:
    """Minimise the costs of all points together, each with its own damping.

    Returns:
        The points, their linearisation, and the squared length of the next undamped step in
        standard deviations.
    """
    # Each trial is linearised at once, whether it is accepted or not: in all but a few points it
    # is, and one pass over the pixels then does both.
    first = _linearise(problem, start)
    damping = jnp.full(start.shape[0], INITIAL_DAMPING)

    def decrement(at: _Linearisation) -> Float[Array, "points"]:
        _, step = _solve(at.normal, at.gradient)
        length = sum(g * s for g, s in zip(at.gradient, step, strict=True))
        return jnp.where(at.valid, length, jnp.inf)

    def unfinished(state: tuple) -> Bool[Array, ""]:
        count, _, at, _ = state
        open_points = ~skip & at.valid & (decrement(at) > CONVERGED_DECREMENT)
        return (count < MAX_STEPS) & jnp.any(open_points)

    def step(state: tuple) -> tuple:
        count, points, at, damping = state
        a, b, c, d, e, f = at.normal
        more = 1.0 + damping
        # Marquardt's scaling: damping in proportion to the diagonal, without units.
        _, change = _solve((a * more, b, c, d * more, e, f * more), at.gradient)
        trial_points = points - jnp.stack(change, axis=-1)
        trial = _linearise(problem, trial_points)
        # A trial behind a camera has infinite cost, and is never better.
        better = trial.cost <= at.cost
        kept = jax.tree.map(
            lambda new, old: jnp.where(
                better.reshape((1,) * (new.ndim - 1) + better.shape), new, old
            ),
            trial,
            at,
        )
        points = jnp.where(better[:, None], trial_points, points)
        damping = jnp.where(better, jnp.maximum(0.1 * damping, MIN_DAMPING), 100.0 * damping)
        return count + 1, points, kept, damping

    _, points, at, _ = jax.lax.while_loop(unfinished, step, (0, start, first, damping))
    return points, at, decrement(at)
