"""Tell whether errors that look like the robot's are rather a camera's that changes by itself.

An autofocus that moves the lens between the pictures makes the target seem nearer or farther, and
an image stabiliser shifts the picture, which looks like a turned camera. Within one view a free
pose takes up nearly all of either, so that the robot seems to err. But a robot knows nothing of the
optical axis: its errors are as large along it as across it. So the corrections of the poses are
seen from the camera, and the variances of their changes from view to view along and across the
axis compared by an F test (a knocked camera changes once, which `data_checks.changes` names). A
robot that sags or has a worn lift errs along or about an axis of its base, which a camera that
looks down sees nearly as its own: where the ratio is larger for an axis of the base, the robot
errs. In front of a camera next to the robot the tool turns, and the axes of both are compared with
the camera's.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import fdtrc

from ..calibration import host_mount_from_holder, mount_frames
from ..dataset import PoseObservations
from ..geometry import host_adjoints, host_matrices
from .joint_fit import JointFit

MAX_CHANCE = 1e-4
"""Largest probability with which a robot's errors would look like a camera's by chance."""

MIN_VIEWS = 6
"""Fewest views whose variances are compared."""


class SeenErrors(NamedTuple):
    """The corrections of the poses as the camera sees them, one row for each view.

    Attributes:
        shifts: motion of the target's middle in the camera's frame, m.
        turns: rotation vectors in the camera's frame, rad.
        camera_from_frames: rotations of the frames along whose axes a robot may err: the base and,
            for a camera next to the robot, the tool.
    """

    shifts: Float[np.ndarray, "views 3"]
    turns: Float[np.ndarray, "views 3"]
    camera_from_frames: tuple[Float[np.ndarray, "views 3 3"], ...]


def camera_like_errors(fit: JointFit) -> list[str]:
    """Return a sentence on errors of the robot that lie as a changing camera's would; or nothing.

    Args:
        fit: a joint fit whose robot seems to err more than robots do.
    """
    observations = fit.problem.observations
    if isinstance(observations, PoseObservations) or fit.calibration.mount == "hand_to_hand":
        return []
    if len(fit.used_views) < MIN_VIEWS:
        return []
    seen = _seen_errors(fit)
    across, along = (seen.shifts[:, :2], seen.shifts[:, 2:])
    if _is_larger(along, across) and _lie_by_camera(seen.shifts, seen.camera_from_frames, 1.0):
        return [
            "the errors that seem to be the robot's move the target along the optical axis, by "
            f"{1e3 * _rms(along):.2g} mm and only {1e3 * _rms(across):.2g} mm across it: rather "
            "did focus or zoom change between the pictures. Switch autofocus off, and take them "
            "again"
        ]
    tilts, rolls = (seen.turns[:, :2], seen.turns[:, 2:])
    if _is_larger(tilts, rolls) and _lie_by_camera(seen.turns, seen.camera_from_frames, -1.0):
        return [
            "the errors that seem to be the robot's tilt the camera, by "
            f"{np.rad2deg(_rms(tilts)):.2g} degrees, but turn it by only "
            f"{np.rad2deg(_rms(rolls)):.2g} degrees about its axis: rather did an image "
            "stabiliser or a program shift the pictures. Switch it off, and take them again"
        ]
    return []


def _seen_errors(fit: JointFit) -> SeenErrors:
    """Return the corrections of the used views as seen by the camera, without their mean.

    The mean cannot be separated from the hand-eye transform.
    """
    observations, calibration, views = fit.problem.seen_points, fit.calibration, fit.used_views
    poses = host_matrices(observations.base_from_tool)[views]
    twists = np.asarray(fit.pose_corrections)[views]
    camera_from_tool = np.broadcast_to(host_matrices(calibration.camera_from_mount), poses.shape)
    if mount_frames(calibration.mount)[0] == "base":
        # tool_from_base = exp(twist) reported, and the camera sees its inverse.
        camera_from_tool, twists = camera_from_tool @ poses, -twists
    seen = np.einsum("vij,vj->vi", host_adjoints(camera_from_tool), twists)
    seen = seen - seen.mean(axis=0)
    visible = np.asarray(observations.visible)[views]
    points = np.asarray(observations.points)[views]
    middles = np.einsum("vpi,vp->vi", points, visible) / visible.sum(axis=1)[:, None]
    mount_from_holder = host_mount_from_holder(calibration.mount, observations.base_from_tool)
    # Without a correction by joints or field: it moves the target's middle by little.
    camera_from_mount = host_matrices(calibration.camera_from_mount)
    camera_from_holder = camera_from_mount @ host_matrices(mount_from_holder)[views]
    camera_from_world = camera_from_holder @ host_matrices(calibration.holder_from_world)
    middles = np.einsum("vij,vj->vi", camera_from_world[:, :3, :3], middles)
    middles = middles + camera_from_world[:, :3, 3]
    shifts = seen[:, :3] + np.cross(seen[:, 3:], middles)
    frames = [camera_from_holder[:, :3, :3]]
    if mount_frames(calibration.mount)[0] == "base":
        frames.append(np.broadcast_to(camera_from_mount[:3, :3], frames[0].shape))
    return SeenErrors(shifts, seen[:, 3:], tuple(frames))


def _lie_by_camera(
    errors: Float[np.ndarray, "views 3"],
    camera_from_frames: tuple[Float[np.ndarray, "views 3 3"], ...],
    sign: float,
) -> bool:
    """Return whether errors lie along the optical axis more than along any axis of other frames.

    Args:
        errors: in the camera's frame, m or rad.
        camera_from_frames: rotations from these frames.
        sign: 1 for errors that lie along an axis, -1 for those that lie across it.
    """

    def shares(vectors: np.ndarray) -> np.ndarray:
        """Return how much of the squares lies along each axis."""
        squares = np.mean(vectors**2, axis=0)
        return sign * squares / squares.sum()

    in_frames = [np.einsum("vij,vi->vj", turns, errors) for turns in camera_from_frames]
    return all(shares(errors)[2] > shares(vectors).max() for vectors in in_frames)


def _rms(errors: np.ndarray) -> float:
    """Return the root mean square of errors over views and axes."""
    return float(np.sqrt(np.mean(errors**2)))


def _is_larger(first: np.ndarray, second: np.ndarray) -> bool:
    """Return whether errors have a larger variance than others, which chance does not explain.

    A camera that changes by itself does so between any two views, one that was knocked between two
    only. So the variances are of the differences of successive views, without the largest one.
    They have the degrees of freedom of two thirds as many independent ones.
    """
    changes, others = np.diff(first, axis=0), np.diff(second, axis=0)
    kept = np.argsort(np.sum(changes**2, axis=1))[:-1]
    changes, others = changes[kept], others[kept]
    ratio = float(np.mean(changes**2) / np.maximum(np.mean(others**2), 1e-300))
    chance = fdtrc(changes.size / 1.5, others.size / 1.5, ratio)
    return bool(chance < MAX_CHANCE)
