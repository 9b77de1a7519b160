"""Find one order of a symmetric target's points in all views from the robot's motion.

A plain grid looks the same after a rotation by 180 degrees, a square one after 90 degrees. So each
view has several possible camera poses, one for each symmetry. Between two views the camera must
have rotated by the same angle as the robot, and one hand-eye rotation must explain all rotations.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from .common_turn import common_turn


class Ordering(NamedTuple):
    """The order of a symmetric target's points in every view.

    Attributes:
        symmetry: index of the symmetry to apply in each view, as in
            `pixels[view][symmetries[symmetry[view]]]`; 0 for views without points.
        words: a sentence about the choice; empty if there was nothing to choose.
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
    """Choose the order of the points in each view so that it is consistent over all views.

    Args:
        pixels, visible: as detected.
        points: points of the target, m.
        symmetries: orders of the points that look the same, identity first.
        tool_rotations: rotations of `mount_from_holder`, which is defined for both mounts.
        image_size: width and height, px.
        holder: the frame in which the target is fixed, `"base"` or `"tool"`.
        rough: approximate rotation of `holder_from_world`, which decides between the symmetries of
            the whole target; None chooses the smallest rotation (see `common_turn`).

    Raises:
        ValueError: the rough rotation has the target's z axis in another direction.
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
    # The reference view keeps the detector's order. The pose of a single view may be wrong, so that
    # up to four views are tried as the reference, and the result with the smallest cost is used.
    tried = [_from_reference(candidates, robot, first) for first in range(min(len(shown), 4))]
    best, _ = min(tried, key=lambda answer: answer[1])
    chosen = common_turn(
        candidates[np.arange(len(shown)), best], robot, points, symmetries, holder, rough
    )
    answer[shown] = _after(symmetries, best, chosen.symmetry)
    return Ordering(answer, chosen.words)


def _after(symmetries: np.ndarray, each: np.ndarray, common: int) -> np.ndarray:
    """Return the index of each view's own symmetry followed by one symmetry common to all views."""
    both = symmetries[each][:, symmetries[common]]
    return np.argmax((both[:, None] == symmetries[None]).all(axis=2), axis=1)


def _candidate_rotations(
    pixels: np.ndarray,
    visible: np.ndarray,
    points: np.ndarray,
    symmetries: np.ndarray,
    image_size: tuple[int, int],
) -> np.ndarray:
    """Estimate the rotation of camera_from_world for each view and symmetry.

    Returns:
        Rotations `(views, symmetries, 3, 3)`, computed with one approximate camera for all views.
    """
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
    """Estimate an approximate camera matrix, px, with OpenCV's version of Zhang's method.

    It is accurate enough here, and the symmetries do not change it, because each view has its own
    pose.
    """
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
    """Choose the best symmetry in every view, given that the reference view keeps its own order.

    Args:
        candidates: rotations of camera_from_world, `(views, symmetries, 3, 3)`.
        robot: rotations of mount_from_holder, `(views, 3, 3)`.
        first: index of the reference view.

    Returns:
        The index of a symmetry for each view, and the cost of this choice, rad.
    """
    # With the rotation vectors a_vk of C_vk C_first^T and b_v of B_v B_first^T, and a hand-eye
    # rotation X, view v chooses the symmetry k that minimises |a_vk - X b_v|. The cost of X is the
    # median over views of these minima, plus 0.1 times their mean, each limited to 1 rad, which
    # is robust against a few wrong views. A rotation angle does not depend on X, so that
    # ||a_vk| - |b_v|| limits the hypotheses to try, and decides where none can be formed.
    reference = candidates[first, 0]
    turns = np.einsum("vkab,cb->vkac", candidates, reference)
    robot_turns = np.einsum("vab,cb->vac", robot, robot[first])
    a, b = _rotation_vectors(turns), _rotation_vectors(robot_turns)
    mismatch = np.abs(np.linalg.norm(a, axis=-1) - np.linalg.norm(b, axis=-1)[:, None])
    best, lowest = np.argmin(mismatch, axis=1), np.inf
    best[first] = 0
    # Equal angles do not always decide, so that hand-eye rotations are hypothesised from pairs of
    # views and compared.
    for hand_eye in _hypotheses(a, b, mismatch, first):
        gap = np.linalg.norm(a - (b @ hand_eye.T)[:, None], axis=-1)
        gap[first, 1:] = np.inf
        chosen = np.argmin(gap, axis=1)
        cost = float(np.median(np.min(gap, axis=1)) + 0.1 * np.mean(np.minimum(gap.min(axis=1), 1)))
        if cost < lowest:
            best, lowest = chosen, cost
    return best, lowest


def _hypotheses(a: np.ndarray, b: np.ndarray, mismatch: np.ndarray, first: int) -> list[np.ndarray]:
    """Return the hand-eye rotations that map two robot rotations to two camera rotations.

    Args:
        a: rotation vectors of the camera, `(views, symmetries, 3)`, rad.
        b: rotation vectors of the robot, `(views, 3)`, rad.
        mismatch: difference of their angles, `(views, symmetries)`, rad.
        first: index of the reference view, whose rotation is zero.
    """
    # Pairs are formed among the eight views with the largest rotations, over 0.03 rad, whose axes
    # are at least about 17 degrees apart (sin > 0.3) and whose angles agree within 0.15 rad.
    # Smaller or nearly parallel rotations do not determine X.
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
    """Return the rotation that best maps two vectors and their cross product to two others."""
    # Kabsch: with U S V^T = sum target source^T,   R = U diag(1, 1, det(U V^T)) V^T.
    source = np.vstack([source, np.cross(*source)])
    target = np.vstack([target, np.cross(*target)])
    U, _, Vt = np.linalg.svd(target.T @ source)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt


def _rotation_vectors(rotations: np.ndarray) -> np.ndarray:
    """Return the rotation vectors of rotations `(..., 3, 3)`, rad."""
    flat = rotations.reshape(-1, 3, 3)
    vectors = np.array([cv2.Rodrigues(rotation)[0].ravel() for rotation in flat])
    return vectors.reshape(*rotations.shape[:-2], 3)
