"""Check whether the robot's poses match the camera's poses, and name the usual mistakes if not.

Robot and camera are rigidly connected. Whatever the unknown transforms are, both rotate by the same
angle between two views, and one hand-eye transform explains both motions (`A X = X B`). If that
fails, each known mistake (`mistakes.py`) is reversed in the data, and the closure error that then
remains is computed (`closure.py`). The mistake with the smallest closure error is reported together
with the second best; or the report says that several mistakes explain the data, or none.

Rotations alone seldom distinguish the mistakes: inverted poses, transposed rotations, reordered
quaternions and KUKA angles read as Fanuc angles have the same rotation angles, about axes that some
hand-eye rotation explains. Positions distinguish them.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..argument_checks import listed
from ..calibration import mount_frames
from ..dataset import turns_about_one_axis, turns_about_one_point
from ..geometry import host_matrices
from .closure import (
    ClosureError,
    LengthRatio,
    Poses,
    RelativeMotions,
    closure_error,
    closure_errors,
    length_ratio,
    relative_motions,
)
from .inverted_poses import inverted_poses_doubt
from .length_units import LENGTH_UNIT_MISTAKES, length_unit_problems, size_doubt
from .mistakes import OTHER_CORNER, GivenPoses, Mistake, mistakes, numbered_alike
from .rotation_angles import (
    angle_differences,
    compared_views,
    median_rotation_angles,
    suspicious_views,
)


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


class ConventionReport(NamedTuple):
    """The result of comparing robot and camera motion.

    Attributes:
        problems: sentences; each problem makes the data unusable as given.
        suspicious_views: view index and sentence, for views that fit the others badly.
        angle_mismatch: median difference of the rotation angles, rad.
        length_ratio: camera motion over robot motion; 1 if it is not determined.
        closure_error: median rotation and translation error with the best hand-eye transform, rad
            and m.
        hypotheses: every mistake that was tried, smallest closure error first; empty if the
            data are plausible as given.
        explained: whether the first of them removes most of the error.
        length_ratio_std: standard deviation of `length_ratio`; infinite if it is not determined.
        closure_score: rotation plus translation of `closure_error` over the target's distance; 0
            for motions that do not determine a hand-eye rotation.
        change: what seems to have been changed between two views, or how the poses seem to lag the
            pictures, as a sentence; empty if nothing does.
        ambiguities: sentences on what these views cannot tell, although robot and camera agree.
    """

    problems: tuple[str, ...]
    suspicious_views: tuple[tuple[int, str], ...]
    angle_mismatch: float
    length_ratio: float
    closure_error: tuple[float, float]
    hypotheses: tuple[ConventionHypothesis, ...]
    explained: bool = False
    length_ratio_std: float = math.inf
    closure_score: float = 0.0
    change: str = ""
    ambiguities: tuple[str, ...] = ()

    @property
    def is_close(self) -> bool:
        """Whether the closure error is small enough for a good arm."""
        return self.closure_score < MAX_CLOSURE_SCORE


ANGLE_TOLERANCE = np.deg2rad(4.0)
"""Largest acceptable median rotation error, rad."""

WEAK_ROBOT_ANGLE_RATIO, MAX_WEAK_ROBOT_ANGLE = 0.1, np.deg2rad(8.0)
"""Rotation error that a weak robot may have where no mistake explains it: ratio to the median
rotation between two views, and its largest value, rad.

Pictures that are paired with wrong poses leave about as much as the views are turned.
"""

MAX_CLOSURE_SCORE = 0.03
"""Closure score below which data are accepted: about 10 mm and a degree at half a metre."""

MAX_CORRECTED_SCORE_RATIO = 0.3
"""Ratio of corrected to given closure score below which a mistake counts as an explanation."""

DOUBTED_SCORE, MAX_CERTAIN_SCORE_RATIO = 0.01, 0.1
"""Closure score from which mistakes are tried although a weak robot may have it, and the ratio of
corrected to given score below which one counts as an explanation of so small an error."""

MAX_RIVAL_SCORE_RATIO = 2.0
"""Ratio to the best closure score up to which another mistake explains the data as well."""

MAX_LISTED_VIEWS = 12
"""Largest number of views that a sentence lists."""

_EQUAL_POSES = 1e-9
"""Largest difference of poses (m, and entries of rotations) that is a rounding error."""

CLOSURE_SCORE_FLOOR = 1e-4
"""Closure score treated as zero: 0.05 mm at half a metre, less than any robot's error."""

