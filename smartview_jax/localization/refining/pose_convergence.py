"""Refine poses of known objects on the edges of the pictures, many at a time.

Each pose takes a few damped Gauss-Newton steps on the lines fitted to edge points along its visible
edges, with a search radius that shrinks from step to step.
"""

import os
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ...cameras import AnyCamera
from ...modeling import SeenViews
from ...runtime.array_namespace import to_device
from ...runtime.compilation import compiled_optimised
from ...runtime.padding import in_batches
from ..edges import (
    EXPLAINED_DISTANCE,
    INDEPENDENT_LENGTH,
    EdgeLines,
    EdgeLookup,
    Wireframe,
    lines_in_views,
    padded_poses,
)

THREADS = min(4, os.cpu_count() or 1)
"""Number of batches of poses that are computed at the same time."""

POSES_PER_BATCH = 8
"""Number of poses in one call of the compiled program."""

RADII = (12.0, 9.0, 6.5, 4.5, 3.0, 3.0)
"""Search radius of each step, px."""

TOLERANCE_OF_RADIUS = 0.25
"""Expected standard deviation of an edge in a step, as a fraction of its search radius."""

EDGE_GATE = 3.0
"""Scale of the Geman-McClure weight of an edge, in standard deviations."""

DAMPING = 1e-3
"""Damping of the steps, relative to each diagonal entry of the normal equations."""


@compiled_optimised
def converged_poses(
    wireframe: Wireframe,
    camera: AnyCamera,
    lookup: EdgeLookup,
    camera_from_world: Float[Array, "views 4 4"],
    world_from_object: Float[Array, "poses 4 4"],
) -> tuple[Float[Array, "poses 4 4"], Float[Array, "poses 2"]]:
    """Return poses after the steps of `RADII`, and their visible and explained edge lengths, px.

    Each step weights every edge of every view by Geman and McClure's function of its distance, with
    a standard deviation that shrinks with the search radius (graduated non-convexity). Where the
    steps end at a pose that explains clearly less, because other edges are within the radius or
    because too few edges are measured to determine a step, the pose stays as it is.
    """

    def step(pose: Float[Array, "4 4"], search: tuple[Float[Array, ""], Float[Array, ""]]):
        radius, length = search
        lines = lines_in_views(wireframe, camera, lookup, camera_from_world, pose, radius)
        tangent = length * _robust_step(lines, TOLERANCE_OF_RADIUS * radius)
        return pose @ SE3.exp(tangent).as_matrix(), (pose, _lengths(lines))

    def converge(pose: Float[Array, "4 4"]) -> tuple[Float[Array, "4 4"], Float[Array, "2"]]:
        # A first and a last round, whose steps are not taken, give the lengths: the lines are
        # compiled once.
        radii = jnp.asarray((EXPLAINED_DISTANCE, *RADII, EXPLAINED_DISTANCE))
        is_taken = jnp.asarray((0.0, *(1.0 for _ in RADII), 0.0))
        _, (poses, lengths) = jax.lax.scan(step, pose, (radii, is_taken))
        # A loss of less than one independent observation is none.
        is_lost = ~(lengths[-1, 1] > lengths[0, 1] - INDEPENDENT_LENGTH)
        best = jnp.where(is_lost, 0, -1)
        return poses[best], lengths[best]

    # One pose after the other, so that the arrays stay in the processor's cache.
    return jax.lax.map(converge, world_from_object)


@compiled_optimised
def _lengths_at(
    wireframe: Wireframe,
    camera: AnyCamera,
    lookup: EdgeLookup,
    camera_from_world: Float[Array, "views 4 4"],
    world_from_object: Float[Array, "poses 4 4"],
) -> Float[Array, "poses 2"]:
    """Return the visible and the explained edge length of poses, px."""
    return jax.lax.map(
        lambda pose: lengths_at(wireframe, camera, lookup, camera_from_world, pose),
        world_from_object,
    )


def lengths_at(
    wireframe: Wireframe,
    camera: AnyCamera,
    lookup: EdgeLookup,
    camera_from_world: Float[Array, "views 4 4"],
    pose: Float[Array, "4 4"],
) -> Float[Array, "2"]:
    """Return the visible and the explained edge length at a pose, all views together, px."""
    radius = jnp.asarray(EXPLAINED_DISTANCE)
    return _lengths(lines_in_views(wireframe, camera, lookup, camera_from_world, pose, radius))


def _lengths(lines: EdgeLines) -> Float[Array, "2"]:
    """Return the visible and the explained length of all edges in all views, px."""
    return jnp.stack([lines.visible_px.sum(), lines.explained_px.sum()])


def poses_on_edges(
    wireframe: Wireframe,
    views: SeenViews,
    lookup: EdgeLookup,
    world_from_object: Float[np.ndarray, "poses 4 4"],
) -> tuple[Float[np.ndarray, "poses 4 4"], Float[np.ndarray, "poses 2"]]:
    """Return the results of `converged_poses` for any number of poses, by one compiled program."""
    return _in_batches(converged_poses, wireframe, views, lookup, world_from_object)


def lengths_of_poses(
    wireframe: Wireframe,
    views: SeenViews,
    lookup: EdgeLookup,
    world_from_object: Float[np.ndarray, "poses 4 4"],
) -> Float[np.ndarray, "poses 2"]:
    """Return the visible and the explained edge length of any number of poses, px."""
    return _in_batches(_lengths_at, wireframe, views, lookup, world_from_object)


def _in_batches(
    program: Callable[..., Any],
    wireframe: Wireframe,
    views: SeenViews,
    lookup: EdgeLookup,
    world_from_object: Float[np.ndarray, "poses 4 4"],
) -> Any:
    """Return what a program for some poses makes of any number of them."""
    camera_from_world = to_device(padded_poses(views.camera_from_world))
    camera = views.camera_for(len(camera_from_world))

    def of_batch(poses: Float[Array, "poses 4 4"]) -> Any:
        return program(wireframe, camera, lookup, camera_from_world, poses)

    return in_batches(of_batch, world_from_object, POSES_PER_BATCH, THREADS)


def _robust_step(lines: EdgeLines, tolerance: Float[Array, ""]) -> Float[Array, "6"]:
    """Return the damped Gauss-Newton step of robustly weighted edges."""
    # H = sum w J^T J / v,  g = sum w J^T r / v
    variances = lines.variances + tolerance**2
    squared = (lines.offsets**2 / variances).sum(axis=-1)
    robust = lines.measured.astype(squared.dtype) / (1.0 + squared / EDGE_GATE**2) ** 2
    weights = robust[..., None] / variances
    H = jnp.einsum("vek,veki,vekj->ij", weights, lines.by_pose, lines.by_pose)
    g = jnp.einsum("vek,veki,vek->i", weights, lines.by_pose, lines.offsets)
    # Metres and radians are scaled to unit diagonal before the system is solved.
    scale = 1.0 / jnp.sqrt(jnp.maximum(jnp.diagonal(H), 1e-12))
    scaled = H * scale[:, None] * scale[None] + DAMPING * jnp.eye(6)
    return scale * jnp.linalg.solve(scaled, scale * g)
