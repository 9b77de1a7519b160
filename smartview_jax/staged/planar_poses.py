"""Compute the second pose of a flat target, and how plainly the pictures tell it from the first.

Seen from afar, a small plane looks almost the same when its normal is mirrored about the line of
sight: each view has two poses, and noise decides which of them leaves less. The second pose is
where a search from the mirrored first one ends. NumPy code: a few steps for all views at once.

Reference: Collins, Bartoli, Infinitesimal plane-based pose estimation, 2014; Schweighofer, Pinz,
Robust pose estimation from a planar target, 2006.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..geometry import host_exponentials, host_rotations_between, host_transformed

MAX_STEPS = 30
"""The largest number of steps from a mirrored pose."""

MAX_DAMPING = 1e6
"""The damping, relative to the diagonal, at which a search has come to its end."""

MIN_DEPTH = 1e-6
"""The smallest depth of a point before the camera, m."""


class Sight(NamedTuple):
    """The points of all views, and the rays on which they are seen, on the host.

    Attributes:
        points: in the target's frame, m.
        rays: ideal coordinates x / z, y / z of each point in its view; zero where not seen.
        seen: the points of each view that are used.
    """

    points: Float[np.ndarray, "views points 3"]
    rays: Float[np.ndarray, "views points 2"]
    seen: Bool[np.ndarray, "views points"]


def mirrored_poses(
    poses: Float[np.ndarray, "views 4 4"], sight: Sight
) -> Float[np.ndarray, "views 4 4"]:
    """Return the poses with the plane's normal mirrored about the line of sight to its middle."""
    count = np.maximum(sight.seen.sum(axis=1), 1)[:, None]
    weight = sight.seen[..., None] / count[..., None]
    middle = np.sum(weight * sight.points, axis=1)
    spread = np.where(sight.seen[..., None], sight.points - middle[:, None], 0.0)
    # The direction in which the points do not extend.
    normal = np.linalg.eigh(spread.swapaxes(1, 2) @ spread).eigenvectors[..., 0]
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    n, m = _turned(R, normal), _turned(R, middle) + t
    s = m / np.linalg.norm(m, axis=1, keepdims=True)
    mirrored = 2.0 * np.sum(s * n, axis=1, keepdims=True) * s - n
    result = poses.copy()
    result[:, :3, :3] = host_rotations_between(n, mirrored) @ R
    result[:, :3, 3] = m - _turned(result[:, :3, :3], middle)
    return result


def refined_poses(
    poses: Float[np.ndarray, "views 4 4"], sight: Sight, maximum_steps: int = MAX_STEPS
) -> tuple[Float[np.ndarray, "views 4 4"], Float[np.ndarray, "views"]]:
    """Return the poses at the nearest minimum of the sum of squares, and that sum for each view."""
    poses = poses.copy()
    residual, jacobian, cost = linearised(poses, sight)
    damping = np.full(len(poses), 1e-3)
    active = np.arange(len(poses))
    for _ in range(maximum_steps):
        J = jacobian[active]
        matrix, gradient = J.swapaxes(1, 2) @ J, np.einsum("vri,vr->vi", J, residual[active])
        diagonal = np.einsum("vii->vi", matrix)
        floor = 1e-12 * np.maximum(diagonal.max(axis=1, keepdims=True), 1e-300)
        added = damping[active, None] * np.maximum(diagonal, floor) + floor
        step = -np.linalg.solve(matrix + np.eye(6) * added[:, None], gradient[..., None])[..., 0]
        trial = host_exponentials(step) @ poses[active]
        values = linearised(trial, Sight(*(part[active] for part in sight)))
        is_better = values[2] < cost[active]
        better, gained = active[is_better], (cost[active] - values[2])[is_better]
        # Most views need few steps; the others go on alone.
        is_done = np.zeros(len(poses), dtype=bool)
        is_done[better] = gained <= 1e-9 * cost[better]
        poses[better] = trial[is_better]
        for kept, tried in zip((residual, jacobian, cost), values, strict=True):
            kept[better] = tried[is_better]
        damping[active] *= np.where(is_better, 0.1, 10.0)
        is_done |= damping > MAX_DAMPING
        active = active[~is_done[active]]
        if not len(active):
            break
    return poses, cost


def linearised(
    poses: Float[np.ndarray, "views 4 4"], sight: Sight
) -> tuple[
    Float[np.ndarray, "views rows"], Float[np.ndarray, "views rows 6"], Float[np.ndarray, "views"]
]:
    """Return residuals, their derivative by a twist from the left, and the sums of squares."""
    p = host_transformed(poses, sight.points)
    in_front = p[..., 2] > MIN_DEPTH
    z = np.where(in_front, p[..., 2], 1.0)
    ideal = p[..., :2] / z[..., None]
    # A point behind the camera is worse than any before it.
    used = sight.seen & in_front
    residual = np.where(used[..., None], ideal - sight.rays, 0.0)
    cost = np.sum(residual**2, axis=(1, 2)) + 1e3 * np.sum(sight.seen & ~in_front, axis=1)
    # d(x / z) = (dx - (x / z) dz) / z with dp = v + w x p, and g . (w x p) = (p x g) . w; row by
    # row, because NumPy is slow at products of so small matrices.
    inverse = np.where(used, 1.0 / z, 0.0)
    x, y = np.where(used, ideal[..., 0], 0.0), np.where(used, ideal[..., 1], 0.0)
    jacobian = np.zeros((*z.shape, 2, 6))
    jacobian[..., 0, 0] = jacobian[..., 1, 1] = inverse
    jacobian[..., 0, 2], jacobian[..., 1, 2] = -x * inverse, -y * inverse
    jacobian[..., 0, 3] = -x * y
    jacobian[..., 0, 4] = np.where(used, 1.0 + x * x, 0.0)
    jacobian[..., 0, 5] = -y
    jacobian[..., 1, 3] = np.where(used, -1.0 - y * y, 0.0)
    jacobian[..., 1, 4] = x * y
    jacobian[..., 1, 5] = x
    views = len(poses)
    return residual.reshape(views, -1), jacobian.reshape(views, -1, 6), cost


def _turned(
    R: Float[np.ndarray, "views 3 3"], vectors: Float[np.ndarray, "views 3"]
) -> Float[np.ndarray, "views 3"]:
    """Return the vector of each view turned by its rotation."""
    return np.einsum("vab,vb->va", R, vectors)
