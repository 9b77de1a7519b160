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
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..calibration import mount_frames
from ..geometry import host_matrices
from .closure import Closure, Motion, Poses, closure, length_ratio, motion
from .mistakes import mistakes


class Explanation(NamedTuple):
    """A mistake, and the closure error that remains when it is corrected.

    Attributes:
        name: of the mistake.
        words: what was done wrong, as a clause.
        closure: the closure error with the mistake corrected.
    """

    name: str
    words: str
    closure: Closure


class ConventionReport(NamedTuple):
    """The result of comparing robot and camera motion.

    Attributes:
        problems: sentences; each problem makes the data unusable as given.
        suspicious_views: view index and sentence, for views that fit the others badly.
        angle_mismatch: median difference of the rotation angles, rad.
        length_ratio: camera motion over robot motion; 1 if it is not determined.
        misfit: median rotation and translation error with the best hand-eye transform, rad, m.
        explanations: every mistake that was tried, smallest closure error first; empty if the
            data are plausible as given.
    """

    problems: tuple[str, ...]
    suspicious_views: tuple[tuple[int, str], ...]
    angle_mismatch: float
    length_ratio: float
    misfit: tuple[float, float]
    explanations: tuple[Explanation, ...]


ANGLE_TOLERANCE = np.deg2rad(4.0)
"""Largest acceptable median rotation error, rad."""

SOUND = 0.03
"""Closure score below which data are accepted: about 10 mm and a degree at half a metre."""

BETTER = 0.3
"""Ratio of corrected to given closure score below which a mistake counts as an explanation."""

ALIKE = 2.0
"""Ratio to the best closure score up to which another mistake explains the data as well."""

NOTHING = 1e-4
"""Closure score treated as zero: 0.05 mm at half a metre, less than any robot's error."""

ONE_AXIS = 0.05
"""Ratio of rotation about a second axis to rotation about the first, up to which the motions do not
determine a hand-eye rotation and cannot be compared."""

REACH = 30.0
"""Distance in metres beyond the reach of any arm and beyond any target's distance."""


def check_conventions(
    base_from_tool: SE3,
    camera_from_world: SE3,
    mount: str,
    weights: Float[Array, "views"] | np.ndarray | None = None,
) -> ConventionReport:
    """Compare the motion of the robot with the motion of the camera over all pairs of views.

    Args:
        base_from_tool: as reported, `(views)`.
        camera_from_world: from the pictures alone, `(views)`.
        mount: where the camera is stated to be, `"eye_in_hand"` or `"eye_to_hand"`.
        weights: zero leaves a view out.
    """
    in_hand = mount_frames(mount)[0] == "tool"
    robot, camera = host_matrices(base_from_tool), host_matrices(camera_from_world)
    used = np.ones(len(robot), dtype=bool) if weights is None else np.asarray(weights) > 0.0
    used = used & np.isfinite(robot).all(axis=(1, 2)) & np.isfinite(camera).all(axis=(1, 2))
    angles = _angle_differences(robot, camera, used)
    mismatch = float(np.nanmedian(angles)) if used.sum() > 1 else 0.0
    # Two views give a single motion, which does not test the hand-eye transform.
    if used.sum() < 3:
        return ConventionReport((), (), mismatch, 1.0, (0.0, 0.0), ())
    pairs = _motion(robot, camera, used, in_hand)
    comparable = pairs.second_axis > ONE_AXIS
    given, ratio = closure(pairs), length_ratio(pairs) if comparable else 1.0
    problems, explanations = (), ()
    # The score divides lengths by the target's distance, so a wrong unit of the target can leave
    # it small; the ratio of the motions shows it.
    if comparable and (given.score > SOUND or not 0.2 < ratio < 5.0):
        explanations = _explanations(robot, camera, used, in_hand, pairs)
        problems = _problems(given, explanations, mismatch, _turns(robot, camera, used))
    # A wrong convention distorts the length ratio too, so units are checked only without one.
    if not problems:
        problems = _other_lengths(ratio, robot, camera, used)
    return ConventionReport(
        problems,
        _suspicious(angles),
        mismatch,
        ratio,
        (given.rotation, given.translation),
        explanations,
    )


def _motion(robot: Poses, camera: Poses, used: np.ndarray, in_hand: bool) -> Motion:
    """Compute the motions of the used views for the stated mount."""
    mount_from_holder = np.linalg.inv(robot) if in_hand else robot
    return motion(mount_from_holder[used], camera[used])


_LENGTHS = {
    1e-3: "the robot's positions look like millimetres where metres are expected",
    1e-2: "the robot's positions look like centimetres where metres are expected",
    0.0254: "the robot's positions look like inches where metres are expected",
    1e2: "the target's points look like centimetres where metres are expected",
    1e3: "the target's points look like millimetres where metres are expected",
}
"""Explanations in words, by the ratio of camera motion to robot motion."""


def _explanations(
    robot: Poses, camera: Poses, used: np.ndarray, in_hand: bool, pairs: Motion
) -> tuple[Explanation, ...]:
    """Return every mistake, alone and with another unit of length, by ascending closure error."""
    found = [
        Explanation("length", words, closure(pairs, scale)) for scale, words in _LENGTHS.items()
    ]
    for mistake in mistakes(in_hand, len(robot)):
        undone = _motion(*mistake.undo(robot, camera), used, in_hand)
        alone = Explanation(mistake.name, mistake.words, closure(undone))
        found.append(alone)
        for scale, words in _LENGTHS.items():
            both = closure(undone, scale)
            # Two mistakes at once are considered only if they leave less than a tenth of the
            # closure error of the first alone.
            if both.rotation < ANGLE_TOLERANCE and both.score < 0.1 * alone.closure.score:
                found.append(Explanation(mistake.name, f"{mistake.words}, and {words}", both))
    # Scores below NOTHING are equal; the sort is stable and `mistakes` yields simple ones first.
    return tuple(sorted(found, key=lambda one: max(one.closure.score, NOTHING)))


