"""Test whether pictures of some views were resized or cut, so that they have another camera.

Such a picture has another focal length and another principal point. One camera for all pictures
then puts the target at wrong places, as if the camera had been moved on its mount, or as if robot
and camera turned about other axes. With a camera for each part of the views they agree.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float

from ..cameras import Camera
from ..geometry import as_se3, host_matrices
from .closure import Poses, contradicts_calibration
from .convention_hypotheses import listed_views
from .largest_group import disagreements
from .misfit_evidence import VERY_STRONG_EVIDENCE, evidence, in_parts
from .smooth_errors import errors_of_transforms
from .transform_fit import (
    fit_transforms,
    mean_size,
    median_distance,
    misfit_text,
    motions_from_camera_to_target,
)
from .view_consistency import MAX_REJECTED_FRACTION

CAMERA_NUMBERS = 5
"""Numbers by which two cameras differ: two focal lengths, the centre, a distortion."""

RESIZING_NUMBERS = 3
"""Numbers by which resized pictures differ from a known camera's: their size and shift."""

MAX_DIVISIONS = 5
"""Largest number of times the views are divided again by the transforms of the last division."""


class TwoCameras(NamedTuple):
    """A camera for each part of the views, and where all views were taken from with either.

    Attributes:
        cameras: the two cameras.
        seen: `camera_from_world` with each of them.
        of_second: mask of the views that the second camera took.
        is_first_known: whether the first camera is known and the second one is the same with
            another size and shift of its pictures.
    """

    cameras: tuple[Camera, Camera]
    seen: Float[np.ndarray, "2 views 4 4"]
    of_second: Bool[np.ndarray, "views"]
    is_first_known: bool = False

    def of_views(self, used: Bool[np.ndarray, "views"]) -> "TwoCameras":
        """Return the same with some of the views."""
        return self._replace(seen=self.seen[:, used], of_second=self.of_second[used])

    @property
    def camera_from_world(self) -> Poses:
        """The pose of each view with its own camera."""
        return np.where(self.of_second[:, None, None], self.seen[1], self.seen[0])

    def divided_by_robot(self, robot: Poses) -> "TwoCameras":
        """Return the division in which each view has the camera with which it fits the robot.

        The second camera took the smaller part, of equal ones the later, or the pictures that a
        known camera did not.
        """
        parts = self
        for _ in range(MAX_DIVISIONS):
            fit = fit_transforms(robot, parts.camera_from_world)
            first, second = (
                disagreements(fit.closure_of(robot, seen), median_distance(seen))
                for seen in parts.seen
            )
            if (parts.of_second == (second < first)).all():
                break
            parts = parts._replace(of_second=second < first)
        # Of two halves the one with the first view is as large as the larger part.
        if not self.is_first_known and 2 * parts.of_second.sum() + parts.of_second[0] > len(robot):
            first, second = parts.cameras
            return TwoCameras((second, first), parts.seen[::-1], ~parts.of_second)
        return parts

    @property
    def is_later_part(self) -> bool:
        """Whether the second camera took all views from one on."""
        return bool(self.of_second[-1] and np.sum(self.of_second[1:] != self.of_second[:-1]) == 1)

    @property
    def size_and_shift(self) -> tuple[float, tuple[float, float]]:
        """The factor by which the second camera's pictures are larger, and their shift then, px."""
        sizes = [float(np.sqrt(camera.alpha_u * camera.alpha_v)) for camera in self.cameras]
        # A picture begins half a pixel before the middle of its first pixel.
        centre, other = (
            np.array([float(camera.u0), float(camera.v0)]) + 0.5 for camera in self.cameras
        )
        size = sizes[1] / sizes[0]
        shift = other - size * centre
        return size, (float(shift[0]), float(shift[1]))


