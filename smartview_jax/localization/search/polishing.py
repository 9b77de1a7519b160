"""Refine poses so that their wireframes lie on the edges of the pictures, many poses at once.

Each visible sample of the wireframe is moved towards the nearest edge of the same direction, across
that edge (iterated closest points with Gauss-Newton steps; Lowe, "Fitting parameterized
three-dimensional models to images", 1991). The gate becomes narrower from step to step, so that
poses that start some degrees off end as accurate as the edges. This brings a hypothesis near enough
to be judged; the accurate fit, with all features, is in `refinement`.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...runtime.array_namespace import to_device
from ...runtime.compilation import compiled_optimised
from ...runtime.padding import in_batches
from ..edges import Wireframe
from .scoring import SceneMaps, in_single_precision, seen_samples

POSES_PER_CALL = 64
"""Number of poses in one call of the compiled program."""

WIDE_GATES = (14.0, 12.0, 10.0, 8.0, 6.0, 5.0, 4.0, 3.0, 3.0, 3.0)
"""Gate of each step: distance in px beyond which an edge has no weight."""

NARROW_GATES = (6.0, 5.0, 5.0, 4.0, 4.0, 3.0, 3.0, 3.0, 3.0, 3.0)
"""The same for poses that are already near: with wide gates other edges attract them, such as the
second side of a frame."""

DAMPING = 1e-4
"""Damping of the normal equations, over their mean diagonal; without edges a pose stays fixed."""


def polished_poses(
    maps: SceneMaps,
    wireframe: Wireframe,
    world_from_object: Float[np.ndarray, "poses 4 4"],
    gates: tuple[float, ...] = WIDE_GATES,
) -> Float[np.ndarray, "poses 4 4"]:
    """Return poses refined on the edges of the pictures.

    Args:
        maps: of the pictures.
        wireframe: of the model.
        world_from_object: the poses.
        gates: distance in px beyond which an edge has no weight, for each step.
    """
    single, steps = in_single_precision(wireframe), to_device(np.array(gates, np.float32))

    def of_batch(poses: Float[Array, "poses 4 4"]) -> Float[Array, "poses 4 4"]:
        return _polish(maps, single, poses, steps)

    moved = in_batches(of_batch, world_from_object.astype(np.float32), POSES_PER_CALL)
    # An undetermined pose may diverge, even to NaN; the initial pose is kept then.
    kept = np.isfinite(moved).all(axis=(1, 2), keepdims=True)
    return _orthonormal(np.where(kept, moved, world_from_object))


def _orthonormal(poses: Float[np.ndarray, "poses 4 4"]) -> Float[np.ndarray, "poses 4 4"]:
    """Return poses with their rotations made orthonormal in double precision."""
    U, _, Vt = np.linalg.svd(poses[:, :3, :3])
    poses[:, :3, :3] = U @ Vt
    return poses


@compiled_optimised
def _polish(
    maps: SceneMaps,
    wireframe: Wireframe,
    world_from_object: Float[Array, "poses 4 4"],
    gates: Float[Array, "steps"],
) -> Float[Array, "poses 4 4"]:
    """Return the poses after one step for each gate."""

    def step(
        poses: Float[Array, "poses 4 4"], gate: Float[Array, ""]
    ) -> tuple[Float[Array, "poses 4 4"], None]:
        return jax.vmap(lambda pose: _step(maps, wireframe, pose, gate))(poses), None

    return jax.lax.scan(step, world_from_object, gates)[0]


def _step(
    maps: SceneMaps, wireframe: Wireframe, pose: Float[Array, "4 4"], gate: Float[Array, ""]
) -> Float[Array, "4 4"]:
    """Return a pose after one Gauss-Newton step."""
    # Lengths in units of the object's radius: the six unknowns have similar sizes.
    radius = jnp.sqrt((wireframe.samples**2).sum(axis=1).max())
    hessian, gradient = jnp.zeros((6, 6), pose.dtype), jnp.zeros(6, pose.dtype)
    for view in range(len(maps.camera_from_world)):
        residual, J, weight = _residuals(maps, view, wireframe, pose, gate)
        # Summed over the views, which all see the same rigid object.
        J = jnp.concatenate([J[:, :3] * radius, J[:, 3:]], axis=1)
        hessian = hessian + J.T @ (weight[:, None] * J)
        gradient = gradient + J.T @ (weight * residual)
    damping = DAMPING * (jnp.trace(hessian) / 6.0 + 1.0)
    tangent = -_solved(hessian + damping * jnp.eye(6, dtype=pose.dtype), gradient)
    # Far from the minimum a step may be much too long.
    tangent = tangent / jnp.maximum(1.0, jnp.sqrt((tangent**2).sum()) / 0.3)
    return pose @ _exponential(jnp.concatenate([tangent[:3] * radius, tangent[3:]]))


def _residuals(
    maps: SceneMaps,
    view: int,
    wireframe: Wireframe,
    pose: Float[Array, "4 4"],
    gate: Float[Array, ""],
) -> tuple[Float[Array, "S"], Float[Array, "S 6"], Float[Array, "S"]]:
    """Return the samples' distances across the nearest edges, derivatives by the pose, weights."""
    samples = seen_samples(maps, view, wireframe, pose)
    nearest = maps.nearest[view].reshape(-1)[samples.cell]
    offset = samples.ideal - maps.points[view, nearest]
    normal = maps.normals[view, nearest]
    # Points far along the same line do not belong to the sample.
    squared = (offset**2).sum(axis=1) / gate**2
    weight = jnp.where(
        samples.visible & samples.inside, samples.px * jnp.maximum(1.0 - squared, 0.0) ** 2, 0.0
    )
    # p_camera = R (p + v + w x p) + t, and with u = (f x / z, f y / z)
    # n . du = (n_x, n_y, -n . u / f) f / z . dp_camera
    R = (maps.camera_from_world[view] @ pose)[:3, :3]
    f, z = maps.focal_length[view], samples.in_camera[:, 2]
    along = -(normal * samples.ideal).sum(axis=1) / f
    covector = jnp.concatenate([normal, along[:, None]], axis=1) * (f / z)[:, None]
    by_shift = covector @ R
    by_turn = jnp.cross(samples.in_object, by_shift)
    usable = (weight > 0.0)[:, None]
    J = jnp.where(usable, jnp.concatenate([by_shift, by_turn], axis=1), 0.0)
    return jnp.where(usable[:, 0], (offset * normal).sum(axis=1), 0.0), J, weight