def _problems(
    given: Closure,
    explanations: tuple[Explanation, ...],
    mismatch: float,
    turns: tuple[float, float],
) -> tuple[str, ...]:
    """Return the best explanation with its closure error, or nothing if the data are acceptable."""
    best = explanations[0]
    explained = (
        best.closure.rotation < ANGLE_TOLERANCE and best.closure.score < BETTER * given.score
    )
    as_given = f"robot and camera do not move alike as given ({_left_over(given)})"
    if not explained:
        unbelievable = max(mismatch, given.rotation) > ANGLE_TOLERANCE
        return (f"{as_given}: {_unexplained(best, mismatch, turns)}",) if unbelievable else ()
    # Mistakes with nearly the same closure error cannot be distinguished: report all of them.
    rivals = [
        one
        for one in explanations[1:]
        if one.name != best.name
        and one.closure.score < min(ALIKE * max(best.closure.score, NOTHING), BETTER * given.score)
    ]
    if rivals:
        several = "; or ".join(f"{r.words} ({_left_over(r.closure)})" for r in (best, *rivals[:3]))
        return (f"{as_given}; {1 + len(rivals)} mistakes explain it about as well: {several}",)
    other = next(one for one in explanations[1:] if one.name != best.name)
    return (
        f"{as_given}, but do if {best.words} ({_left_over(best.closure)}); the next best "
        f"explanation, that {other.words}, leaves {_left_over(other.closure, short=True)}",
    )


def _left_over(found: Closure, short: bool = False) -> str:
    """Return a closure error in words, in degrees and millimetres."""
    angle, length = np.rad2deg(found.rotation), 1e3 * found.translation
    numbers = f"{angle:.2f} degrees and {length:.3g} mm"
    return numbers if short else f"{numbers} left over between two views, in the median"


def _unexplained(best: Explanation, mismatch: float, turns: tuple[float, float]) -> str:
    """Return what may be wrong, in words, when correcting no known mistake explains the motions."""
    robot, camera = (float(np.rad2deg(turn)) for turn in turns)
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
    return (
        f"{likely}; no mistake that is known explains it, the nearest being that {best.words} "
        f"({_left_over(best.closure, short=True)})"
    )


def _turns(robot: Poses, camera: Poses, used: np.ndarray) -> tuple[float, float]:
    """Return the median rotation angle between two views, of robot and of camera, rad."""
    upper = np.triu_indices(int(used.sum()), 1)
    robot_turn, camera_turn = (float(np.median(_angles(p[used])[upper])) for p in (robot, camera))
    return robot_turn, camera_turn


def _other_lengths(ratio: float, robot: Poses, camera: Poses, used: np.ndarray) -> tuple[str, ...]:
    """Return problems with units of length, by the ratio of motions or by impossible distances."""
    if not 0.2 < ratio < 5.0:
        power = 10.0 ** round(math.log10(abs(ratio)))
        different = "robot positions and target points are not in the same unit"
        words = _LENGTHS.get(power, different) if ratio > 0.0 else different
        return (f"{words}: the camera moved {ratio:.3g} times as far as the robot",)
    # Both may be in the same wrong unit: their ratio is then 1, and only the distances show it.
    found = []
    for poses, what in (
        (robot, "the tool is reported {:.0f} m from the base"),
        (camera, "the target seems to be {:.0f} m from the camera"),
    ):
        distance = float(np.median(np.linalg.norm(poses[used, :3, 3], axis=1)))
        if distance > REACH:
            found.append(f"{what.format(distance)}: millimetres where metres are expected?")
    return tuple(found)


def _suspicious(angles: Float[np.ndarray, "views views"]) -> tuple[tuple[int, str], ...]:
    """Return views whose rotation angles disagree with most others, which agree with each other."""
    used = np.isfinite(angles).any(axis=1)
    typical = np.zeros(len(angles))
    typical[used] = np.nanmedian(angles[used], axis=1)
    # Relative to the typical view, because an inaccurate robot makes all views differ.
    limit = max(6.0 * float(np.median(typical[used])), np.deg2rad(3.0))
    return tuple(
        (
            int(view),
            f"its rotation differs from the robot's by {np.rad2deg(typical[view]):.1f} degrees "
            f"(median over the other views): is this picture paired with the right pose?",
        )
        for view in np.flatnonzero(typical > limit)
    )


def _angle_differences(
    robot: Poses, camera: Poses, used: np.ndarray
) -> Float[np.ndarray, "views views"]:
    """Return the differences of robot and camera rotation angles, rad; NaN for unused views.

    The angle is the same in every frame, so this needs no hand-eye transform.
    """
    gap = np.abs(_angles(np.linalg.inv(_finite(robot))) - _angles(_finite(camera)))
    unused = np.eye(len(gap), dtype=bool) | ~np.outer(used, used)
    return np.where(unused, np.nan, gap)


def _finite(poses: Poses) -> Poses:
    """Return the poses with the identity in place of poses that are not finite."""
    return np.where(np.isfinite(poses).all(axis=(1, 2), keepdims=True), poses, np.eye(4))


def _angles(poses: Poses) -> Float[np.ndarray, "views views"]:
    """Return the angle of `R_i R_j^T` for all pairs of views, rad: `2 cos(angle) + 1 = trace`."""
    R = poses[:, :3, :3].reshape(len(poses), 9)
    return np.arccos(np.clip(0.5 * (R @ R.T - 1.0), -1.0, 1.0))
