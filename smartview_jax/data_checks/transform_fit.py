"""Fit both transforms of the chain to some of the views, and see how all views agree with them."""

from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float, Int

from ..calibration import mount_frames
from ..dataset import undetermined_twists
from ..geometry import host_logarithms, host_matrices
from ..hand_eye import mean_camera_from_mount, minimum_norm_transforms, park_martin_matrices
from .closure import Poses
from .misfit_evidence import errors_of, in_parts

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

    def closure_of(self, mount_from_holder: Poses, camera_from_world: Poses) -> Poses:
        """Return the closure error of other poses with these transforms."""
        return _closures(
            self.camera_from_mount, self.holder_from_world, mount_from_holder, camera_from_world
        )


def misfits(closure: Poses) -> Float[np.ndarray, "*batch views 2"]:
    """Return the length of the twist of each closure: translation (m), rotation (rad)."""
    return np.linalg.norm(errors_of(closure), axis=-1)


def mean_misfit(closure: Poses, distance: float) -> tuple[tuple[float, float], float]:
    """Return the mean misfit over the views (m and rad), and its score.

    Args:
        closure: closure error of each view.
        distance: median distance of the target from the camera, m.

    Returns:
        The misfit, and as its score rotation plus translation over the distance.
    """
    return mean_size(host_logarithms(closure), distance)


def mean_size(
    twists: Float[np.ndarray, "views 6"], distance: float
) -> tuple[tuple[float, float], float]:
    """Return the mean lengths of twists (m and rad), and their score, as `mean_misfit`."""
    translation, rotation = np.linalg.norm(in_parts(twists), axis=2).mean(axis=0).tolist()
    return (translation, rotation), rotation + translation / distance


def median_distance(camera_from_world: Poses) -> float:
    """Return the median distance of the target from the camera, m."""
    return float(np.median(np.linalg.norm(camera_from_world[:, :3, 3], axis=1)))


def misfit_text(misfit: Float[np.ndarray, "2"] | tuple[float, float]) -> str:
    """Return a misfit in words, in degrees and millimetres."""
    # Three digits, without an exponent.
    degrees, mm = (float(f"{x:.3g}") for x in (np.rad2deg(misfit[1]), 1e3 * misfit[0]))
    return f"{degrees:g} degrees and {mm:g} mm"


def moved_text(kind: str, mount: str, size: tuple[float, float]) -> str:
    """Return what may have been moved, and by how much, as a clause.

    Args:
        kind: `"camera"` for the camera against its mount, `"target"` for the target against its
            holder.
        mount: where the camera is stated to be.
        size: translation (m) and rotation (rad) of the change.
    """
    in_hand = mount_frames(mount)[0] == "tool"
    if kind == "target":
        held = "the target had been moved" + ("" if in_hand else " in the hand")
        frame = "base" if in_hand else "tool"
    else:
        held = "the camera had been moved" + (" on the tool" if in_hand else "")
        frame = "tool" if in_hand else "base"
    return f"{held} (or the controller's {frame} frame changed) by {misfit_text(size)}"


def motions_of_views(
    mount_from_holder: SE3,
    camera_from_world: SE3,
    views: Int[np.ndarray, "used"],
    length_ratio: float,
) -> tuple[Poses, Poses] | None:
    """Return the poses of robot and camera in some views; None if one of them is not finite.

    Args:
        mount_from_holder: the robot's part of the chain, `(views)`.
        camera_from_world: from the pictures alone, `(views)`.
        views: indices of the views.
        length_ratio: by which the robot's positions are multiplied.
    """
    robot, camera = host_matrices(mount_from_holder)[views], host_matrices(camera_from_world)[views]
    if not (np.isfinite(robot).all() and np.isfinite(camera).all()):
        return None
    robot[:, :3, 3] *= length_ratio
    return robot, camera


def motions_from_camera_to_target(
    mount_from_holder: SE3,
    camera_from_world: SE3,
    views: Int[np.ndarray, "used"],
    length_ratio: float,
) -> tuple[Poses, Poses] | None:
    """Return the motions of `motions_of_views`, the robot's between frames at camera and target.

    Where these are is what a fit to all views says. So which frames the controller calls tool and
    base changes nothing: at a tool far from the camera, small rotations are large translations.
    """
    motions = motions_of_views(mount_from_holder, camera_from_world, views, length_ratio)
    if motions is None:
        return None
    robot, camera = motions
    # Frames that are far away spoil the first fit as well.
    for _ in range(2):
        fit = fit_transforms(robot, camera)
        robot = fit.camera_from_mount @ robot @ fit.holder_from_world
    return robot, camera


def fit_transforms(
    mount_from_holder: Poses,
    camera_from_world: Poses,
    used: Bool[np.ndarray, "views"] | None = None,
) -> TransformFit:
    """Compute both transforms from the used views, by default from all, in closed form."""
    robot, camera = mount_from_holder, camera_from_world
    if used is not None:
        robot, camera = robot[used], camera[used]
    if not np.isfinite([robot, camera]).all():
        world = np.full((4, 4), np.nan)
    elif len(undetermined_twists(robot)):
        # A closed form would divide by noise where the motion determines nothing.
        _, world = minimum_norm_transforms(robot, camera)
    else:
        _, world = park_martin_matrices(robot, camera, np.ones(len(robot)))
    hand_eye = mean_camera_from_mount(world, robot, camera, np.ones(len(robot)))
    return TransformFit(
        hand_eye, world, _closures(hand_eye, world, mount_from_holder, camera_from_world)
    )


def closures_of_groups(
    mount_from_holder: Poses, camera_from_world: Poses, groups: Int[np.ndarray, "groups used"]
) -> Float[np.ndarray, "groups views 4 4"]:
    """Compute the closure of all views with the transforms of each of several groups, all at once.

    Args:
        mount_from_holder: finite, `(views)`.
        camera_from_world: finite, `(views)`.
        groups: indices of the few views of each group; their motion determines the transforms.
    """
    robot, camera = mount_from_holder[groups], camera_from_world[groups]
    weights = np.ones(groups.shape[1])
    _, worlds = park_martin_matrices(robot, camera, weights)
    hands = mean_camera_from_mount(worlds, robot, camera, weights)
    return _closures(hands, worlds, mount_from_holder, camera_from_world)


def _closures(
    camera_from_mount: Float[np.ndarray, "*batch 4 4"],
    holder_from_world: Float[np.ndarray, "*batch 4 4"],
    mount_from_holder: Poses,
    camera_from_world: Poses,
) -> Float[np.ndarray, "*batch views 4 4"]:
    """Return the closure error of each view with given transforms."""
    mount_from_world = mount_from_holder @ holder_from_world[..., None, :, :]
    mount_from_camera = np.linalg.inv(camera_from_mount)[..., None, :, :]
    return mount_from_camera @ camera_from_world @ np.linalg.inv(mount_from_world)
