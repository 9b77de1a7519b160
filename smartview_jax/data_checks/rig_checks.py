"""Check that cameras which share a target see it at one place, and with their own pictures.

That pictures were exchanged (`exchanged_cameras.py`) is asked first, then whether a camera was
moved between two states (`moved_cameras.py`).

In a state that two cameras on one hand saw, or two cameras next to the arm, their relative pose
follows from their pictures alone, without the robot. It is the same in all states unless the target
of one camera lies elsewhere than the other's. So a displaced target is seen as exactly as pictures
tell, however weak the robot is.
"""

from collections.abc import Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import fdtrc

from ..dataset import Rig, first_equal_pose
from ..geometry import (
    host_adjoints,
    host_exponentials,
    host_logarithms,
    host_matrices,
    host_transformed,
    mean_matrix,
)
from .closure import Poses
from .exchanged_cameras import exchanged_cameras
from .given_poses import target_turns
from .moved_cameras import find_moved_cameras
from .rig_states import (
    MAX_CHANCE,
    MAX_LEFT_OVER,
    MIN_COMMON_STATES,
    SeenTarget,
    pairs_with_one_target,
    states_in_common,
)
from .transform_fit import Matrix, misfit_text, misfits

MAX_STEPS = 20
"""Largest number of steps in which a displacement is fitted."""

MIN_STEP = 1e-9
"""Step, m or rad, below which the fit of a displacement has converged."""


class TargetFindings(NamedTuple):
    """The findings about the targets that several cameras see, a sentence each.

    Attributes:
        problems: reasons why the cameras cannot be calibrated together.
        doubts: reasons to look at the data.
    """

    problems: tuple[str, ...]
    doubts: tuple[str, ...]


def target_findings(rig: Rig, seen: Mapping[str, SeenTarget]) -> TargetFindings:
    """Compare the places of each target for every pair of cameras that share it.

    Args:
        rig: data sets of the cameras.
        seen: the target as each camera sees it; cameras that are not listed are not compared.
    """
    doubts = [*_copies(rig), *_states_with_two_names(rig)]
    exchanged = exchanged_cameras(rig, seen)
    if exchanged:
        return TargetFindings(exchanged, tuple(doubts))
    moved = find_moved_cameras(rig, seen)
    problems = [camera.sentence for camera in moved if camera.contradicts]
    doubts += [camera.sentence for camera in moved if not camera.contradicts]
    for first, second in pairs_with_one_target(rig, seen):
        places = [seen[name].holder_from_world for name in (first, second)]
        roughly = np.linalg.inv(places[0]) @ places[1]
        turned = _numbering(rig, first, second, roughly)
        if turned is not None:
            problems.append(turned)
            continue
        _, in_first, in_second = states_in_common(rig, first, second, seen)
        displacement = _displacement(in_first, in_second, roughly)
        if displacement is None:
            continue
        points = _points(rig, second)
        is_far = _moved_by(displacement, points) > 0.5 * _half_size(points)
        (problems if is_far else doubts).append(
            f"cameras {first!r} and {second!r} see the target {rig.targets[first]!r} at two "
            f"places, {misfit_text(misfits(displacement[None])[0])} apart, in the states that both "
            "saw: if there are two targets, give them names (targets=); else the target was moved, "
            "or the pictures of a state were taken at different moments"
        )
    return TargetFindings(tuple(problems), tuple(doubts))


def _copies(rig: Rig) -> list[str]:
    """Return a doubt for each pair of cameras whose pixels are equal in all common states."""
    doubts = []
    for first, second in combinations(rig.cameras, 2):
        states, other_states = rig.state_index[first], rig.state_index[second]
        _, *common = np.intersect1d(states, other_states, return_indices=True)
        seen = [
            np.where(np.asarray(data.visible)[..., None], data.pixels, np.nan)[views]
            for data, views in zip((rig.cameras[first], rig.cameras[second]), common, strict=True)
        ]
        if np.isfinite(seen[0]).any() and np.array_equal(*seen, equal_nan=True):
            doubts.append(
                f"cameras {first!r} and {second!r} have the same pixels in all {len(seen[0])} "
                "states that both saw: is one a copy of the other?"
            )
    return doubts


def _states_with_two_names(rig: Rig) -> list[str]:
    """Return a doubt for each pair of cameras without a common state, but with equal poses."""
    doubts = []
    for first, second in combinations(rig.cameras, 2):
        arms = {rig.arms[first], rig.arms[second]}
        if len(arms) > 1 or np.intersect1d(rig.state_index[first], rig.state_index[second]).size:
            continue
        data, other = rig.cameras[first], rig.cameras[second]
        count = data.view_count
        poses = np.concatenate([host_matrices(part.base_from_tool) for part in (data, other)])
        equal = [
            (place, earlier)
            for place, earlier in enumerate(first_equal_pose(poses)[count:])
            if earlier < count
        ]
        if len(equal) >= MIN_COMMON_STATES:
            place, earlier = equal[0]
            doubts.append(
                f"cameras {first!r} and {second!r} have no view of the same name, but {len(equal)} "
                f"equal poses, such as of view {data.view_ids[earlier]} and view "
                f"{other.view_ids[place]}: if their pictures were taken at the same moment, give "
                "both views one name, so that the cameras are compared by them"
            )
    return doubts


