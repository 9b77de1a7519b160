"""One order of a symmetric target's points over all views, decided by the robot's motion.

A plain grid looks the same after half a turn, a square one after a quarter. Each view offers a few
camera poses, one a symmetry; between two views the camera must have turned by the same angle as the
robot, and one hand-eye rotation must explain all turns.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from .common_turn import common_turn


class Ordering(NamedTuple):
    """One order of a symmetric target's points over all views.

    Attributes:
        symmetry: which symmetry to apply in each view, `pixels[view][symmetries[answer[view]]]`; 0
            for views without points.
        words: a sentence about the choice; empty where there was none.
    """

    symmetry: Int[np.ndarray, "views"]
    words: str = ""


def consistent_ordering(
    pixels: Float[np.ndarray, "views points 2"],
    visible: Bool[np.ndarray, "views points"],
    points: Float[np.ndarray, "points 3"],
    symmetries: Int[np.ndarray, "symmetries points"],
    tool_rotations: Float[np.ndarray, "views 3 3"],
    image_size: tuple[int, int],
    holder: str = "base",
    rough: Float[np.ndarray, "3 3"] | None = None,
) -> Ordering:
    """Choose an order of the points in each view, so that all views name the same points alike.

    Args:
        pixels, visible: as detected.
        points: of the target, m.
        symmetries: orders that look alike, identity first.
        tool_rotations: of `mount_from_holder`, so that both mounts are alike.
        image_size: width and height, px.
        holder: the frame in which the target stands, `"base"` or `"tool"`.
        rough: rotation of `holder_from_world`, roughly, which decides between turns of the whole
            target; None takes the least turned one (see `common_turn`).

    Raises:
        ValueError: the rough rotation has the target's z axis elsewhere.
    """
    answer = np.zeros(len(pixels), dtype=int)
    shown = np.flatnonzero(visible.sum(axis=1) >= 6)
    if len(symmetries) == 1:
        return Ordering(answer)
    if len(shown) < 3:
        return Ordering(
            answer,
            f"the target's pattern looks the same in {len(symmetries)} orders of its points, and "
            f"{len(shown)} views are too few to tell them apart: each has the detector's own",
        )
    candidates = _candidate_rotations(pixels[shown], visible[shown], points, symmetries, image_size)
    robot = tool_rotations[shown]
    tried = [_from_reference(candidates, robot, first) for first in range(min(len(shown), 4))]
    best, _ = min(tried, key=lambda answer: answer[1])
    chosen = common_turn(
        candidates[np.arange(len(shown)), best], robot, points, symmetries, holder, rough
    )
    answer[shown] = _after(symmetries, best, chosen.symmetry)
    return Ordering(answer, chosen.words)


def _after(symmetries: np.ndarray, each: np.ndarray, common: int) -> np.ndarray:
    """Index of each view's own symmetry followed by one that all share."""
    both = symmetries[each][:, symmetries[common]]
    return np.argmax((both[:, None] == symmetries[None]).all(axis=2), axis=1)


def _candidate_rotations(
    pixels: np.ndarray,
    visible: np.ndarray,
    points: np.ndarray,
    symmetries: np.ndarray,
    image_size: tuple[int, int],
) -> np.ndarray:
    """Rotations `(views, symmetries, 3, 3)` of camera_from_world, from a rough common camera."""
    matrix = _rough_camera(pixels, visible, points, image_size)
    rotations = np.empty((len(pixels), len(symmetries), 3, 3))
    for view, (where, seen) in enumerate(zip(pixels, visible, strict=True)):
        for k, order in enumerate(symmetries):
            mask = seen[order]
            _, vector, _ = cv2.solvePnP(
                points[mask], where[order][mask], matrix, None, flags=cv2.SOLVEPNP_IPPE
            )
            rotations[view, k] = cv2.Rodrigues(vector)[0]
    return rotations


def _rough_camera(
    pixels: np.ndarray, visible: np.ndarray, points: np.ndarray, image_size: tuple[int, int]
) -> np.ndarray:
    """Zhang's start is enough here; symmetries do not change it, each view having its own pose."""
    object_points = [points[seen].astype(np.float32) for seen in visible]
    image_points = [
        where[seen].astype(np.float32) for where, seen in zip(pixels, visible, strict=True)
    ]
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    start = np.array([[1.0, 0, image_size[0] / 2.0], [0, 1.0, image_size[1] / 2.0], [0, 0, 1.0]])
    start[0, 0] = start[1, 1] = 1.2 * max(image_size)
    _, matrix, _, _, _ = cv2.calibrateCamera(
        object_points,
        image_points,
        image_size,
        start,
        None,
        flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
    )
    return matrix


def _from_reference(
    candidates: np.ndarray, robot: np.ndarray, first: int
) -> tuple[np.ndarray, float]:
    """The best choice in every view, given that the reference view keeps its own order."""
    reference = candidates[first, 0]
    turns = np.einsum("vkab,cb->vkac", candidates, reference)  # C_j C_i^T
    robot_turns = np.einsum("vab,cb->vac", robot, robot[first])
    a, b = _rotation_vectors(turns), _rotation_vectors(robot_turns)
    mismatch = np.abs(np.linalg.norm(a, axis=-1) - np.linalg.norm(b, axis=-1)[:, None])
    best, lowest = np.argmin(mismatch, axis=1), np.inf
    best[first] = 0
    # Equal angles do not always decide: hypothesise hand-eye rotations from pairs of views.
    for hand_eye in _hypotheses(a, b, mismatch, first):
        gap = np.linalg.norm(a - (b @ hand_eye.T)[:, None], axis=-1)
        gap[first, 1:] = np.inf
        chosen = np.argmin(gap, axis=1)
        cost = float(np.median(np.min(gap, axis=1)) + 0.1 * np.mean(np.minimum(gap.min(axis=1), 1)))
        if cost < lowest:
            best, lowest = chosen, cost
    return best, lowest


def _hypotheses(a: np.ndarray, b: np.ndarray, mismatch: np.ndarray, first: int) -> list[np.ndarray]:
    """Rotations that take two of the robot's turns to two of the camera's."""
    strength = np.linalg.norm(b, axis=-1)
    views = [v for v in np.argsort(-strength) if v != first and strength[v] > 0.03][:8]
    found = []
    for n, i in enumerate(views):
        for j in views[n + 1 :]:
            if np.linalg.norm(np.cross(b[i], b[j])) < 0.3 * strength[i] * strength[j]:
                continue
            for k in np.flatnonzero(mismatch[i] < 0.15):
                for m in np.flatnonzero(mismatch[j] < 0.15):
                    found.append(_align(np.stack([b[i], b[j]]), np.stack([a[i, k], a[j, m]])))
    return found


def _align(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The rotation that best takes two vectors, and their cross product, to two others."""
    source = np.vstack([source, np.cross(*source)])
    target = np.vstack([target, np.cross(*target)])
    U, _, Vt = np.linalg.svd(target.T @ source)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt


def _rotation_vectors(rotations: np.ndarray) -> np.ndarray:
    flat = rotations.reshape(-1, 3, 3)
    vectors = np.array([cv2.Rodrigues(rotation)[0].ravel() for rotation in flat])
    return vectors.reshape(*rotations.shape[:-2], 3)