def _solved(matrix: Float[Array, "6 6"], right: Float[Array, "6"]) -> Float[Array, "6"]:
    """Return the solution of a positive definite system, by elimination without pivots."""
    # Written out, because a LAPACK call for each of many small systems costs far more. Pivots are
    # not needed: the matrix is damped, so that none of them is near zero.
    augmented = jnp.concatenate([matrix, right[:, None]], axis=1)
    for k in range(6):
        row = augmented[k] / augmented[k, k]
        factors = augmented[:, k].at[k].set(0.0)
        augmented = (augmented - factors[:, None] * row[None]).at[k].set(row)
    return augmented[:, 6]


def _exponential(tangent: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """Return a rigid transform near the exponential of a small tangent, exactly a rotation."""
    # Cayley's map R = (I - W/2)^-1 (I + W/2) agrees with the exponential to second order.
    x, y, z = 0.5 * tangent[3:]
    s = 1.0 + x**2 + y**2 + z**2
    rows = [
        [1.0 + x**2 - y**2 - z**2, 2.0 * (x * y - z), 2.0 * (x * z + y)],
        [2.0 * (x * y + z), 1.0 - x**2 + y**2 - z**2, 2.0 * (y * z - x)],
        [2.0 * (x * z - y), 2.0 * (y * z + x), 1.0 - x**2 - y**2 + z**2],
    ]
    rotation = jnp.stack([jnp.stack(row) for row in rows]) / s
    upper = jnp.concatenate([rotation, tangent[:3, None]], axis=1)
    return jnp.concatenate([upper, jnp.array([[0.0, 0.0, 0.0, 1.0]], tangent.dtype)])
