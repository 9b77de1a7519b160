"""Fit both transforms of the chain to some of the views, and see how all views agree with them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..dataset import undetermined_twists
from ..geometry import host_logarithms, host_matrices, host_transforms
from ..hand_eye import mean_camera_from_mount, minimum_norm_transforms, park_martin
from .closure import Poses

Matrix = Float[np.ndarray, "4 4"]
"""A homogeneous matrix, m."""


class TransformFit(NamedTuple):
    """Both transforms, and what is left over in each view.

    Attributes:
        camera_from_mount, holder_from_world: the transforms.
        closure: `H^-1 C_i X^-1 T_i^-1` of each view, the identity if Eq. 10 holds exactly: how far
            the mount is from where the robot says. NaN if a pose that is used is not finite.
    """

    camera_from_mount: Matrix
    holder_from_world: Matrix
    closure: Poses

    @property
    def misfit(self) -> Float[np.ndarray, "views 2"]:
        """The misfit of each view: translation (m), rotation (rad)."""
        return misfits(self.closure)


def misfits(closure: Poses) -> Float[np.ndarray, "views 2"]:
    """Return the length of the twist of each closure: translation (m), rotation (rad)."""
    return np.linalg.norm(host_logarithms(closure).reshape(-1, 2, 3), axis=2)


def mean_misfit(closure: Poses, distance: float) -> tuple[tuple[float, float], float]:
    """Return the mean misfit over the views (m and rad), and its score.

    Args:
        closure: closure error of each view.
        distance: median distance of the target from the camera, m.

    Returns:
        The misfit, and as its score rotation plus translation over the distance.
    """
    translation, rotation = misfits(closure).mean(axis=0).tolist()
    return (translation, rotation), rotation + translation / distance


def median_distance(camera_from_world: Poses) -> float:
    """Return the median distance of the target from the camera, m."""
    return float(np.median(np.linalg.norm(camera_from_world[:, :3, 3], axis=1)))


def misfit_text(misfit: Float[np.ndarray, "2"] | tuple[float, float]) -> str:
    """Return a misfit in words, in degrees and millimetres."""
    return f"{np.rad2deg(misfit[1]):.3g} degrees and {1e3 * misfit[0]:.3g} mm"


def fit_transforms(
    mount_from_holder: Poses, camera_from_world: Poses, used: Bool[np.ndarray, "views"]
) -> TransformFit:
    """Compute both transforms from the used views in closed form."""
    robot, camera = mount_from_holder[used], camera_from_world[used]
    if np.isfinite([robot, camera]).all() and len(undetermined_twists(robot)):
        # A closed form would divide by noise where the motion determines nothing.
        _, world = minimum_norm_transforms(robot, camera)
    else:
        _, holder_from_world = park_martin(
            host_transforms(robot), host_transforms(camera), np.ones(len(robot))
        )
        world = host_matrices(holder_from_world)
    hand_eye = mean_camera_from_mount(world, robot, camera, np.ones(len(robot)))
    closure = np.linalg.inv(hand_eye) @ camera_from_world @ np.linalg.inv(mount_from_holder @ world)
    return TransformFit(hand_eye, world, closure)
