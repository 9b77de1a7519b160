"""Say in a sentence which mistakes explain that robot and camera move differently, if any do."""

from collections.abc import Sequence

import numpy as np

from .closure import CLOSURE_SCORE_FLOOR, MAX_CLOSURE_SCORE, MAX_CORRECTED_SCORE_RATIO, ClosureError
from .convention_hypotheses import (
    ANGLE_TOLERANCE,
    ConventionHypothesis,
    is_explained,
    listed_views,
    removes_most,
)
from .picture_turns import PictureTurn

MAX_RIVAL_SCORE_RATIO = 2.0
"""Ratio to the best closure score up to which another mistake explains the data as well."""

WEAK_ROBOT_ANGLE_RATIO, MAX_WEAK_ROBOT_ANGLE = 0.1, np.deg2rad(8.0)
"""Rotation error that a weak robot may have where no mistake explains it: ratio to the median
rotation between two views, and its largest value, rad.

Pictures that are paired with wrong poses leave about as much as the views are turned.
"""

MAX_POSITION_ERROR, MAX_ARM_LENGTH = 0.1, 10.0
"""Closure error of the positions, over the distance to the target, from which it is looked at, and
the largest ratio, m, of an arm's errors of position and rotation: a joint that is off by an angle
moves the tool by this angle times its distance. A robot whose rotations fit has no such error."""

_POSITIONS_TEXT = (
    "they turn alike, but the positions do not fit, and no mistake that is known explains it. Are "
    "some rows in another unit, sign or base frame? Did a linear axis, a cart or a person move "
    "robot or target, which the poses do not tell?"
)


def convention_problems(
    given_error: ClosureError,
    hypotheses: tuple[ConventionHypothesis, ...],
    mismatch: float,
    rotation_angles: tuple[float, float],
    positions: bool = True,
) -> tuple[str, ...]:
    """Return the best explanation with its closure error, or nothing if the data are acceptable.

    Args:
        given_error: of the poses as given.
        hypotheses: mistakes by ascending closure error.
        mismatch: median difference of the rotation angles, rad.
        rotation_angles: median rotation between two views, of robot and camera, rad.
        positions: whether positions that do not fit, where rotations do, are a mistake. By a
            tracker, which may have a unit of its own or drift, they are not.
    """
    best = hypotheses[0]
    as_given = f"robot and camera do not move alike as given ({closure_error_text(given_error)})"
    if not is_explained(given_error, hypotheses):
        weak_robot_angle = min(WEAK_ROBOT_ANGLE_RATIO * min(rotation_angles), MAX_WEAK_ROBOT_ANGLE)
        limit = max(ANGLE_TOLERANCE, weak_robot_angle)
        if max(mismatch, given_error.rotation) > limit:
            text = _unexplained_text(best, given_error, mismatch, rotation_angles)
            return (f"{as_given}: {text}",)
        if not (positions and only_positions_differ(given_error)):
            return ()
        return (f"{as_given}: {_POSITIONS_TEXT}",)
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
            f"{r.description} ({closure_error_text(r.closure_error)})" for r in (best, *rivals[:3])
        )
        return (f"{as_given}; {1 + len(rivals)} mistakes explain it about as well: {several}",)
    explained = (
        f"{as_given}, but do if {best.description} ({closure_error_text(best.closure_error)})"
    )
    runner_up = next(other for other in hypotheses[1:] if other.name != best.name)
    if runner_up.closure_error.score > 0.5 * given_error.score:
        return (f"{explained}; no other mistake that is known explains it",)
    runner_up_text = closure_error_text(runner_up.closure_error, short=True)
    return (
        f"{explained}; the next best explanation, that {runner_up.description}, leaves "
        f"{runner_up_text}",
    )


def only_positions_differ(error: ClosureError) -> bool:
    """Return whether positions disagree by more than any arm's that turns as it says."""
    relative = error.score - error.rotation
    return relative > MAX_POSITION_ERROR and error.translation > MAX_ARM_LENGTH * error.rotation


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
            "wrong poses in no order, or the angles are in another unit (degrees?) or convention, "
            "or robot or target was moved between the views (a mobile base, a cart)"
        )
    else:
        likely = (
            f"the robot turns by {robot:.0f} degrees between two views where the camera turns by "
            f"{camera:.0f} (medians): the angles are in another unit (degrees?) or convention"
        )
    text = f"{likely}; no mistake that is known explains it"
    if not removes_most(best.closure_error, given_error):
        return text
    return (
        f"{text}, the nearest being that {best.description} "
        f"({closure_error_text(best.closure_error, short=True)})"
    )


def problem_of_views(
    given_error: ClosureError, error: ClosureError, names: Sequence[str], turn: PictureTurn | None
) -> tuple[str, ...]:
    """Return a problem that names the views without which robot and camera move alike.

    Args:
        given_error: of all views.
        error: of the views that are not named.
        names: of the views that may be wrong.
        turn: how the pictures of all of them seem to be turned or mirrored; None if they do not.
    """
    if not (removes_most(error, given_error) and error.score < MAX_CLOSURE_SCORE):
        return ()
    question = (
        "were these poses read for these pictures, or do the pictures show another target like "
        "it? Leave them out, or correct them"
    )
    if turn is not None:
        question = f"their pictures seem to be {turn.text}. {turn.advice}"
    return (
        f"robot and camera do not move alike as given ({closure_error_text(given_error)}), but do "
        f"without {listed_views(names)} ({closure_error_text(error, short=True)}): {question}",
    )


def closure_error_text(error: ClosureError, short: bool = False) -> str:
    """Return a closure error in words, in degrees and millimetres."""
    angle, length = np.rad2deg(error.rotation), 1e3 * error.translation
    numbers = f"{angle:.2f} degrees and {length:.3g} mm"
    return numbers if short else f"{numbers} left over between two views, in the median"


def inaccuracy_text(given_error: ClosureError) -> str:
    """Return that robot and camera belong together though they agree badly, as a sentence."""
    return (
        f"robot and camera agree only to {closure_error_text(given_error, short=True)} between two "
        "views (median). No known mistake explains it, and in any other order they agree less: the "
        "poses are taken as inaccurate, not as wrong. Is the target too small or too far away, is "
        "the robot not calibrated, or were robot or target moved between the views?"
    )


def of_tracked_poses(text: str) -> str:
    """Return a sentence about pictures as one about tracked poses."""
    for of_pictures, of_tracker in (
        ("the target's points", "the tracked positions"),
        ("the target seems to be", "the tracked target seems to be"),
        ("the pictures", "the tracked poses"),
        ("the camera moved", "the tracker moved"),
    ):
        text = text.replace(of_pictures, of_tracker)
    return text
