"""Reverse each known mistake in the data, and rank the mistakes by the closure error that remains.

Rotations alone seldom distinguish the mistakes: inverted poses, transposed rotations, reordered
quaternions and KUKA angles read as Fanuc angles have the same rotation angles, about axes that some
hand-eye rotation explains. Positions distinguish them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..argument_checks import MAX_LISTED_VIEWS, listed
from .closure import (
    CLOSURE_SCORE_FLOOR,
    MAX_CORRECTED_SCORE_RATIO,
    ClosureError,
    RelativeMotions,
    closure_errors,
    explains_most,
    relative_motions,
)
from .given_poses import GivenPoses, Mistake, Poses, numbered_alike
from .length_units import LENGTH_UNIT_MISTAKES
from .mistakes import OTHER_CORNER


class ConventionHypothesis(NamedTuple):
    """A mistake, and the closure error that remains when it is corrected.

    Attributes:
        name: of the mistake.
        description: what was done wrong, as a clause.
        closure_error: the closure error with the mistake corrected.
    """

    name: str
    description: str
    closure_error: ClosureError


ANGLE_TOLERANCE = np.deg2rad(4.0)
"""Largest acceptable median rotation error, rad."""

_EQUAL_POSES = 1e-9
"""Largest difference of poses (m, and entries of rotations) that is a rounding error."""


def ranked_hypotheses(
    given: GivenPoses,
    used: np.ndarray,
    in_hand: bool,
    motions: RelativeMotions,
    possible: Sequence[Mistake],
) -> tuple[ConventionHypothesis, ...]:
    """Return every mistake, alone and with another unit of length, by ascending closure error."""
    units, scales = tuple(LENGTH_UNIT_MISTAKES.values()), np.array(list(LENGTH_UNIT_MISTAKES))
    of_units = [ClosureError(*error) for error in closure_errors(motions, scales).tolist()]
    hypotheses = [
        ConventionHypothesis("length", words, error)
        for words, error in zip(units, of_units, strict=True)
    ]
    robots, cameras = map(
        np.stack, zip(*(mistake.undo(given) for mistake in possible), strict=True)
    )
    distinct, possible = _merge_equal(possible, robots[:, used])
    robots, cameras = robots[distinct], cameras[distinct]
    corrected = motions_of_mount(robots, cameras, used, in_hand)
    errors = closure_errors(corrected)
    # The rotations are the same in any unit of length: where they differ, none can close.
    in_units = np.full((len(possible), len(units), len(ClosureError._fields)), np.inf)
    alike = errors[:, 0] < ANGLE_TOLERANCE
    moving_alike = RelativeMotions(*(values[alike, None] for values in corrected))
    in_units[alike] = closure_errors(moving_alike, scales)
    for mistake, error, by_unit in zip(possible, errors.tolist(), in_units.tolist(), strict=True):
        alone = ClosureError(*error)
        hypotheses.append(ConventionHypothesis(mistake.name, mistake.description, alone))
        for words, unit_alone, numbers in zip(units, of_units, by_unit, strict=True):
            combined = ClosureError(*numbers)
            # Two mistakes at once are considered only if they leave less than a tenth of the
            # closure error of either alone.
            if combined.score < 0.1 * min(alone.score, unit_alone.score):
                hypotheses.append(
                    ConventionHypothesis(
                        mistake.name, f"{mistake.description}, and {words}", combined
                    )
                )
    # Scores below CLOSURE_SCORE_FLOOR are equal; the sort is stable and `mistakes` yields simple
    # ones first.
    return tuple(
        sorted(
            hypotheses,
            key=lambda hypothesis: max(hypothesis.closure_error.score, CLOSURE_SCORE_FLOOR),
        )
    )


def motions_of_mount(
    robot: Poses, camera: Poses, used: np.ndarray, in_hand: bool
) -> RelativeMotions:
    """Compute the motions of the used views for the stated mount."""
    mount_from_holder = np.linalg.inv(robot) if in_hand else robot
    return relative_motions(mount_from_holder[..., used, :, :], camera[..., used, :, :])


def _merge_equal(
    possible: Sequence[Mistake], robots: Float[np.ndarray, "mistakes views 4 4"]
) -> tuple[list[int], list[Mistake]]:
    """Return the mistakes by index and with descriptions, without those that misread angles alike.

    Two pairs of conventions may be the same mistake: the first names the others.
    """
    poses = robots.reshape(len(robots), -1)
    # Compared along one random direction, in which poses that differ are hardly ever equal.
    direction = np.random.default_rng(0).normal(size=poses.shape[1])
    along = poses @ direction / np.linalg.norm(direction)
    misreads_angles = np.array([_misreads_angles(mistake) for mistake in possible])
    are_equal = np.abs(along[:, None] - along) < _EQUAL_POSES
    are_equal &= misreads_angles[:, None] & misreads_angles
    others: dict[int, dict[str, None]] = {}
    for k, mistake in enumerate(possible):
        first = next((j for j in np.flatnonzero(are_equal[k, :k]).tolist() if j in others), k)
        others.setdefault(first, {})
        if mistake.name != possible[first].name:
            others[first][mistake.name.replace("_read_as_", " read as ")] = None
    merged = [
        possible[k]._replace(
            description=possible[k].description
            + (f" (the same are {', '.join(names)})" if names else "")
        )
        for k, names in others.items()
    ]
    return list(others), merged


def _misreads_angles(mistake: Mistake) -> bool:
    """Return whether a mistake is that angles were read in another convention."""
    return "_read_as_" in mistake.name or mistake.name == "kuka_abc_for_fanuc_wpr"


def naming_views(
    hypotheses: tuple[ConventionHypothesis, ...],
    given: GivenPoses,
    turns: Float[np.ndarray, "turns 4 4"] | None,
    used: np.ndarray,
    ids: Sequence[str],
) -> tuple[ConventionHypothesis, ...]:
    """Return the hypotheses, with the views that another numbering changes named.

    Another numbering that changes no view is left out.
    """
    if turns is None:
        return hypotheses
    changed = np.abs(numbered_alike(given, turns) - given.camera).max(axis=(1, 2)) > _EQUAL_POSES
    names = [ids[view] for view in np.flatnonzero(used & changed).tolist()]
    return tuple(
        entry._replace(description=f"{entry.description}: {listed_views(names)}")
        if entry.name == OTHER_CORNER
        else entry
        for entry in hypotheses
        if names or entry.name != OTHER_CORNER
    )


def listed_views(names: Sequence[str]) -> str:
    """Return names of views in words; of many, the first."""
    return f"view{'s' * (len(names) > 1)} {listed(names, MAX_LISTED_VIEWS)}"


def is_explained(given_error: ClosureError, hypotheses: tuple[ConventionHypothesis, ...]) -> bool:
    """Return whether the best hypothesis removes most of the error."""
    if not hypotheses:
        return False
    error = hypotheses[0].closure_error
    return bool(error.rotation < ANGLE_TOLERANCE and explains_most(error.score, given_error.score))


def removes_most(error: ClosureError, given_error: ClosureError) -> bool:
    """Return whether a corrected mistake removes most of the error, and most of the rotation's.

    Rotations that are right as given may stay as they are: a unit of length changes none.
    """
    # A mistake that leaves the rotations as wrong as before is not the one that was made.
    rotation_limit = max(ANGLE_TOLERANCE, MAX_CORRECTED_SCORE_RATIO * given_error.rotation)
    return error.rotation < rotation_limit and explains_most(error.score, given_error.score)
