"""Find the views that show enough points of the target, with poses that were read for them."""

import equinox as eqx
import numpy as np
from jaxtyping import Bool

from ..calibration import transform_names
from ..cameras import Camera
from ..dataset import Dataset, Observations, repeated_views, require_motion
from ..geometry import host_matrices
from ..runtime.array_namespace import to_device
from .target_checks import collinear_views

MINIMUM_POINTS = 6
"""Smallest number of points with which a view can be calibrated by itself."""

KNOWN_CAMERA_POINTS = 4
"""Smallest number of points that determine a view's pose before a known camera."""


def views_to_use(
    data: Dataset, camera: Camera | None = None, place_is_given: bool = False
) -> np.ndarray:
    """Return the indices of the views that show enough points, not all on one line, once each.

    Args:
        data: the data set.
        camera: a known camera; fewer points suffice then.
        place_is_given: whether the camera's or the target's place is known, which a robot that
            never turns does not tell.

    Raises:
        ValueError: fewer than three are left, and the message says what is wrong with the others;
            or the robot did not move or turn.
    """
    poses = host_matrices(data.base_from_tool)
    mount_name = transform_names(data.mount)[0]
    unusable = _views_without_pose(data, minimum_points(camera))
    require_minimum_views(data, unusable, minimum_points(camera))
    seen = np.setdiff1d(np.arange(data.view_count), list(unusable))
    # Before views that repeat others are set aside: nothing would be left to speak of.
    require_motion(poses[seen], mount_name, place_is_given)
    unusable = unusable_views(data, minimum_points(camera))
    require_minimum_views(data, unusable, minimum_points(camera))
    return np.setdiff1d(np.arange(data.view_count), list(unusable))


def require_minimum_views(data: Dataset, unusable: dict[int, str], minimum: int) -> None:
    """Raise a ValueError that names the unusable views if fewer than three are left."""
    remaining = data.view_count - len(unusable)
    if remaining >= 3:
        return
    reasons = [f"view {data.view_ids[view]}: {text}" for view, text in unusable.items()]
    tail = f" ({'; '.join(reasons[:10])})" if reasons else ""
    # A single tag has four corners: enough for a pose, not for a camera.
    advice = (
        f"; with a known camera (camera=, or --camera FILE) {KNOWN_CAMERA_POINTS} points suffice"
        if minimum > KNOWN_CAMERA_POINTS
        else ""
    )
    raise ValueError(
        f"a calibration needs at least 3 views with {minimum} points each; "
        f"{remaining} of {data.view_count} views have them{tail}{advice}"
    )


def mask_unusable_views(
    data: Dataset, unusable: dict[int, str]
) -> tuple[Observations, Bool[np.ndarray, "views"]]:
    """Return the observations with unusable views masked, and the mask of usable views.

    Views are masked, not removed: the arrays keep the shape for which programs are compiled.
    """
    used = np.ones(data.view_count, dtype=bool)
    used[list(unusable)] = False
    visible = to_device(np.asarray(data.visible) & used[:, None])
    return eqx.tree_at(lambda o: o.visible, data.observations, visible), used


def unusable_views(data: Dataset, minimum: int) -> dict[int, str]:
    """Return the views whose pose cannot be determined or repeats another's, with the reason."""
    unusable = _views_without_pose(data, minimum)
    return unusable | repeated_views(data.mask_views(list(unusable)))


def _views_without_pose(data: Dataset, minimum: int) -> dict[int, str]:
    """Return the views whose pose cannot be determined, with the reason."""
    reasons, visible = dict(data.masked_views), np.asarray(data.visible)
    point_counts, collinear = visible.sum(axis=1), collinear_views(np.asarray(data.points), visible)
    return {
        view: reasons.get(
            data.view_ids[view],
            f"{point_counts[view]} points seen, {minimum} needed"
            if point_counts[view] < minimum
            else f"the {point_counts[view]} points seen lie on one line",
        )
        for view in np.flatnonzero((point_counts < minimum) | collinear).tolist()
    }


def minimum_points(camera: Camera | None) -> int:
    """Return the number of points that a view must show; fewer if the camera is known."""
    return MINIMUM_POINTS if camera is None else KNOWN_CAMERA_POINTS
