"""Choose one symmetry of a target for all views, which defines the target's frame.

The robot's motion determines the order of the points in each view only relative to the other views.
A symmetry that is applied to all views at once fits equally well and only changes the frame of the
target. The frame is chosen by its orientation: nearest to a rough pose if there is one, otherwise
with the smallest rotation about z relative to its holder.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

MIN_ROTATION_ANGLE = np.deg2rad(3.0)
"""Smallest rotation between two views whose axis is used, rad; noise dominates below it."""

MIN_SINGULAR_VALUE_RATIO = 0.1
"""Limit on the second over the first singular value of the rotation vectors, without unit.

Below it, all rotations between views are about one axis, which does not determine the hand-eye
rotation.
"""

MAX_Z_AXIS_ANGLE = np.deg2rad(60.0)
"""Largest accepted angle between the z axes of the target and of the rough pose, rad."""


class CommonSymmetry(NamedTuple):
    """The symmetry that was chosen for all views.

    Attributes:
        symmetry: index of the symmetry to apply to every view.
        message: a sentence about the number of symmetries, the chosen one and the reason.
    """

    symmetry: int
    message: str


def choose_common_symmetry(
    camera_rotations: Float[np.ndarray, "views 3 3"],
    mount_rotations: Float[np.ndarray, "views 3 3"],
    points: Float[np.ndarray, "points 3"],
    symmetries: Int[np.ndarray, "symmetries points"],
    holder: str,
    rough_rotation: Float[np.ndarray, "3 3"] | None = None,
) -> CommonSymmetry:
    """Choose the symmetry under which the target's orientation is nearest to the expected one.

    Args:
        camera_rotations: rotations of `camera_from_world`, with one order of the points in all
            views.
        mount_rotations: rotations of `mount_from_holder`, from the robot.
        points: points of the target, m.
        symmetries: orders of the points that look the same, identity first.
        holder: the frame in which the target is fixed, `"base"` or `"tool"`, for the message.
        rough_rotation: approximate rotation of `holder_from_world`. If None, the symmetry is chosen
            for which the target's x axis is nearest to the holder's; its z axis is the same for
            all.
    """
    count = len(symmetries)
    alike = f"the target's pattern looks the same in {count} orders of its points"
    advice = (
        "a mark in the pattern would settle it (origin_mark of a circle grid, or a ChArUco board)"
    )
    holder_rotation = _holder_rotation(camera_rotations, mount_rotations)
    if holder_rotation is None:
        return CommonSymmetry(
            0, f"{alike}, and the robot's rotations do not determine the right one: {advice}"
        )
    candidate_rotations = Rotation.concatenate(
        [holder_rotation * _symmetry_rotation(points, order) for order in symmetries]
    )
    if rough_rotation is None:
        angles = np.abs(_angle_about_z(candidate_rotations))
        reason = f"with the target's x axis nearest to the {holder}'s"
    else:
        expected_rotation = Rotation.from_matrix(rough_rotation)
        _require_same_z_axis(candidate_rotations, expected_rotation, holder)
        angles = (expected_rotation.inv() * candidate_rotations).magnitude()
        reason = f"nearest to the rough {holder}_from_world that was given"
    first, second = np.argsort(angles, kind="stable")[:2]
    choice = (
        f"the order {reason} was chosen ({np.rad2deg(angles[first]):.0f} degrees off; the next "
        f"{np.rad2deg(angles[second]):.0f})"
    )
    alternative = (
        ""
        if rough_rotation is not None
        else f"; give a rough {holder}_from_world to choose another"
    )
    return CommonSymmetry(int(first), f"{alike}: {choice}{alternative}; {advice}")


def _holder_rotation(camera_rotations: np.ndarray, mount_rotations: np.ndarray) -> Rotation | None:
    """Estimate the rotation of `holder_from_world` for the first symmetry.

    It is None if the rotations share an axis, or if fewer than two have a usable angle.
    """
    # A_ij = R_j R_i^T of the camera and B_ij of the mount satisfy A_ij = X B_ij X^T with the
    # hand-eye rotation X (camera_from_mount). So their rotation vectors satisfy
    #   a_ij = X b_ij,
    # which is solved for X by least squares. Then, in every view,
    #   holder_from_world = (mount_from_holder)^T X^T camera_from_world.
    a, b = _relative_rotation_vectors(camera_rotations), _relative_rotation_vectors(mount_rotations)
    angle = np.linalg.norm(b, axis=1)
    # Near 180 degrees noise can reverse the sign of a rotation vector.
    is_informative = (angle > MIN_ROTATION_ANGLE) & (angle < 0.95 * np.pi)
    a, b = a[is_informative], b[is_informative]
    if len(b) < 2:
        return None
    singular_values = np.linalg.svd(b, compute_uv=False)
    if singular_values[1] < MIN_SINGULAR_VALUE_RATIO * singular_values[0]:
        return None
    hand_eye = Rotation.align_vectors(a, b)[0]
    # Refitting without large residuals, because a view in a wrong order would bias the result.
    for _ in range(3):
        residuals = np.linalg.norm(a - hand_eye.apply(b), axis=1)
        inliers = residuals <= 3.0 * np.median(residuals) + 1e-9
        hand_eye = Rotation.align_vectors(a[inliers], b[inliers])[0]
    holder_rotations = mount_rotations.swapaxes(1, 2) @ hand_eye.as_matrix().T @ camera_rotations
    cosines = np.einsum("iab,jab->ij", holder_rotations, holder_rotations)
    # trace(R_i^T R_j) = 1 + 2 cos(angle). The mean is over the half of the views that are nearest
    # to the others, which excludes views in a wrong order.
    dispersion = -np.median(cosines, axis=1)
    return Rotation.from_matrix(holder_rotations[dispersion <= np.median(dispersion)]).mean()


def _relative_rotation_vectors(rotations: np.ndarray) -> np.ndarray:
    """Return the rotation vectors between all pairs of views, rad."""
    i, j = np.triu_indices(len(rotations), 1)
    return Rotation.from_matrix(rotations[j] @ rotations[i].swapaxes(1, 2)).as_rotvec()


def _symmetry_rotation(points: np.ndarray, order: np.ndarray) -> Rotation:
    """Return the rotation in the target's plane that maps the points to this order."""
    centred = points - points.mean(axis=0)
    return Rotation.align_vectors(centred[order], centred)[0]


