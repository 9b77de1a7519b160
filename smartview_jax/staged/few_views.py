"""Place a known camera by one or two views of a target whose place is known.

The robot's motion between so few views does not tell the hand-eye transform, but a view of a target
that other cameras have placed does:

    camera_from_mount = camera_from_world (mount_from_holder holder_from_world)^-1
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..calibration import Calibration
from ..cameras import Camera
from ..data_checks import mask_unusable_views, minimum_points, unusable_views
from ..dataset import Dataset, require_picture_size
from ..fit_result import Rejection
from ..geometry import PoseLike, as_se3, host_matrices, host_transforms, mean_pose
from ..runtime.array_namespace import to_device
from .common_camera import MAX_UNCHECKED_POINTS
from .pose_search import nearer_poses
from .staged_fit import with_region
from .two_poses import hand_eye_at_target
from .weng import estimate_view_poses


class FewViewsStart(NamedTuple):
    """A camera that was placed by a few views of a target whose place is known.

    Attributes:
        calibration: the known camera, its place, and the target's.
        inliers: mask of the points to use.
        rejected: views left out, with reasons.
        warnings: a sentence if the views have two poses that explain them about as well.
    """

    calibration: Calibration
    inliers: Bool[np.ndarray, "views points"]
    rejected: tuple[Rejection, ...]
    warnings: tuple[str, ...]


def start_by_target(data: Dataset, camera: Camera, holder_from_world: PoseLike) -> FewViewsStart:
    """Return where a known camera is, given the place of the target that it sees.

    Args:
        data: at least one view with four points.
        camera: the known camera.
        holder_from_world: pose of the target, in the robot's base or in the tool.

    Raises:
        ValueError: no usable view, or pictures of another size than the camera's.
    """
    require_picture_size("the known camera", camera, data.image_size)
    unusable = unusable_views(data, minimum_points(camera))
    observations, used = mask_unusable_views(data, unusable)
    if not used.any():
        reasons = "; ".join(f"view {data.view_ids[k]}: {text}" for k, text in unusable.items())
        raise ValueError(f"no view with {minimum_points(camera)} points ({reasons or 'no views'})")
    poses, rms, has_pose = estimate_view_poses(observations, camera)
    visible = np.asarray(observations.visible)
    # Any pose passes through three points exactly: of few points none is said to lie apart.
    unchecked = visible.sum(axis=1) <= MAX_UNCHECKED_POINTS
    inliers = visible & (np.asarray(has_pose) | unchecked[:, None])
    observations = eqx.tree_at(lambda o: o.visible, observations, to_device(inliers))
    views = np.flatnonzero(used)
    robot = host_matrices(data.mount_from_holder)[views]
    world = host_matrices(as_se3(holder_from_world))
    sigma = _pixel_noise(np.asarray(rms), inliers, used)
    candidates, hand_eye, warning = hand_eye_at_target(
        observations, camera, poses, robot, used, sigma, world
    )
    chosen = nearer_poses(candidates, hand_eye @ robot @ world)
    seen = candidates[chosen, np.arange(len(views))]
    hand_eyes = host_transforms(seen @ np.linalg.inv(robot @ world))
    calibration = Calibration(camera, mean_pose(hand_eyes), as_se3(holder_from_world), data.mount)
    return FewViewsStart(
        with_region(calibration, data, views),
        inliers,
        tuple(Rejection(data.view_ids[k], None, text) for k, text in unusable.items()),
        (warning,) if warning else (),
    )


def _pixel_noise(
    rms: Float[np.ndarray, "views"],
    inliers: Bool[np.ndarray, "views points"],
    used: Bool[np.ndarray, "views"],
) -> float:
    """Return the standard deviation of u and v about the poses of the views, px."""
    points = inliers.sum(axis=1)[used]
    squares = float(np.sum(points * rms[used] ** 2))
    return float(np.sqrt(squares / max(2.0 * points.sum() - 6.0 * len(points), 1.0)))
