"""How well the motions of robot and camera belong together, in NumPy on the host.

`A X = X B` between all pairs of views: the rotation of X by Park and Martin, then its translation
by least squares; what is left over, as medians over the pairs, so that a few bad views do not
decide. Besides, one length scale between robot and camera where the motion tells it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

Poses = Float[np.ndarray, "views 4 4"]

MOST_VIEWS = 40
"""Views that are looked at, evenly spaced: their pairs tell enough."""

SCALE_TOLD = 0.1
"""Relative standard deviation of a length scale under which the motion tells it."""

TRIMMED = 2
"""Times that a fit is repeated without the pairs that lie far off."""


class Closure(NamedTuple):
    """What the best hand-eye transform leaves over.

    Attributes:
        rotation: median over the pairs of views, rad.
        translation: median, in the camera's unit of length, m.
        score: both together, the translation as a share of the distance to the target.
    """

    rotation: float
    translation: float
    score: float


class Motion(NamedTuple):
    """Motions between pairs of views, and the hand-eye rotation that explains them best.

    Attributes:
        left: `R_A - I` of every pair.
        turned: translations of the robot's motions in the camera's axes, m.
        moved: translations of the camera's motions, m.
        gap: angle left over by the rotation, rad.
        away: median distance of the target from the camera, m.
        second_axis: how far the camera turns about a second axis, over how far about the first; the
            hand-eye rotation is not told where it is next to nothing.
    """

    left: Float[np.ndarray, "pairs 3 3"]
    turned: Float[np.ndarray, "pairs 3"]
    moved: Float[np.ndarray, "pairs 3"]
    gap: Float[np.ndarray, "pairs"]
    away: float
    second_axis: float


def motion(mount_from_holder: Poses, camera_from_world: Poses) -> Motion:
    """Motions of both between all pairs of views, at least three of them."""
    pick = np.unique(np.linspace(0, len(camera_from_world) - 1, MOST_VIEWS).astype(int))
    M, C = mount_from_holder[pick], camera_from_world[pick]
    i, j = np.triu_indices(len(pick), 1)
    A, B = C[j] @ np.linalg.inv(C[i]), M[j] @ np.linalg.inv(M[i])
    a, b = (Rotation.from_matrix(motions[:, :3, :3]).as_rotvec() for motions in (A, B))
    X = _aligned(a, b)
    for _ in range(TRIMMED):
        used = _near(np.linalg.norm(a - b @ X.T, axis=1))
        X = _aligned(a[used], b[used])
    # As an angle of a rotation: near half a turn an axis may point either way.
    expected = X @ B[:, :3, :3] @ X.T
    cosine = 0.5 * (np.einsum("pab,pab->p", A[:, :3, :3], expected) - 1.0)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    away = float(np.median(np.linalg.norm(C[:, :3, 3], axis=1)))
    turns = np.linalg.svd(a, compute_uv=False)
    second = float(turns[1] / max(turns[0], 1e-12))
    return Motion(A[:, :3, :3] - np.eye(3), B[:, :3, 3] @ X.T, A[:, :3, 3], angle, away, second)


def closure(pairs: Motion, scale: float = 1.0) -> Closure:
    """What is left over with the robot's positions multiplied by a scale."""
    right = scale * pairs.turned - pairs.moved
    gap = np.linalg.norm(pairs.left @ _shift(pairs.left, right) - right, axis=1)
    for _ in range(TRIMMED):
        used = _near(gap)
        gap = np.linalg.norm(pairs.left @ _shift(pairs.left[used], right[used]) - right, axis=1)
    rotation, translation = float(np.median(pairs.gap)), float(np.median(gap))
    return Closure(rotation, translation, rotation + translation / pairs.away)


def length_ratio(pairs: Motion) -> float:
    """Camera motion over robot motion, found with the hand-eye translation; 1 where not told.

    An orbit about the target fits with any ratio: then the standard deviation is large.
    """
    rows = np.concatenate([pairs.left, -pairs.turned[:, :, None]], axis=2).reshape(-1, 4)
    size = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    right = -pairs.moved.reshape(-1)
    answer, _, rank, _ = np.linalg.lstsq(rows / size, right, rcond=1e-6)
    if rank < 4 or not len(right) > 4:
        return 1.0
    gap = right - rows / size @ answer
    spread = np.linalg.inv((rows / size).T @ (rows / size))[3, 3]
    # Pairs of the same views are not independent: as many are as there are views.
    views = 0.5 * (1.0 + np.sqrt(1.0 + 8.0 * len(pairs.moved)))
    std = np.sqrt(spread * np.mean(gap**2) * len(pairs.moved) / views)
    return float(answer[3] / size[3]) if std < SCALE_TOLD * abs(answer[3]) else 1.0


def _near(gap: np.ndarray) -> np.ndarray:
    """Which pairs the rest does not contradict: without them a bad view does not pull."""
    return gap <= 3.0 * np.median(gap) + 1e-12


def _shift(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Translation of the hand-eye transform by least squares, m."""
    return np.linalg.lstsq(left.reshape(-1, 3), right.reshape(-1), rcond=1e-6)[0]


def _aligned(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The rotation that takes rotation vectors `b` nearest to `a`."""
    U, _, Vt = np.linalg.svd(a.T @ b)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