class ResizedPictures(NamedTuple):
    """Views whose pictures seem to be resized or cut.

    Attributes:
        views: indices of the views.
        others: indices of the other views that are used.
        is_later_part: whether they are all views from one on.
        size: factor by which their pictures are larger than the others.
        shift: by how much they are shifted when they have that size, px.
        misfit, given_misfit: mean misfit over all views with two cameras and with one, m and rad.
        score, given_score: rotation plus translation over the distance to the target, in the same
            two cases.
        can_be_left_out: whether the camera of the other views, which are most, is known. Nothing
            is wrong then with a calibration by them alone.
    """

    views: tuple[int, ...]
    others: tuple[int, ...]
    is_later_part: bool
    size: float
    shift: tuple[float, float]
    misfit: tuple[float, float]
    given_misfit: tuple[float, float]
    score: float
    given_score: float
    can_be_left_out: bool = False

    @property
    def contradicts(self) -> bool:
        """Whether no calibration can be right with so many of the views."""
        return not self.can_be_left_out and contradicts_calibration(self.score, self.given_score)

    def sentence(self, view_ids: Sequence[str]) -> str:
        """Return in words which pictures differ, how, and what to do.

        Args:
            view_ids: names of the views.
        """
        names, others = ([view_ids[k] for k in part] for part in (self.views, self.others))
        across, down = map(round, self.shift)
        where = f"in {listed_views(names)}"
        if self.is_later_part:
            where = f"from view {names[0]} on"
        elif len(others) < len(names):
            where = f"in all views but {', '.join(others)}"
        return (
            f"{where}, the pictures contradict the others, as if they had been resized by a factor "
            f"of {self.size:.3f} and then shifted by ({across}, {down}) px: "
            "with a camera for each of the two parts, robot and camera agree to "
            f"{misfit_text(self.misfit)} instead of {misfit_text(self.given_misfit)} (means over "
            "the views). Were pictures binned, resized or cut, or did zoom or focus change? Use "
            "pictures of one kind, or calibrate the two parts separately"
        )


def find_resized_pictures(
    mount_from_holder: SE3,
    camera_from_world: SE3,
    used: Bool[np.ndarray, "views"],
    parts: TwoCameras,
) -> ResizedPictures | None:
    """Return the pictures that need a camera of their own, if robot and camera agree far better so.

    Args:
        mount_from_holder: the robot's part of the chain, `(views)`.
        camera_from_world: with one camera for all views.
        used: mask of the views to use.
        parts: two cameras that fit the views.
    """
    views = np.flatnonzero(used)
    robot, one_camera = (host_matrices(p)[views] for p in (mount_from_holder, camera_from_world))
    parts = parts.of_views(used)
    if not np.isfinite([robot, one_camera, *parts.seen]).all():
        return None
    parts = parts.divided_by_robot(robot)
    if not parts.of_second.any() or parts.of_second.all():
        return None
    (given, given_distance), (corrected, distance) = (
        _errors(robot, seen) for seen in (one_camera, parts.camera_from_world)
    )
    numbers = RESIZING_NUMBERS if parts.is_first_known else CAMERA_NUMBERS
    odds = evidence(in_parts(given), in_parts(corrected), numbers)
    # The part may begin at any view, or each view may be of either part.
    odds -= 2.0 * (np.log(len(views)) if parts.is_later_part else len(views) * np.log(2.0))
    if odds < 2.0 * np.log(VERY_STRONG_EVIDENCE):
        return None
    misfit, score = mean_size(corrected, distance)
    given_misfit, given_score = mean_size(given, given_distance)
    return ResizedPictures(
        tuple(views[parts.of_second].tolist()),
        tuple(views[~parts.of_second].tolist()),
        parts.is_later_part,
        *parts.size_and_shift,
        misfit,
        given_misfit,
        score,
        given_score,
        parts.is_first_known and parts.of_second.sum() <= MAX_REJECTED_FRACTION * len(views),
    )


def _errors(robot: Poses, camera: Poses) -> tuple[Float[np.ndarray, "views 6"], float]:
    """Return what the likeliest transforms leave over of finite poses, and their distance."""
    every_view = np.arange(len(robot))
    motions = motions_from_camera_to_target(as_se3(robot), as_se3(camera), every_view, 1.0)
    assert motions is not None
    return errors_of_transforms(*motions), median_distance(motions[1])
