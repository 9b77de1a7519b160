"""Find views that agree in groups: pictures of two cameras, poses of several tools or base frames.

Where views of two cameras are mixed in one folder, or the controller's tool frame was another one
in every second view, no view is wrong by itself, no view parts good ones from bad ones, and no
median over pairs of views is small. But some views agree with each other, and the others disagree
with these by one transform, or by a few. So the transforms are fitted to three views at a time; the
three with which the most views agree give the largest group, and the disagreements of the others
are gathered. Three views that agree by chance would have to do so in six numbers each.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Int

from ..geometry import mean_matrix
from .closure import MAX_CLOSURE_SCORE, MAX_CORRECTED_SCORE_RATIO, Poses
from .convention_hypotheses import listed_views
from .largest_group import MAX_DISAGREEMENT, MIN_GROUP, disagreements, largest_group
from .misfit_evidence import VERY_STRONG_EVIDENCE, errors_of, evidence
from .picture_turns import MIRRORED, PictureTurn, mirrored_poses, turn_of_change
from .transform_fit import (
    fit_transforms,
    mean_misfit,
    median_distance,
    misfit_text,
    misfits,
    motions_from_camera_to_target,
    moved_text,
)


@dataclasses.dataclass(frozen=True)
class GroupOptions:
    """Say which groups of views are named.

    Attributes:
        min_views: fewest views: three of two groups agree with anything.
        min_share: smallest share of the views that the groups must contain.
        tolerance: largest disagreement of views of one group, rotation (rad) plus translation over
            the distance to the target.
        min_odds: smallest odds of the groups.
    """

    min_views: int = 7
    min_share: float = 0.85
    tolerance: float = MAX_DISAGREEMENT
    min_odds: float = VERY_STRONG_EVIDENCE


class ViewGroup(NamedTuple):
    """Views that agree with each other, and how they differ from the largest group.

    Attributes:
        views: indices of the views.
        translation, rotation: size of the change from the largest group's frame, m and rad.
        turn: how their pictures seem to be turned or mirrored against the largest group's; None
            where they do not.
    """

    views: tuple[int, ...]
    translation: float = 0.0
    rotation: float = 0.0
    turn: PictureTurn | None = None


class ViewGroups(NamedTuple):
    """Groups of views that agree in themselves but not with each other.

    Attributes:
        kind: `"camera"` where the camera is another one on its mount, `"target"` where the target
            is elsewhere on its holder, `"mirror"` where pictures were mirrored.
        groups: the largest one first.
        misfit, given_misfit: mean misfit over their views with the changes and without, m and rad.
        score: rotation plus translation over the distance to the target, with the changes.
    """

    kind: str
    groups: tuple[ViewGroup, ...]
    misfit: tuple[float, float]
    given_misfit: tuple[float, float]
    score: float

    @property
    def are_in_order(self) -> bool:
        """Whether each group ends before the next one begins."""
        ends = sorted((group.views[0], group.views[-1]) for group in self.groups)
        return all(first[1] < second[0] for first, second in itertools.pairwise(ends))

    def sentence(self, mount: str, view_ids: Sequence[str]) -> str:
        """Return in words which views agree, how the groups differ, and what may be the cause.

        Args:
            mount: where the camera is stated to be.
            view_ids: names of the views.
        """

        def named(group: ViewGroup) -> str:
            return listed_views([view_ids[view] for view in group.views])

        largest, *others = self.groups
        differences = [
            f"{named(group)}, as if "
            + (
                group.turn.clause
                if group.turn is not None
                else moved_text(self.kind, mount, (group.translation, group.rotation))
            )
            for group in others
        ]
        turns = [group.turn for group in others]
        if turns[0] is not None and None not in turns:
            question = turns[0].advice
        elif self.kind == "camera":
            question = (
                "Are pictures of several cameras mixed, or poses of several tools? Calibrate each "
                "group by itself"
            )
        else:
            question = (
                "Are poses in several base frames mixed, or did a linear axis or a person move "
                "robot or target, which the poses do not tell, or are two targets alike in view? "
                "Calibrate each group by itself"
            )
        return (
            f"the views agree in {len(self.groups)} groups, which contradict each other: "
            f"{named(largest)}; and {'; and '.join(differences)}. With that, robot and camera "
            f"agree to {misfit_text(self.misfit)} instead of {misfit_text(self.given_misfit)} "
            f"(means over the views). {question}"
        )


def find_groups(
    mount_from_holder: SE3,
    camera_from_world: SE3,
    used: Bool[np.ndarray, "views"],
    options: GroupOptions | None = None,
) -> ViewGroups | None:
    """Return the groups in which the views agree; None where all agree, or too few do.

    Args:
        mount_from_holder: the robot's part of the chain, `(views)`.
        camera_from_world: from the pictures alone, `(views)`.
        used: mask of the views to use.
        options: which groups are named; by default `GroupOptions()`.
    """
    options = options or GroupOptions()
    views = np.flatnonzero(used)
    if len(views) < options.min_views:
        return None
    motions = motions_from_camera_to_target(mount_from_holder, camera_from_world, views, 1.0)
    if motions is None:
        return None
    robot, camera = motions
    distance = median_distance(camera)
    closure = fit_transforms(robot, camera).closure
    if mean_misfit(closure, distance)[1] < MAX_CLOSURE_SCORE:
        return None
    largest = largest_group(robot, camera, distance, options.tolerance)
    if largest.sum() <= MIN_GROUP:
        return None
    fit = fit_transforms(robot, camera, largest)
    of_mirrored = fit.closure.copy()
    of_mirrored[~largest] = fit.closure_of(robot, mirrored_poses(camera))[~largest]
    gathered = [
        (name, closure, _gathered(closure, ~largest, distance, options))
        for kind, on_mount in (("", fit.closure), ("mirror", of_mirrored))
        for name, closure in (
            (kind or "camera", on_mount),
            (kind or "target", np.linalg.inv(robot) @ on_mount @ robot),
        )
    ]
    # The kind that leaves the fewest views alone, with the fewest groups.
    kind, closure, others = max(
        gathered, key=lambda entry: (sum(map(len, entry[2])), -len(entry[2]))
    )
    # In the order of the views: errors of successive ones are alike.
    members = np.sort(np.concatenate([np.flatnonzero(largest), *others]))
    if not others or len(members) < options.min_share * len(views):
        return None
    corrected = closure.copy()
    groups = [ViewGroup(tuple(views[largest].tolist()))]
    for group in others:
        change = mean_matrix(closure[group], np.ones(len(group)))
        corrected[group] = np.linalg.inv(change) @ closure[group]
        translation, rotation = misfits(change).tolist()
        turn = MIRRORED if kind == "mirror" else None
        if kind == "camera":
            turn = turn_of_change(fit.camera_from_mount, change, distance)
        groups.append(ViewGroup(tuple(views[group].tolist()), translation, rotation, turn))
    # A view that is wrong by itself, and in no group, bends a fit to all of them.
    of_members = np.isin(np.arange(len(views)), members)
    given = fit_transforms(robot, camera, of_members).closure[members]
    odds = evidence(errors_of(given), errors_of(corrected[members]), 6 * len(others))
    # Each view may be of any group.
    odds -= 2.0 * len(members) * np.log(1 + len(others))
    if odds < 2.0 * np.log(options.min_odds):
        return None
    misfit, score = mean_misfit(corrected[members], distance)
    given_misfit, given_score = mean_misfit(given, distance)
    # The errors of a weak robot can be gathered, too, but remain in the groups.
    if score > MAX_CORRECTED_SCORE_RATIO * given_score:
        return None
    return ViewGroups(kind, tuple(groups), misfit, given_misfit, score)


def _gathered(
    closure: Poses, rest: Bool[np.ndarray, "views"], distance: float, options: GroupOptions
) -> list[Int[np.ndarray, "members"]]:
    """Return groups of views with one disagreement each, the largest first.

    Args:
        closure: disagreement of each view with the largest group.
        rest: the views that are not of it.
        distance: median distance of the target, m.
        options: tolerance and smallest size of a group.
    """
    groups, left_over = [], np.flatnonzero(rest)
    while len(left_over) >= MIN_GROUP:
        near = np.array(
            [
                disagreements(np.linalg.inv(closure[view]) @ closure[left_over], distance)
                < 2.0 * options.tolerance
                for view in left_over
            ]
        )
        middle = int(np.argmax(near.sum(axis=1)))
        if near[middle].sum() < MIN_GROUP:
            break
        groups.append(left_over[near[middle]])
        left_over = left_over[~near[middle]]
    return groups
