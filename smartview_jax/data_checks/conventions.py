"""Check whether the robot's poses match the camera's poses, and name the usual mistakes if not.

Robot and camera are rigidly connected. Whatever the unknown transforms are, both rotate by the same
angle between two views, and one hand-eye transform explains both motions (`A X = X B`). If that
fails, each known mistake (`mistakes.py`) is reversed in the data, and the closure error that then
remains is computed (`convention_hypotheses.py`, `closure.py`). The mistake with the smallest
closure error is reported together with the second best; or the report says that several mistakes
explain the data, or none (`convention_texts.py`).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..calibration import mount_frames
from ..dataset import MINIMUM_RELIABLE_VIEWS, turns_about_one_axis, turns_about_one_point
from ..geometry import host_matrices
from .closure import (
    CLOSURE_SCORE_FLOOR,
    MAX_CLOSURE_SCORE,
    MAX_CORRECTED_SCORE_RATIO,
    MAX_VIEWS,
    ClosureError,
    LengthRatio,
    RelativeMotions,
    closure_error,
    explains_most,
    length_ratio,
)
from .convention_hypotheses import (
    ConventionHypothesis,
    is_explained,
    motions_of_mount,
    naming_views,
    ranked_hypotheses,
)
from .convention_texts import (
    MAX_RIVAL_SCORE_RATIO,
    convention_problems,
    inaccuracy_text,
    of_tracked_poses,
    only_positions_differ,
    problem_of_views,
)
from .given_poses import GivenPoses
from .inverted_poses import inverted_poses_doubt
from .length_units import length_unit_problems, size_doubt
from .mistakes import mistakes
from .pairing import are_paired
from .picture_turns import turn_of_picture
from .rotation_angles import (
    angle_differences,
    compared_views,
    median_rotation_angles,
    suspicious_views,
)
from .transform_fit import fit_transforms, median_distance
from .view_consistency import MAX_REJECTED_FRACTION


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
        inaccuracy: how badly robot and camera agree, as a sentence, where that is noise of poses
            which belong together; empty elsewhere.
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
    inaccuracy: str = ""

    @property
    def is_contradicted(self) -> bool:
        """Whether robot and camera do not move alike as given, because of a mistake or of noise."""
        return bool(self.problems or self.inaccuracy)

    @property
    def doubts(self) -> tuple[str, ...]:
        """The reasons why a calibration of these views is uncertain, in sentences."""
        return (self.inaccuracy, *self.ambiguities) if self.inaccuracy else self.ambiguities

    @property
    def is_close(self) -> bool:
        """Whether the closure error is small enough for a good arm."""
        return self.closure_score < MAX_CLOSURE_SCORE

    @property
    def is_certain(self) -> bool:
        """Whether the motions agree, and tell the direction of the poses and all lengths."""
        is_compared = self.closure_score > 0.0
        return is_compared and self.is_close and not (self.problems or self.doubts)


DOUBTED_SCORE, MAX_CERTAIN_SCORE_RATIO = 0.01, 0.1
"""Closure score from which mistakes are tried although a weak robot may have it, and the ratio of
corrected to given score below which one counts as an explanation of so small an error."""

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
    may_be_inaccurate: bool = True,
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
        may_be_inaccurate: whether errors like noise are taken as noise, however large; not for a
            camera that does not fit its pictures.
    """
    robot, camera = host_matrices(base_from_tool), host_matrices(camera_from_world)
    used = np.ones(len(robot), dtype=bool) if weights is None else np.asarray(weights) > 0.0
    used = used & np.isfinite(robot).all(axis=(1, 2)) & np.isfinite(camera).all(axis=(1, 2))
    differences = angle_differences(robot, camera, used, compared_views(used))
    mismatch = float(np.nanmedian(differences)) if used.sum() > 1 else 0.0
    # Two views give a single motion, which does not test the hand-eye transform.
    if used.sum() < 3:
        return ConventionReport((), (), mismatch, 1.0, (0.0, 0.0), ())
    in_hand = mount_frames(mount)[0] == "tool"
    ids = [str(view) for view in range(len(robot))] if view_ids is None else view_ids
    suspicious = suspicious_views(differences)
    suspected = [view for view, _ in suspicious]
    chain = _ComparedChain.of(GivenPoses(robot, camera), used, in_hand, tracked, ids)
    # A few wrong views, which are left out later, need not spoil what enough others say.
    rest = used & ~np.isin(np.arange(len(used)), suspected)
    most = min(MAX_REJECTED_FRACTION * used.sum(), used.sum() - MINIMUM_RELIABLE_VIEWS)
    if 0 < len(suspected) <= most:
        chain_of_rest = _ComparedChain.of(chain.given, rest, in_hand, tracked, ids)
        chain = chain_of_rest if chain_of_rest.is_accepted else chain
    hypotheses = _likely_mistakes(chain, turns)
    problems, inaccuracy = _problems(chain, hypotheses, mismatch, suspected, may_be_inaccurate)
    ambiguities = () if problems else _ambiguities(chain)
    if tracked:
        problems, ambiguities = (
            tuple(map(of_tracked_poses, texts)) for texts in (problems, ambiguities)
        )
    error = chain.error
    return ConventionReport(
        problems,
        suspicious,
        mismatch,
        chain.ratio.value,
        (error.rotation, error.translation),
        hypotheses,
        is_explained(error, hypotheses),
        chain.ratio.std,
        error.score if chain.comparable else 0.0,
        ambiguities=ambiguities,
        inaccuracy=inaccuracy,
    )