def _angle_about_z(rotations: Rotation) -> np.ndarray:
    """Return the angle about z of each rotation, in [-pi, pi) rad.

    Each rotation is decomposed into a rotation about z, whose angle is returned, and the smallest
    rotation that tilts z up or down to its direction.
    """
    matrices = rotations.as_matrix()
    # The z axis points down for a board with z into it that is seen from above. Rotating by 180
    # degrees about x makes it point up and keeps x.
    down = matrices[:, 2, 2] < 0.0
    matrices[down] = matrices[down] @ np.diag([1.0, -1.0, -1.0])
    # Decomposition of the quaternion (w, x, y, z): angle about z = 2 atan2(z, w).
    quaternions = Rotation.from_matrix(matrices).as_quat()
    angle = 2.0 * np.arctan2(quaternions[:, 2], quaternions[:, 3])
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def _require_same_z_axis(
    candidate_rotations: Rotation, expected_rotation: Rotation, holder: str
) -> None:
    """Raise a ValueError if the z axis of the rough pose is far from the target's.

    The symmetries are rotations about z, so that all of them have the same z axis.
    """
    z, rough_z = candidate_rotations.as_matrix()[0, :, 2], expected_rotation.as_matrix()[:, 2]
    angle = float(np.arccos(np.clip(z @ rough_z, -1.0, 1.0)))
    if angle > MAX_Z_AXIS_ANGLE:
        raise ValueError(
            f"{holder}_from_world: the target's z axis is {np.rad2deg(angle):.0f} degrees from the "
            f"stated direction, in every order of the pattern; it points along ({z[0]:.2f}, "
            f"{z[1]:.2f}, {z[2]:.2f}) of the {holder} frame (into a flat board, out of a board "
            f"used at several heights)"
        )
