"""Check the arrays of a data set on the host, and name the views that are wrong."""

from collections.abc import Sequence

import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..argument_checks import require_distinct, require_readable
from ..geometry import PoseLike, host_matrices
from ..robots import SerialArm
from ..runtime.compilation import compiled

FORWARD_KINEMATICS_TOLERANCE = (1e-3, np.deg2rad(0.1))
"""Largest difference (m, rad) of reported poses from the arm's forward kinematics."""


def points_per_view(points: np.ndarray, view_count: int, point_count: int) -> np.ndarray:
    """Return points as `(views, points, 3)`, or as `(1, points, 3)` if common to all views."""
    if points.shape == (point_count, 3):
        return points[None]
    if points.shape != (view_count, point_count, 3):
        raise ValueError(
            f"points: expected shape ({point_count}, 3) or ({view_count}, {point_count}, 3) to "
            f"match pixels, found {points.shape}"
        )
    return points


def forward_kinematics(
    joints: np.ndarray | Array | None, arm: SerialArm | None, ids: tuple[str, ...]
) -> SE3:
    """Compute `base_from_tool` of every view by the arm's forward kinematics."""
    if joints is None or arm is None:
        raise ValueError(
            "expected poses, or joint readings and their arm; found "
            f"{'neither' if joints is arm else 'joints alone' if arm is None else 'an arm alone'}"
        )
    readings = np.asarray(joints, dtype=float)
    if readings.shape != (len(ids), arm.joint_count):
        raise ValueError(
            f"joints: expected shape ({len(ids)}, {arm.joint_count}), one reading per view and "
            f"joint; found {readings.shape}"
        )
    return arm.base_from_tool(readings)


@compiled
def pose_difference(first: SE3, second: SE3) -> Float[Array, "*views 6"]:
    """Return the twist from one pose to another, `log(first^-1 second)`."""
    return (first.inverse() @ second).log()


def check_forward_kinematics(
    computed: SE3, reported: SE3, used: Bool[np.ndarray, "views"], ids: tuple[str, ...]
) -> None:
    """Raise a ValueError if a reported pose differs from the arm's forward kinematics.

    Such a difference shows that the tool frame, the pose convention or the arm is wrong.
    """
    # The difference is the twist log(computed^-1 reported): translation (m), then rotation (rad).
    twist = np.asarray(pose_difference(computed, reported))
    # Largest component of each of the two; NaN fails the comparison below.
    max_components = np.abs(twist).reshape(-1, 2, 3).max(axis=2)
    for view in np.flatnonzero(used):
        translation, rotation = max_components[view]
        if not (
            translation <= FORWARD_KINEMATICS_TOLERANCE[0]
            and rotation <= FORWARD_KINEMATICS_TOLERANCE[1]
        ):
            raise ValueError(
                f"view {ids[view]}: the reported pose differs by {1e3 * translation:.3g} mm and "
                f"{np.rad2deg(rotation):.3g} deg from the arm's forward kinematics: check the tool "
                "frame, the pose convention and the arm"
            )


def checked_matrices(argument: str, poses: PoseLike, view_count: int) -> np.ndarray:
    """Return poses as `(views, 4, 4)` matrices, or raise a ValueError that names the argument."""
    # Matrices are not converted to SE3 first: that would normalise their rotations and hide from
    # `check_rigid` the matrices that are not rigid.
    if not isinstance(poses, SE3):
        matrices = np.asarray(poses, dtype=float)
    else:
        matrices = host_matrices(poses)
    if matrices.shape != (view_count, 4, 4):
        raise ValueError(
            f"{argument}: expected shape ({view_count}, 4, 4), one pose per view; "
            f"found {matrices.shape}"
        )
    return matrices


def checked_view_ids(view_ids: Sequence[str | int] | None, view_count: int) -> tuple[str, ...]:
    """Return view ids as text, or raise a ValueError for a wrong number or duplicates."""
    ids = tuple(str(view) for view in (range(view_count) if view_ids is None else view_ids))
    if len(ids) != view_count:
        raise ValueError(f"view_ids: expected {view_count}, found {len(ids)}")
    # Poses and pictures are paired by id, so a duplicate would pair them wrongly.
    require_distinct("view_ids", ids)
    require_readable("view_ids", ids)
    return ids


def visibility_mask(
    visible: np.ndarray | Array | None, pixels: np.ndarray, ids: tuple[str, ...]
) -> np.ndarray:
    """Return the mask of visible points, or raise a ValueError if a visible one has no pixel."""
    has_numbers = np.asarray(np.isfinite(pixels).all(axis=-1))
    if visible is None:
        return has_numbers
    is_visible = np.array(visible, dtype=bool)
    if is_visible.shape != has_numbers.shape:
        raise ValueError(f"visible: expected shape {has_numbers.shape}, found {is_visible.shape}")
    # If mask and pixels contradict each other, neither is silently preferred.
    missing = is_visible & ~has_numbers
    if missing.any():
        view, point = np.argwhere(missing)[0]
        raise ValueError(f"view {ids[view]}: point {point} is marked visible but has no pixel")
    return is_visible


def pixel_problems(
    pixels: np.ndarray, seen: np.ndarray, image_size: tuple[int, int], ids: tuple[str, ...]
) -> dict[str, str]:
    """Return the views with a pixel outside the picture, with the reason.

    Detected corners may lie up to one pixel beyond the edge.
    """
    width, height = image_size
    if width <= 0 or height <= 0:
        raise ValueError(f"image_size: expected a positive width and height, found {image_size}")

    def outside_of(size: tuple[int, int]) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            # Pixel centres are at integers: the picture ends half a pixel beyond the outermost.
            return seen & ((pixels < -1.0) | (pixels > np.array(size, dtype=float))).any(axis=-1)

    outside = outside_of(image_size)
    # A single view may have a gross error of its own.
    if np.count_nonzero(outside.any(axis=1)) > 1 and not outside_of((height, width)).any():
        right, bottom = pixels[seen].max(axis=0)
        raise ValueError(
            f"image_size: expected width and height, found {width} x {height}, but points lie up "
            f"to ({right:.1f}, {bottom:.1f}) px: are width and height exchanged?"
        )
    problems = {}
    for view in np.flatnonzero(outside.any(axis=1)):
        point = int(np.flatnonzero(outside[view])[0])
        u, v = pixels[view, point]
        problems[ids[view]] = (
            f"point {point} at ({u:.1f}, {v:.1f}) px lies outside the {width} x {height} picture"
        )
    return problems


def finite_views(matrices: np.ndarray) -> np.ndarray:
    """Return which matrices are finite, with shape `(views, 1, 1)`."""
    return np.asarray(np.isfinite(matrices).all(axis=(1, 2), keepdims=True))