class _ComparedChain(NamedTuple):
    """The motions of robot and camera as given, and their error with the best hand-eye transform.

    Attributes:
        given: poses of robot and camera.
        used: mask of the views to compare.
        in_hand: whether the camera is stated to be on the hand.
        tracked: whether a tracker gave the camera's poses.
        ids: names of the views.
        motions: between the views.
        comparable: whether the motions determine a hand-eye rotation.
        error: closure error.
        ratio: camera motion over robot motion; 1 where it is not determined.
    """

    given: GivenPoses
    used: Bool[np.ndarray, "views"]
    in_hand: bool
    tracked: bool
    ids: Sequence[str]
    motions: RelativeMotions
    comparable: bool
    error: ClosureError
    ratio: LengthRatio

    @classmethod
    def of(
        cls,
        given: GivenPoses,
        used: Bool[np.ndarray, "views"],
        in_hand: bool,
        tracked: bool,
        ids: Sequence[str],
    ) -> "_ComparedChain":
        """Compare the motions of at least three views."""
        motions = motions_of_mount(given.robot, given.camera, used, in_hand)
        # Turns that are noise seem to have many axes.
        turned = not turns_about_one_axis(given.robot[used])
        comparable = turned and bool(motions.second_axis_ratio > MIN_SECOND_AXIS_RATIO)
        error = closure_error(motions)
        ratio = length_ratio(motions) if comparable else LengthRatio()
        # The score divides lengths by the target's distance, so a wrong unit of the target can
        # leave it small; the ratio of the motions shows it.
        if not _is_better_scale(motions, error, ratio.value):
            ratio = LengthRatio()
        return cls(given, used, in_hand, tracked, ids, motions, comparable, error, ratio)

    @property
    def is_alike_in_size(self) -> bool:
        """Whether robot and camera seem to use one unit of length."""
        return 0.2 < self.ratio.value < 5.0

    @property
    def is_accepted(self) -> bool:
        """Whether robot and camera move alike as given."""
        return self.error.score < MAX_CLOSURE_SCORE and self.is_alike_in_size


def _likely_mistakes(
    chain: _ComparedChain, turns: Float[np.ndarray, "turns 4 4"] | None
) -> tuple[ConventionHypothesis, ...]:
    """Return every mistake that was tried, the likeliest first; none for plausible poses."""
    is_accepted, given_score = chain.is_accepted, chain.error.score
    if not chain.comparable or (is_accepted and given_score < DOUBTED_SCORE):
        return ()
    possible = tuple(mistakes(chain.in_hand, len(chain.used), turns, chain.tracked))
    hypotheses = ranked_hypotheses(chain.given, chain.used, chain.in_hand, chain.motions, possible)
    hypotheses = naming_views(hypotheses, chain.given, turns, chain.used, chain.ids)
    best_score, ratio = hypotheses[0].closure_error.score, chain.ratio.value
    # Of a hundred mistakes one may by chance close a little better than the truth.
    if is_accepted and not best_score < MAX_CERTAIN_SCORE_RATIO * given_score:
        return ()
    # A tracker may have any unit.
    in_own_unit = chain.tracked and not chain.is_alike_in_size and ratio > 0.0
    if in_own_unit and closure_error(chain.motions, ratio).score < best_score:
        return ()
    return hypotheses


