"""Hold the poses as given, and a possible mistake in them with the function that corrects it.

Where a view has several possible rotations, one is chosen with which robot and camera turn alike.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from .angle_formats import RotationFormat, Rotations, numbers_in_true_range

Poses = Float[np.ndarray, "views 4 4"]
"""Homogeneous matrices, one per view, m."""


class GivenPoses:
    """The poses as given, and what several mistakes need of the robot's rotations, computed once.

    Attributes:
        robot: the robot's poses.
        camera: the camera's poses.
    """

    def __init__(self, robot: Poses, camera: Poses) -> None:
        self.robot, self.camera = robot, camera
        self._numbers: dict[tuple[str, Any, bool], np.ndarray] = {}
        self._reread: dict[tuple[str, str, bool], np.ndarray] = {}

    @functools.cached_property
    def rotations(self) -> Rotations:
        """The robot's rotations, to the last digit."""
        return Rotation.from_matrix(self.robot[:, :3, :3]).as_matrix()

    def with_rotations(self, rotations: Rotations) -> tuple[Poses, Poses]:
        """Return the poses with other rotations of the robot."""
        corrected = self.robot.copy()
        corrected[:, :3, :3] = rotations
        return corrected, self.camera

    def reread(
        self, read_format: RotationFormat, true_format: RotationFormat, alternative: bool
    ) -> Rotations:
        """Return the matrices of the numbers that were read, in the true format.

        Args:
            read_format: the format in which the numbers were read.
            true_format: the format in which they were written.
            alternative: which of two triples of numbers (see `numbers_in_true_range`).
        """
        by_range = read_format.name, true_format.second_angle_range, alternative
        if by_range not in self._numbers:
            self._numbers[by_range] = numbers_in_true_range(
                self.rotations, read_format, true_format, alternative
            )
        key = read_format.name, true_format.name, alternative
        if key not in self._reread:
            self._reread[key] = true_format.to_matrices(self._numbers[by_range])
        return self._reread[key]


class Mistake(NamedTuple):
    """A possible mistake in the data, and the function that corrects it.

    Attributes:
        name: short, for programs.
        description: what was done wrong, as a clause.
        undo: maps the poses as given to robot and camera poses without the mistake.
    """

    name: str
    description: str
    undo: Callable[[GivenPoses], tuple[Poses, Poses]]


def rotation_mistake(
    name: str, description: str, correction: Callable[[Rotations], Rotations]
) -> Mistake:
    """Return a mistake that concerns the robot's rotations only."""
    return Mistake(
        name,
        description,
        lambda given: given.with_rotations(correction(given.rotations)),
    )


SQUARE_TOLERANCE = 1e-6
"""Relative difference of a grid's width and height that is a rounding error."""


def target_turns(
    points: Float[np.ndarray, "views points 3"], visible: Bool[np.ndarray, "views points"]
) -> Float[np.ndarray, "turns 4 4"] | None:
    """Return the turns in its plane that take a grid of points into itself, the identity first.

    Half a turn does, and a quarter too where the grid is as wide as high. None without points.

    Args:
        points: points of the target in its frame in each view, m.
        visible: mask of the visible points.
    """
    if not visible.any():
        return None
    low, high = points[visible][:, :2].min(axis=0), points[visible][:, :2].max(axis=0)
    width, height = high - low
    is_square = abs(width - height) < SQUARE_TOLERANCE * max(width, height)
    turns = np.tile(np.eye(4), (4, 1, 1))
    turns[:, :3, :3] = Rotation.from_rotvec(
        np.outer(np.arange(4), [0.0, 0.0, 0.5 * np.pi])
    ).as_matrix()
    centre = 0.5 * (low + high)
    turns[:, :2, 3] = centre - turns[:, :2, :2] @ centre
    return turns if is_square else turns[::2]


def numbered_alike(given: GivenPoses, turns: Float[np.ndarray, "turns 4 4"]) -> Poses:
    """Return the camera's poses with the numbering in which it turns as the robot does."""
    candidates = given.camera @ turns[:, None]
    chosen = turning_alike(candidates[..., :3, :3], given.robot[:, :3, :3])
    # The numbering that most views have stays: the target's frame may be any of them.
    usual = np.bincount(chosen).argmax()
    return candidates[chosen, np.arange(len(chosen))] @ np.linalg.inv(turns[usual])


def turning_alike(
    candidates: Float[np.ndarray, "choices views 3 3"], others: Float[np.ndarray, "views 3 3"]
) -> Int[np.ndarray, "views"]:
    """Return which candidate each view has if the angles between the views are to be the others'.

    Args:
        candidates: rotations of every view, of robot or camera.
        others: rotations of the views, of the other one.
    """
    # The trace of R_i^T R_j is 1 + 2 cos of the angle between two views, of robot and camera.
    expected = np.einsum("imn,jmn->ij", others, others)
    views = np.arange(len(others))
    best, best_misfit = np.zeros(len(others), dtype=int), np.inf
    # The view that is chosen first decides the others; a second pass asks all of them.
    for first in range(len(candidates)):
        between = np.einsum("aimn,mn->ai", candidates, candidates[first, 0])
        chosen = np.abs(between - expected[:, 0]).argmin(axis=0)
        between = np.einsum("aimn,jmn->aij", candidates, candidates[chosen, views])
        chosen = np.abs(between - expected).sum(axis=2).argmin(axis=0)
        rotations = candidates[chosen, views]
        total = np.abs(np.einsum("imn,jmn->ij", rotations, rotations) - expected).sum()
        if total < best_misfit:
            best, best_misfit = chosen, total
    return best
