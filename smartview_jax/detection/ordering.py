"""Find a consistent order of a symmetric target's points in all views from the robot's motion.

A plain grid looks the same after a rotation by 180 degrees, a square grid after 90 degrees. So each
view has several possible camera poses, one for each symmetry. Between two views the camera must
have rotated by the same angle as the robot, and one hand-eye rotation must explain all rotations.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from ..geometry import host_nearest_rotation
from ..targets import AbstractTarget
from .common_symmetry import choose_common_symmetry


class PointOrdering(NamedTuple):
    """The order of a symmetric target's points in every view.

    Attributes:
        symmetry: index of the symmetry to apply in each view, as in
            `pixels[view][symmetries[symmetry[view]]]`; 0 for views without points.
        message: a sentence about the choice; empty if there was nothing to choose.
    """

    symmetry: Int[np.ndarray, "views"]
    message: str = ""


def consistent_ordering(
    pixels: Float[np.ndarray, "views points 2"],
    visible: Bool[np.ndarray, "views points"],
    board: AbstractTarget,
    mount_rotations: Float[np.ndarray, "views 3 3"],
    image_size: tuple[int, int],
    holder: str = "base",
    rough_rotation: Float[np.ndarray, "3 3"] | None = None,
) -> PointOrdering:
    """Choose the order of the points in each view so that it is consistent over all views.

    Args:
        pixels, visible: as detected.
        board: the target, with the orders of its points that look the same.
        mount_rotations: rotations of `mount_from_holder`, which is defined for both mounts.
        image_size: width and height, px.
        holder: the frame in which the target is fixed, `"base"` or `"tool"`.
        rough_rotation: approximate rotation of `holder_from_world`, which decides between the
            symmetries of the whole target; None chooses the smallest rotation (see
            `common_symmetry`).

    Raises:
        ValueError: the rough rotation has the target's z axis in another direction.
    """
    points, symmetries = board.points, board.symmetries
    symmetry_indices = np.zeros(len(pixels), dtype=int)
    usable_views = np.flatnonzero(visible.sum(axis=1) >= 6)
    if len(symmetries) == 1:
        return PointOrdering(symmetry_indices)
    if len(usable_views) < 3:
        return PointOrdering(
            symmetry_indices,
            f"the target's pattern looks the same in {len(symmetries)} orders of its points, and "
            f"{len(usable_views)} views are too few to choose between them: each view keeps the "
            "detector's order",
        )
    candidates = _candidate_rotations(
        pixels[usable_views], visible[usable_views], points, symmetries, image_size
    )
    robot_rotations = mount_rotations[usable_views]
    # The reference view keeps the detector's order. The pose of a single view may be wrong, so up
    # to four views are tried as the reference, and the result with the smallest cost is used.
    solutions = [
        _symmetries_from_reference(candidates, robot_rotations, reference_view)
        for reference_view in range(min(len(usable_views), 4))
    ]
    best, _ = min(solutions, key=lambda solution: solution[1])
    chosen = choose_common_symmetry(
        candidates[np.arange(len(usable_views)), best],
        robot_rotations,
        points,
        symmetries,
        holder,
        rough_rotation,
    )
    symmetry_indices[usable_views] = _compose_symmetries(symmetries, best, chosen.symmetry)
    return PointOrdering(symmetry_indices, chosen.message)


def _compose_symmetries(
    symmetries: np.ndarray, view_symmetries: np.ndarray, common_symmetry: int
) -> np.ndarray:
    """Return the index of each view's own symmetry followed by the common symmetry."""
    # pixels[s_v][s] = pixels[s_v[s]]; the composition is again one of the symmetries.
    composed = symmetries[view_symmetries][:, symmetries[common_symmetry]]
    return np.argmax((composed[:, None] == symmetries[None]).all(axis=2), axis=1)


def _candidate_rotations(
    pixels: np.ndarray,
    visible: np.ndarray,
    points: np.ndarray,
    symmetries: np.ndarray,
    image_size: tuple[int, int],
) -> np.ndarray:
    """Estimate camera_from_world's rotation for each view and symmetry, with one rough camera."""
    # IPPE is OpenCV's solution of the pose of a plane that needs no initial pose.
    matrix = _approximate_camera_matrix(pixels, visible, points, image_size)
    rotations = np.empty((len(pixels), len(symmetries), 3, 3))
    for view, (view_pixels, view_visible) in enumerate(zip(pixels, visible, strict=True)):
        for k, order in enumerate(symmetries):
            mask = view_visible[order]
            _, vector, _ = cv2.solvePnP(
                points[mask], view_pixels[order][mask], matrix, None, flags=cv2.SOLVEPNP_IPPE
            )
            rotations[view, k] = cv2.Rodrigues(vector)[0]
    return rotations