def _points(rig: Rig, camera: str) -> Float[np.ndarray, "points 3"]:
    """Return all points that a camera sees on its target, m."""
    data = rig.cameras[camera]
    return np.asarray(data.points)[np.asarray(data.visible)]


def _half_size(points: Float[np.ndarray, "points 3"]) -> float:
    """Return the root mean square distance of the points from their middle, m."""
    return float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))))


def _moved_by(displacement: Matrix, points: Float[np.ndarray, "points 3"]) -> float:
    """Return by how far a displacement moves the points, m (root mean square)."""
    moved = host_transformed(displacement, points) - points
    return float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))


def _numbering(rig: Rig, first: str, second: str, displacement: Matrix) -> str | None:
    """Return the problem of points that two cameras number from different corners, or None.

    `displacement` is where the second camera's target lies in the first's.
    """
    data = rig.cameras[second]
    turns = target_turns(np.asarray(data.points), np.asarray(data.visible))
    if turns is None:
        return None
    points = _points(rig, second)
    left_over = np.array([_moved_by(np.linalg.inv(turn) @ displacement, points) for turn in turns])
    best = int(np.argmin(left_over))
    if best == 0 or left_over[best] > MAX_LEFT_OVER * left_over[0]:
        return None
    degrees = best * 360 // len(turns)
    return (
        f"camera {second!r}: the points of the target {rig.targets[second]!r} are numbered from "
        f"another corner than camera {first!r}'s, {degrees} degrees about: so turned, the cameras "
        f"place it {1e3 * left_over[best]:.3g} mm apart, as given {1e3 * left_over[0]:.3g} mm "
        "(root mean square of its points). Number them alike, or give each camera a target of its "
        "own (targets=)"
    )


def _displacement(first: Poses, second: Poses, start: Matrix) -> Matrix | None:
    """Return where the second camera's target lies in the first's, or None for the same place.

    With K the pose of the first camera in the second and M the displacement, the target's poses in
    the two cameras satisfy `second = K first M` in every state. Both are fitted by least squares,
    and M is tested against the identity by an F test of the squares that it takes away.

    Args:
        first, second: poses of the target in the cameras, in the states that both saw.
        start: M, roughly.
    """
    count = len(first)
    if count < MIN_COMMON_STATES:
        return None
    displacement = start
    for _ in range(MAX_STEPS):
        residual = _residual(first, second, displacement)
        # A displacement exp(m) M moves the second camera's poses by the twist Ad(first) m, in the
        # axes of the first camera; an error of K moves all alike.
        design = np.concatenate(
            [np.tile(np.eye(6), (count, 1, 1)), host_adjoints(first)], axis=2
        ).reshape(-1, 12)
        weight = np.tile(1.0 / _spread(residual), count)
        step = np.linalg.lstsq(weight[:, None] * design, weight * residual.ravel(), rcond=None)[0]
        displacement = host_exponentials(step[6:]) @ displacement
        if np.abs(step[6:]).max() < MIN_STEP:
            break
    moved, stated = (_residual(first, second, m) for m in (displacement, np.eye(4)))
    spread = _spread(moved)
    squares, squares_as_stated = (np.sum((r / spread) ** 2) for r in (moved, stated))
    if not squares < MAX_LEFT_OVER * squares_as_stated:
        return None
    freedom = 6 * count - 12
    ratio = (squares_as_stated - squares) / 6.0 / (squares / freedom)
    return displacement if fdtrc(6, freedom, ratio) < MAX_CHANCE else None


def _residual(first: Poses, second: Poses, displacement: Matrix) -> Float[np.ndarray, "states 6"]:
    """Return the twists by which the relative poses of the cameras differ from their mean."""
    relative = second @ np.linalg.inv(first @ displacement)
    mean = mean_matrix(relative, np.ones(len(relative)))
    return host_logarithms(np.linalg.inv(mean) @ relative)


def _spread(residual: Float[np.ndarray, "states 6"]) -> Float[np.ndarray, "6"]:
    """Return the root mean square of each component, nowhere zero."""
    spread = np.sqrt(np.mean(residual**2, axis=0))
    return np.maximum(spread, 1e-6 * spread.max() + np.finfo(float).tiny)
