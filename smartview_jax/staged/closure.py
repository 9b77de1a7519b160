"""Measure how well one hand-eye transform explains the motions of robot and camera.

`A X = X B` is solved over all pairs of views: the rotation of X by Park and Martin's method, then
its translation by least squares. The closure error is what remains, as a median over the pairs, so
that a few bad views do not dominate. A length scale between robot and camera is estimated as well
where the motion determines it. Everything runs once, in NumPy.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

Poses = Float[np.ndarray, "views 4 4"]
"""Homogeneous matrices, one per view, m."""

MOST_VIEWS = 40
"""Largest number of views compared, evenly spaced; their pairs are enough."""

SCALE_TOLD = 0.1
"""Largest relative standard deviation at which a length scale counts as determined."""

TRIMMED = 2
"""Number of times a fit is repeated without outlying pairs."""


class Closure(NamedTuple):
    """The closure error that remains with the best hand-eye transform.

    Attributes:
        rotation: median over the pairs of views, rad.
        translation: median over the pairs, in the camera's unit of length, m.
        score: rotation plus translation divided by the distance to the target.
    """

    rotation: float
    translation: float
    score: float


class Motion(NamedTuple):
    """The motions between pairs of views, expressed with the best hand-eye rotation R.

    The hand-eye translation t then solves `left t = turned - moved`.

    Attributes:
        left: `R_A - I` of every pair.
        turned: translations of the robot's motions in the camera's axes, `R t_B`, m.
        moved: translations of the camera's motions, `t_A`, m.
        gap: angle between `R_A` and `R R_B R^T`, rad.
        away: median distance of the target from the camera, m.
        second_axis: second over first singular value of the camera's rotation vectors. Near zero
            all rotations have the same axis, and the hand-eye rotation is not determined.
    """

    left: Float[np.ndarray, "pairs 3 3"]
    turned: Float[np.ndarray, "pairs 3"]
    moved: Float[np.ndarray, "pairs 3"]
    gap: Float[np.ndarray, "pairs"]
    away: float
    second_axis: float


def motion(mount_from_holder: Poses, camera_from_world: Poses) -> Motion:
    """Compute the motions of robot and camera between all pairs of three or more views."""
    pick = np.unique(np.linspace(0, len(camera_from_world) - 1, MOST_VIEWS).astype(int))
    M, C = mount_from_holder[pick], camera_from_world[pick]
    i, j = np.triu_indices(len(pick), 1)
    A, B = C[j] @ np.linalg.inv(C[i]), M[j] @ np.linalg.inv(M[i])
    a, b = (Rotation.from_matrix(motions[:, :3, :3]).as_rotvec() for motions in (A, B))
    X = _aligned(a, b)
    # Repeated without outlying pairs: one wrong view spoils all pairs that contain it.
    for _ in range(TRIMMED):
        used = _near(np.linalg.norm(a - b @ X.T, axis=1))
        X = _aligned(a[used], b[used])
    # The residual as the angle of a rotation, not as a difference of rotation vectors: for motions
    # near 180 degrees the axis may have either sign.
    expected = X @ B[:, :3, :3] @ X.T
    cosine = 0.5 * (np.einsum("pab,pab->p", A[:, :3, :3], expected) - 1.0)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    away = float(np.median(np.linalg.norm(C[:, :3, 3], axis=1)))
    # Singular values of all rotation vectors: how much rotation there is about each axis.
    turns = np.linalg.svd(a, compute_uv=False)
    second = float(turns[1] / max(turns[0], 1e-12))
    return Motion(A[:, :3, :3] - np.eye(3), B[:, :3, 3] @ X.T, A[:, :3, 3], angle, away, second)


def closure(pairs: Motion, scale: float = 1.0) -> Closure:
    """Return the closure error with the robot's positions multiplied by a scale."""
    right = scale * pairs.turned - pairs.moved
    gap = np.linalg.norm(pairs.left @ _shift(pairs.left, right) - right, axis=1)
    for _ in range(TRIMMED):
        used = _near(gap)
        gap = np.linalg.norm(pairs.left @ _shift(pairs.left[used], right[used]) - right, axis=1)
    rotation, translation = float(np.median(pairs.gap)), float(np.median(gap))
    return Closure(rotation, translation, rotation + translation / pairs.away)


def length_ratio(pairs: Motion) -> float:
    """Estimate the ratio of camera motion to robot motion, or return 1 if it is not determined.

    The unknowns are the hand-eye translation t and the ratio s in `left t - s turned = -moved`. An
    orbit about the target fits any ratio; its standard deviation is then large.
    """
    rows = np.concatenate([pairs.left, -pairs.turned[:, :, None]], axis=2).reshape(-1, 4)
    # Columns are scaled to unit length, so that the rank decision does not depend on units.
    size = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    right = -pairs.moved.reshape(-1)
    answer, _, rank, _ = np.linalg.lstsq(rows / size, right, rcond=1e-6)
    if rank < 4 or not len(right) > 4:
        return 1.0
    gap = right - rows / size @ answer
    spread = np.linalg.inv((rows / size).T @ (rows / size))[3, 3]
    # n (n - 1) / 2 pairs of n views are not independent; count n of them as independent.
    views = 0.5 * (1.0 + np.sqrt(1.0 + 8.0 * len(pairs.moved)))
    std = np.sqrt(spread * np.mean(gap**2) * len(pairs.moved) / views)
    return float(answer[3] / size[3]) if std < SCALE_TOLD * abs(answer[3]) else 1.0


def _near(gap: np.ndarray) -> np.ndarray:
    """Return which pairs have a residual within three times the median."""
    return gap <= 3.0 * np.median(gap) + 1e-12


def _shift(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Compute the translation of the hand-eye transform by least squares, m."""
    return np.linalg.lstsq(left.reshape(-1, 3), right.reshape(-1), rcond=1e-6)[0]


def _aligned(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute the rotation that takes vectors `b` closest to `a` (orthogonal Procrustes)."""
    U, _, Vt = np.linalg.svd(a.T @ b)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