def _approximate_camera_matrix(
    pixels: np.ndarray, visible: np.ndarray, points: np.ndarray, image_size: tuple[int, int]
) -> np.ndarray:
    """Estimate an approximate camera matrix, px, with OpenCV's version of Zhang's method.

    It is accurate enough here, and does not depend on the symmetries, because each view has its own
    pose.
    """
    object_points = [points[view_visible].astype(np.float32) for view_visible in visible]
    image_points = [
        view_pixels[view_visible].astype(np.float32)
        for view_pixels, view_visible in zip(pixels, visible, strict=True)
    ]
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    initial_matrix = np.array(
        [[1.0, 0, image_size[0] / 2.0], [0, 1.0, image_size[1] / 2.0], [0, 0, 1.0]]
    )
    initial_matrix[0, 0] = initial_matrix[1, 1] = 1.2 * max(image_size)
    _, matrix, _, _, _ = cv2.calibrateCamera(
        object_points,
        image_points,
        image_size,
        initial_matrix,
        None,
        flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
    )
    return matrix


def _symmetries_from_reference(
    candidates: np.ndarray, robot_rotations: np.ndarray, reference_view: int
) -> tuple[np.ndarray, float]:
    """Choose the best symmetry in every view, given that the reference view keeps its own order.

    Args:
        candidates: rotations of camera_from_world, `(views, symmetries, 3, 3)`.
        robot_rotations: rotations of mount_from_holder, `(views, 3, 3)`.
        reference_view: index of the reference view.

    Returns:
        The index of a symmetry for each view, and the cost of this choice, rad.
    """
    # With the rotation vectors a_vk of C_vk C_r^T and b_v of B_v B_r^T, where r is the reference
    # view, C the camera's and B the robot's rotations, and a hand-eye rotation X, view v chooses
    # the symmetry k that minimises |a_vk - X b_v|. The cost of X is the median over views of these
    # minima, plus 0.1 times their mean, each limited to 1 rad, which is robust against a few wrong
    # views. A rotation angle does not depend on X, so ||a_vk| - |b_v|| (`angle_mismatch`) limits
    # the hypotheses to try, and decides if none can be formed.
    reference_rotation = candidates[reference_view, 0]
    relative_camera_rotations = np.einsum("vkab,cb->vkac", candidates, reference_rotation)
    relative_robot_rotations = np.einsum(
        "vab,cb->vac", robot_rotations, robot_rotations[reference_view]
    )
    a, b = _rotation_vectors(relative_camera_rotations), _rotation_vectors(relative_robot_rotations)
    angle_mismatch = np.abs(np.linalg.norm(a, axis=-1) - np.linalg.norm(b, axis=-1)[:, None])
    best, lowest_cost = np.argmin(angle_mismatch, axis=1), np.inf
    best[reference_view] = 0
    # Equal angles do not always decide, so hand-eye rotations are hypothesised from pairs of views
    # and compared.
    for hand_eye in _hand_eye_hypotheses(a, b, angle_mismatch, reference_view):
        residuals = np.linalg.norm(a - (b @ hand_eye.T)[:, None], axis=-1)
        residuals[reference_view, 1:] = np.inf
        chosen = np.argmin(residuals, axis=1)
        cost = float(
            np.median(np.min(residuals, axis=1))
            + 0.1 * np.mean(np.minimum(residuals.min(axis=1), 1))
        )
        if cost < lowest_cost:
            best, lowest_cost = chosen, cost
    return best, lowest_cost


def _hand_eye_hypotheses(
    a: np.ndarray, b: np.ndarray, angle_mismatch: np.ndarray, reference_view: int
) -> list[np.ndarray]:
    """Return the hand-eye rotations that map two robot rotations to two camera rotations.

    Args:
        a: rotation vectors of the camera, `(views, symmetries, 3)`, rad.
        b: rotation vectors of the robot, `(views, 3)`, rad.
        angle_mismatch: difference of their angles, `(views, symmetries)`, rad.
        reference_view: index of the reference view, whose rotation is zero.
    """
    # Pairs are formed among the eight views with the largest rotations, over 0.03 rad, whose axes
    # are at least about 17 degrees apart (sin > 0.3) and whose angles agree within 0.15 rad.
    # Smaller or nearly parallel rotations do not determine X.
    angles = np.linalg.norm(b, axis=-1)
    views = [v for v in np.argsort(-angles) if v != reference_view and angles[v] > 0.03][:8]
    hypotheses = []
    for n, i in enumerate(views):
        for j in views[n + 1 :]:
            if np.linalg.norm(np.cross(b[i], b[j])) < 0.3 * angles[i] * angles[j]:
                continue
            for k in np.flatnonzero(angle_mismatch[i] < 0.15):
                for m in np.flatnonzero(angle_mismatch[j] < 0.15):
                    hypotheses.append(_align(np.stack([b[i], b[j]]), np.stack([a[i, k], a[j, m]])))
    return hypotheses


def _align(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the rotation that best maps two vectors and their cross product to two others."""
    source = np.vstack([source, np.cross(*source)])
    target = np.vstack([target, np.cross(*target)])
    return host_nearest_rotation(target.T @ source)


def _rotation_vectors(rotations: np.ndarray) -> np.ndarray:
    """Return the rotation vectors of rotations `(..., 3, 3)`, rad."""
    vectors = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec()
    return vectors.reshape(*rotations.shape[:-2], 3)