MIN_SECOND_AXIS_RATIO = 0.05
"""Ratio of rotation about a second axis to rotation about the first, up to which the motions do not
determine a hand-eye rotation and cannot be compared."""


def check_conventions(
    base_from_tool: SE3,
    camera_from_world: SE3,
    mount: str,
    weights: Float[Array, "views"] | np.ndarray | None = None,
    turns: Float[np.ndarray, "turns 4 4"] | None = None,
    view_ids: Sequence[str] | None = None,
    tracked: bool = False,
) -> ConventionReport:
    """Compare the motion of the robot with the motion of the camera over all pairs of views.

    Args:
        base_from_tool: as reported, `(views)`.
        camera_from_world: from the pictures alone, `(views)`.
        mount: where the camera is stated to be, `"eye_in_hand"` or `"eye_to_hand"`.
        weights: zero leaves a view out.
        turns: turns of the target that take its points into each other (`target_turns`).
        view_ids: names of the views in the sentences; by default numbers.
        tracked: whether a tracker gave the camera's poses, without pictures.
    """
    in_hand = mount_frames(mount)[0] == "tool"
    robot, camera = host_matrices(base_from_tool), host_matrices(camera_from_world)
    used = np.ones(len(robot), dtype=bool) if weights is None else np.asarray(weights) > 0.0
    used = used & np.isfinite(robot).all(axis=(1, 2)) & np.isfinite(camera).all(axis=(1, 2))
    compared = compared_views(used)
    differences = angle_differences(robot, camera, used, compared)
    mismatch = float(np.nanmedian(differences)) if used.sum() > 1 else 0.0
    # Two views give a single motion, which does not test the hand-eye transform.
    if used.sum() < 3:
        return ConventionReport((), (), mismatch, 1.0, (0.0, 0.0), ())
    motions = _relative_motions(robot, camera, used, in_hand)
    # Turns that are noise seem to have many axes.
    turned = not turns_about_one_axis(robot[used])
    comparable = turned and motions.second_axis_ratio > MIN_SECOND_AXIS_RATIO
    given_error = closure_error(motions)
    ratio, ratio_std = length_ratio(motions) if comparable else LengthRatio()
    problems, hypotheses = (), ()
    ids = [str(view) for view in range(len(robot))] if view_ids is None else view_ids
    # The score divides lengths by the target's distance, so a wrong unit of the target can leave
    # it small; the ratio of the motions shows it.
    if not _is_better_scale(motions, given_error, ratio):
        ratio, ratio_std = LengthRatio()
    is_accepted = given_error.score < MAX_CLOSURE_SCORE and 0.2 < ratio < 5.0
    if comparable and not (is_accepted and given_error.score < DOUBTED_SCORE):
        possible, given = (
            tuple(mistakes(in_hand, len(robot), turns, tracked)),
            GivenPoses(robot, camera),
        )
        hypotheses = _ranked_hypotheses(given, used, in_hand, motions, possible)
        hypotheses = _naming_views(hypotheses, given, turns, used, ids)
        # Of a hundred mistakes one may by chance close a little better than the truth.
        certain = hypotheses[0].closure_error.score < MAX_CERTAIN_SCORE_RATIO * given_error.score
        if is_accepted and not certain:
            hypotheses = ()
    suspicious = suspicious_views(differences)
    if hypotheses:
        problems = _convention_problems(
            given_error, hypotheses, mismatch, median_rotation_angles(robot, camera, compared)
        )
    if problems and not _is_explained(given_error, hypotheses):
        views = [view for view, _ in suspicious]
        rest = used & ~np.isin(np.arange(len(used)), views)
        # Three views close with some wrong poses, too.
        if 3 < rest.sum() < used.sum():
            error = closure_error(_relative_motions(robot, camera, rest, in_hand))
            problems = _problem_of_views(given_error, error, [ids[k] for k in views]) or problems
    # A wrong convention distorts the length ratio too, so units are checked only without one.
    if not problems:
        problems = length_unit_problems(ratio, robot, camera, used, tracked)
    ambiguities = ()
    if comparable and is_accepted and not problems:
        rival_score = MAX_RIVAL_SCORE_RATIO * max(given_error.score, CLOSURE_SCORE_FLOOR)
        doubts = (
            inverted_poses_doubt(robot, camera, used, in_hand, rival_score),
            size_doubt(camera, used) if turns_about_one_point(robot[used]) else "",
        )
        ambiguities = tuple(doubt for doubt in doubts if doubt)
    if tracked:
        problems, ambiguities = (
            tuple(map(_of_tracked_poses, texts)) for texts in (problems, ambiguities)
        )
    return ConventionReport(
        problems,
        suspicious,
        mismatch,
        ratio,
        (given_error.rotation, given_error.translation),
        hypotheses,
        _is_explained(given_error, hypotheses),
        ratio_std,
        given_error.score if comparable else 0.0,
        ambiguities=ambiguities,
    )