def _problems(
    chain: _ComparedChain,
    hypotheses: tuple[ConventionHypothesis, ...],
    mismatch: float,
    suspicious: Sequence[int],
    may_be_inaccurate: bool,
) -> tuple[tuple[str, ...], str]:
    """Return what makes the data unusable as given, or how inaccurate they are, in sentences.

    Args:
        chain: the motions.
        hypotheses: likely mistakes.
        mismatch: median difference of the rotation angles, rad.
        suspicious: views whose rotation angles differ.
        may_be_inaccurate: as in `check_conventions`.
    """
    problems, inaccuracy = _problems_of_mistakes(chain, hypotheses, mismatch), ""
    if problems and not is_explained(chain.error, hypotheses):
        if of_views := _problem_of_views(chain, suspicious):
            problems = of_views
        elif may_be_inaccurate and _are_inaccurate(chain, hypotheses):
            problems, inaccuracy = (), inaccuracy_text(chain.error)
    # A wrong convention distorts the length ratio too, so units are checked only without one.
    robot, camera = chain.given.robot, chain.given.camera
    units = length_unit_problems(chain.ratio.value, robot, camera, chain.used, chain.tracked)
    return problems or units, "" if units else inaccuracy


def _problems_of_mistakes(
    chain: _ComparedChain, hypotheses: tuple[ConventionHypothesis, ...], mismatch: float
) -> tuple[str, ...]:
    """Return the mistakes that make robot and camera move differently, in sentences.

    Args:
        chain: the motions.
        hypotheses: likely mistakes.
        mismatch: median difference of the rotation angles, rad.
    """
    if not hypotheses:
        return ()
    compared = compared_views(chain.used)
    angles = median_rotation_angles(chain.given.robot, chain.given.camera, compared)
    # Positions that fit in another size of the target are not in another frame.
    positions = not chain.tracked and closure_error(chain.motions, chain.ratio.value).score > (
        MAX_CORRECTED_SCORE_RATIO * chain.error.score
    )
    return convention_problems(chain.error, hypotheses, mismatch, angles, positions)


def _problem_of_views(chain: _ComparedChain, suspicious: Sequence[int]) -> tuple[str, ...]:
    """Return that some views are wrong, in a sentence, if the others agree.

    Args:
        chain: the motions.
        suspicious: views whose rotation angles differ.
    """
    robot, camera, used = chain.given.robot, chain.given.camera, chain.used
    rest = used & ~np.isin(np.arange(len(used)), suspicious)
    # Three views close with some wrong poses, too.
    if not 3 < rest.sum() < used.sum():
        return ()
    error = closure_error(motions_of_mount(robot, camera, rest, chain.in_hand))
    mount_from_holder = np.linalg.inv(robot) if chain.in_hand else robot
    fit = fit_transforms(mount_from_holder, camera, rest)
    turns = {
        turn_of_picture(fit, mount_from_holder[view], camera[view], median_distance(camera[used]))
        for view in suspicious
    }
    turn = turns.pop() if len(turns) == 1 and not chain.tracked else None
    return problem_of_views(chain.error, error, [chain.ids[view] for view in suspicious], turn)


def _are_inaccurate(chain: _ComparedChain, hypotheses: tuple[ConventionHypothesis, ...]) -> bool:
    """Return whether robot and camera differ by noise, and move alike apart from that.

    Positions alone that do not fit are a mistake: an arm that moves its tool by so much also turns
    it. And of all readings of the poses the one as given has to be the likeliest. With an unknown
    mistake, other mistakes leave as much.
    """
    if not hypotheses or only_positions_differ(chain.error):
        return False
    # Noise has six numbers a view, and a median tells its size about as well as half of them. The
    # mistakes together are as probable beforehand as none: of many, one leaves a little less by
    # chance.
    views = min(int(chain.used.sum()), MAX_VIEWS)
    best = hypotheses[0].closure_error.score
    if 3.0 * views * math.log(chain.error.score / best) > math.log(len(hypotheses)):
        return False
    given, used = chain.given, chain.used
    robot = np.linalg.inv(given.robot[used]) if chain.in_hand else given.robot[used]
    return are_paired(robot, given.camera[used])


def _ambiguities(chain: _ComparedChain) -> tuple[str, ...]:
    """Return what these views cannot tell although robot and camera agree, in sentences."""
    if not (chain.comparable and chain.is_accepted):
        return ()
    robot, camera, used = chain.given.robot, chain.given.camera, chain.used
    rival_score = MAX_RIVAL_SCORE_RATIO * max(chain.error.score, CLOSURE_SCORE_FLOOR)
    doubts = (
        inverted_poses_doubt(robot, camera, used, chain.in_hand, rival_score),
        size_doubt(camera, used) if turns_about_one_point(robot[used]) else "",
    )
    return tuple(doubt for doubt in doubts if doubt)


def _is_better_scale(motions: RelativeMotions, given_error: ClosureError, ratio: float) -> bool:
    """Return whether robot and camera move alike in other units far better than as given."""
    # Three views about the target close with almost any scale, some by chance.
    return (
        0.2 < ratio < 5.0
        or given_error.score > MAX_CLOSURE_SCORE
        or (ratio > 0.0 and explains_most(closure_error(motions, ratio).score, given_error.score))
    )
