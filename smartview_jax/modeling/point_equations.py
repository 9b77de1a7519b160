"""State the least-squares problem of points seen in several views, for all points at once.

Gradients and normal matrices are tuples of their components rather than small matrices, because
XLA's batched products of small matrices are slow on CPUs.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..cameras import AnyCamera
from ..engine import AbstractLoss


class PointProblem(NamedTuple):
    """The arguments of `estimate_points`."""

    camera: AnyCamera
    camera_from_world: Float[Array, "views 4 4"]
    pixels: Float[Array, "views points 2"]
    whitening: Float[Array, "#views #points 2 2"]
    visible: Bool[Array, "views points"]
    loss: AbstractLoss | None


class Linearisation(NamedTuple):
    """The cost of points, with gradient and normal matrix as tuples of their components."""

    cost: Float[Array, "points"]
    gradient: tuple[Array, ...]
    normal: tuple[Array, ...]
    residuals: tuple[Array, Array]
    valid: Bool[Array, "points"]


def to_camera(
    problem: PointProblem, points: Float[Array, "points 3"]
) -> Float[Array, "views points 3"]:
    """Return points in the frames of all cameras."""
    # Sums of vector products, which XLA fuses with the following operations, unlike a batched
    # product.
    pose = problem.camera_from_world
    return jnp.stack(
        [
            sum(pose[:, i, j, None] * points[None, :, j] for j in range(3)) + pose[:, i, 3, None]
            for i in range(3)
        ],
        axis=-1,
    )


def linearise(problem: PointProblem, points: Float[Array, "points 3"]) -> Linearisation:
    """Compute the cost of all points with its gradient and Gauss-Newton matrix."""
    # Masked pixels are set to zero before the product, since zero times NaN is NaN.
    in_camera, visible = to_camera(problem, points), problem.visible
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

    # Measured minus predicted, as everywhere in this package.
    residual = problem.pixels - predicted
    ru, rv = whitened(residual)
    squared = ru * ru + rv * rv
    cost, weight = squared, jnp.ones_like(squared)
    if problem.loss is not None:
        # Iteratively reweighted least squares: the weight is the loss's derivative, rho'(s).
        cost, weight = jax.jvp(problem.loss.rho, (squared,), (jnp.ones_like(squared),))
    # Gradient -J^T w r and normal matrix J^T w J, the upper triangle in rows.
    J = [whitened(column) for column in columns]
    gradient = tuple(-jnp.sum(weight * (ju * ru + jv * rv), axis=0) for ju, jv in J)
    normal = tuple(
        jnp.sum(weight * (J[i][0] * J[k][0] + J[i][1] * J[k][1]), axis=0)
        for i in range(3)
        for k in range(i, 3)
    )
    # A visible pixel without a prediction makes the cost infinite.
    all_valid = jnp.all(valid | ~visible, axis=0)
    plain = (jnp.where(used, residual[..., 0], 0.0), jnp.where(used, residual[..., 1], 0.0))
    total = jnp.where(all_valid, jnp.sum(cost, axis=0), jnp.inf)
    return Linearisation(total, gradient, normal, plain, all_valid)


def inverse(normal: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
    """Return trace and components of the inverses of symmetric 3x3 matrices, by their adjugates.

    For a singular matrix the trace is infinite and the inverse zero.
    """
    # Rows of the symmetric matrix: (a b c), (b d e), (c e f); capitals are its cofactors.
    a, b, c, d, e, f = normal
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * A + b * B + c * C
    # A determinant below the rounding error of its terms counts as zero.
    regular = determinant > 1e-14 * a * d * f
    factor = jnp.where(regular, 1.0 / jnp.where(regular, determinant, 1.0), 0.0)
    trace = jnp.where(regular, (A + D + F) * factor, jnp.inf)
    return trace, tuple(cofactor * factor for cofactor in (A, B, C, D, E, F))


def solve(
    normal: tuple[Array, ...], right: tuple[Array, ...]
) -> tuple[Array, tuple[Array, Array, Array]]:
    """Return the trace of the inverses of symmetric 3x3 matrices, and the systems' solutions."""
    trace, (A, B, C, D, E, F) = inverse(normal)
    x, y, z = right
    return trace, (A * x + B * y + C * z, B * x + D * y + E * z, C * x + E * y + F * z)


def mean_distance(
    problem: PointProblem, points: Float[Array, "points 3"]
) -> Float[Array, "points"]:
    """Return the mean distance of points from the cameras that see them."""
    distance = jnp.linalg.norm(to_camera(problem, points), axis=-1)
    # Views that do not see a point do not count.
    weight = problem.visible.astype(float)
    return jnp.sum(weight * distance, axis=0) / jnp.maximum(jnp.sum(weight, axis=0), 1.0)