def _of_tracked_poses(text: str) -> str:
    """Return a sentence about pictures as one about tracked poses."""
    for of_pictures, of_tracker in (
        ("the target's points", "the tracked positions"),
        ("the target seems to be", "the tracked target seems to be"),
        ("the pictures", "the tracked poses"),
        ("the camera moved", "the tracker moved"),
    ):
        text = text.replace(of_pictures, of_tracker)
    return text


def _is_better_scale(motions: RelativeMotions, given_error: ClosureError, ratio: float) -> bool:
    """Return whether robot and camera move alike in other units far better than as given."""
    # Three views about the target close with almost any scale, some by chance.
    return (
        0.2 < ratio < 5.0
        or given_error.score > MAX_CLOSURE_SCORE
        or (
            ratio > 0.0
            and closure_error(motions, ratio).score < MAX_CORRECTED_SCORE_RATIO * given_error.score
        )
    )


def _relative_motions(
    robot: Poses, camera: Poses, used: np.ndarray, in_hand: bool
) -> RelativeMotions:
    """Compute the motions of the used views for the stated mount."""
    mount_from_holder = np.linalg.inv(robot) if in_hand else robot
    return relative_motions(mount_from_holder[..., used, :, :], camera[..., used, :, :])


def _ranked_hypotheses(
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
    corrected = _relative_motions(robots, cameras, used, in_hand)
    errors = closure_errors(corrected)
    # The rotations are the same in any unit of length: where they differ, none can close.
    in_units = np.full((len(possible), len(units), len(ClosureError._fields)), np.inf)
    alike = errors[:, 0] < ANGLE_TOLERANCE
    moving_alike = RelativeMotions(*(values[alike, None] for values in corrected))
    in_units[alike] = closure_errors(moving_alike, scales)
    for mistake, error, own in zip(possible, errors.tolist(), in_units.tolist(), strict=True):
        alone = ClosureError(*error)
        hypotheses.append(ConventionHypothesis(mistake.name, mistake.description, alone))
        for words, unit_alone, numbers in zip(units, of_units, own, strict=True):
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


def _merge_equal(
    possible: Sequence[Mistake], robots: Float[np.ndarray, "mistakes views 4 4"]
) -> tuple[list[int], list[Mistake]]:
    """Return the mistakes by index and with descriptions, without those that misread angles alike.

    Two pairs of conventions may be the same mistake: the first names the others.

    Args:
        possible: all mistakes.
        robots: the poses that each of them gives.
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


def _naming_views(
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
        entry._replace(description=f"{entry.description}: {_listed_views(names)}")
        if entry.name == OTHER_CORNER
        else entry
        for entry in hypotheses
        if names or entry.name != OTHER_CORNER
    )


def _listed_views(names: Sequence[str]) -> str:
    """Return names of views in words; of many, the first."""
    return f"view{'s' * (len(names) > 1)} {listed(names, MAX_LISTED_VIEWS)}"


def _problem_of_views(
    given_error: ClosureError, error: ClosureError, names: Sequence[str]
) -> tuple[str, ...]:
    """Return a problem that names the views without which robot and camera move alike.

    Args:
        given_error: of all views.
        error: of the views that are not named.
        names: of the views that may be wrong.
    """
    if not (_removes_most(error, given_error) and error.score < MAX_CLOSURE_SCORE):
        return ()
    return (
        f"robot and camera do not move alike as given ({_closure_error_text(given_error)}), but do "
        f"without {_listed_views(names)} ({_closure_error_text(error, short=True)}): were these "
        "poses read for these pictures? Leave them out, or correct them",
    )


def _is_explained(given_error: ClosureError, hypotheses: tuple[ConventionHypothesis, ...]) -> bool:
    """Return whether the best hypothesis removes most of the error."""
    if not hypotheses:
        return False
    error = hypotheses[0].closure_error
    return bool(
        error.rotation < ANGLE_TOLERANCE
        and error.score < MAX_CORRECTED_SCORE_RATIO * given_error.score
    )


def _convention_problems(
    given_error: ClosureError,
    hypotheses: tuple[ConventionHypothesis, ...],
    mismatch: float,
    rotation_angles: tuple[float, float],
) -> tuple[str, ...]:
    """Return the best explanation with its closure error, or nothing if the data are acceptable."""
    best = hypotheses[0]
    as_given = f"robot and camera do not move alike as given ({_closure_error_text(given_error)})"
    if not _is_explained(given_error, hypotheses):
        weak_robot_angle = min(WEAK_ROBOT_ANGLE_RATIO * min(rotation_angles), MAX_WEAK_ROBOT_ANGLE)
        limit = max(ANGLE_TOLERANCE, weak_robot_angle)
        implausible = max(mismatch, given_error.rotation) > limit
        return (
            (f"{as_given}: {_unexplained_text(best, given_error, mismatch, rotation_angles)}",)
            if implausible
            else ()
        )
    # Mistakes with nearly the same closure error cannot be distinguished: report all of them.
    first_named = {hypothesis.name: hypothesis for hypothesis in hypotheses[::-1]}
    rivals = [
        hypothesis
        for hypothesis in hypotheses[1:]
        if hypothesis.name != best.name
        and hypothesis is first_named[hypothesis.name]
        and hypothesis.closure_error.score
        < min(
            MAX_RIVAL_SCORE_RATIO * max(best.closure_error.score, CLOSURE_SCORE_FLOOR),
            MAX_CORRECTED_SCORE_RATIO * given_error.score,
        )
    ]
    if rivals:
        several = "; or ".join(
            f"{r.description} ({_closure_error_text(r.closure_error)})" for r in (best, *rivals[:3])
        )
        return (f"{as_given}; {1 + len(rivals)} mistakes explain it about as well: {several}",)
    explained = (
        f"{as_given}, but do if {best.description} ({_closure_error_text(best.closure_error)})"
    )
    runner_up = next(other for other in hypotheses[1:] if other.name != best.name)
    if runner_up.closure_error.score > 0.5 * given_error.score:
        return (f"{explained}; no other mistake that is known explains it",)
    runner_up_text = _closure_error_text(runner_up.closure_error, short=True)
    return (
        f"{explained}; the next best explanation, that {runner_up.description}, leaves "
        f"{runner_up_text}",
    )


def _closure_error_text(error: ClosureError, short: bool = False) -> str:
    """Return a closure error in words, in degrees and millimetres."""
    angle, length = np.rad2deg(error.rotation), 1e3 * error.translation
    numbers = f"{angle:.2f} degrees and {length:.3g} mm"
    return numbers if short else f"{numbers} left over between two views, in the median"


def _unexplained_text(
    best: ConventionHypothesis,
    given_error: ClosureError,
    mismatch: float,
    rotation_angles: tuple[float, float],
) -> str:
    """Return what may be wrong, in words, when correcting no known mistake explains the motions."""
    robot, camera = (float(np.rad2deg(angle)) for angle in rotation_angles)
    # Equal rotation angles in every pair exclude wrong pairing and wrong angle units.
    if mismatch < ANGLE_TOLERANCE:
        likely = "they turn by the same angles, but about other axes"
    elif 0.67 < robot / max(camera, 1e-9) < 1.5:
        likely = (
            "they turn about as far, but not between the same views: the pictures are paired with "
            "wrong poses in no order, or the angles are in another unit (degrees?) or convention"
        )
    else:
        likely = (
            f"the robot turns by {robot:.0f} degrees between two views where the camera turns by "
            f"{camera:.0f} (medians): the angles are in another unit (degrees?) or convention"
        )
    text = f"{likely}; no mistake that is known explains it"
    if not _removes_most(best.closure_error, given_error):
        return text
    return (
        f"{text}, the nearest being that {best.description} "
        f"({_closure_error_text(best.closure_error, short=True)})"
    )


def _removes_most(error: ClosureError, given_error: ClosureError) -> bool:
    """Return whether a corrected mistake removes most of the error, and most of the rotation's.

    Rotations that are right as given may stay as they are: a unit of length changes none.
    """
    # A mistake that leaves the rotations as wrong as before is not the one that was made.
    rotation_limit = max(ANGLE_TOLERANCE, MAX_CORRECTED_SCORE_RATIO * given_error.rotation)
    return (
        error.rotation < rotation_limit
        and error.score < MAX_CORRECTED_SCORE_RATIO * given_error.score
    )
