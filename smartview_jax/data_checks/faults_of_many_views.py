"""Find the one fault that makes many views wrong together: a change, drift, lag, focus or groups.

No single view looks wrong with any of them. Where several explain the views, the best explanation
is named.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool

from ..calibration import host_mount_from_holder
from .changes import find_change
from .focus_changes import SeenDistances, find_focus_change
from .largest_group import MIN_GROUP
from .pose_lag import find_lag
from .set_up_drift import find_drift
from .smooth_errors import errors_of_transforms
from .transform_fit import mean_size, median_distance, motions_from_camera_to_target
from .view_groups import find_groups

MIN_RATIO_DIFFERENCE = 0.01
"""Smallest difference of the motions' lengths that may hide a fault, or come from one."""


class SharedFault(NamedTuple):
    """A fault of many views.

    Attributes:
        sentence: what is wrong, how large it is and what it explains.
        contradicts: whether no calibration can be right with it.
        explains_most: whether robot and camera agree far better without it.
        first_view: index of the first view after a change; 0 where every view is wrong.
        may_be_zoom: whether a lens that zoomed once explains the views about as well.
        excludes_zoom: whether a lens that zoomed once is less likely.
        score: rotation plus translation over the distance to the target, with the fault; infinite
            where it was not compared.
    """

    sentence: str
    contradicts: bool
    explains_most: bool
    first_view: int = 0
    may_be_zoom: bool = False
    excludes_zoom: bool = False
    score: float = np.inf

    def divides(self, agreeing: Bool[np.ndarray, "views"]) -> bool:
        """Return whether views that agree contain the fault, so that no majority is right.

        Args:
            agreeing: mask of the views that agree with each other.
        """
        before, every = agreeing[: self.first_view].sum(), agreeing.sum()
        return self.first_view == 0 or bool(0.25 * every < before < 0.75 * every)


class RobotAndCamera(NamedTuple):
    """The poses of robot and camera in the views.

    Attributes:
        base_from_tool: as reported, `(views)`, in the order in which the views were taken.
        camera_from_world: from the pictures alone or from a tracker, `(views)`.
        mount: where the camera is stated to be.
        view_ids: names of the views.
        length_ratio: of the camera's motion to the robot's, as in `find_change`.
        tracked: whether a tracker gave the camera's poses, without pictures.
        drifts: whether the tracker may drift by itself, which the fit of its poses estimates.
        distances: what pictures tell of the target's distance, where they gave the camera's poses.
    """

    base_from_tool: SE3
    camera_from_world: SE3
    mount: str
    view_ids: Sequence[str]
    length_ratio: float = 1.0
    tracked: bool = False
    drifts: bool = False
    distances: SeenDistances | None = None


def find_shared_fault(
    poses: RobotAndCamera,
    used: Bool[np.ndarray, "views"],
    agreeing: Bool[np.ndarray, "views"] | None = None,
) -> SharedFault | None:
    """Return the change, drift, lag, mixture of groups or change of focus that explains most.

    A change may look like another size of the target, and a target of another size may hide a
    change. So it is looked for with the robot's motion as reported, and as long as the camera's.

    Args:
        poses: of robot and camera.
        used: mask of the views to use.
        agreeing: mask of the views without gross errors, in which a lag is looked for if it is not
            in all; by default the same. (With a lag the views after long moves do not agree, and
            after a change the views of one side alone may.)

    Returns:
        The fault; None if there is none.
    """
    faults = list(_faults(poses, used, agreeing))
    if abs(poses.length_ratio - 1.0) >= MIN_RATIO_DIFFERENCE:
        # Another size of the target may be all that is wrong.
        limit = _score_of_all(poses, used)
        as_reported = _faults(poses._replace(length_ratio=1.0), used, agreeing)
        faults += [fault for fault in as_reported if fault.score < limit]
    best = min(faults, key=lambda fault: fault.score, default=None)
    # A tracker loses its target and finds it elsewhere, which the fit of its poses treats itself.
    if poses.tracked or (best is not None and best.explains_most):
        return best
    robot = host_mount_from_holder(poses.mount, poses.base_from_tool)
    groups = find_groups(robot, poses.camera_from_world, used)
    # Groups that follow each other are what a change leaves.
    if groups is not None and not (best is not None and best.first_view and groups.are_in_order):
        sentence = groups.sentence(poses.mount, poses.view_ids)
        return SharedFault(sentence, True, True, score=groups.score)
    # A focus has an error of its own in every view, which explains much of other faults as well.
    if groups is not None or poses.distances is None:
        return best
    focus = find_focus_change(robot, poses.camera_from_world, used, poses.distances, poses.mount)
    if focus is None:
        return best
    # A lens that zoomed once is told from which view on.
    zoomed = next((fault for fault in faults if fault.may_be_zoom), None)
    if zoomed is not None:
        return zoomed
    if focus.is_once and best is not None and best.excludes_zoom:
        return best
    return SharedFault(focus.sentence(poses.view_ids), False, True)


def _score_of_all(poses: RobotAndCamera, used: Bool[np.ndarray, "views"]) -> float:
    """Return the score that a fit to all views leaves, without any fault; infinite without one."""
    robot = host_mount_from_holder(poses.mount, poses.base_from_tool)
    views = np.flatnonzero(used)
    if len(views) < MIN_GROUP:
        return np.inf
    motions = motions_from_camera_to_target(
        robot, poses.camera_from_world, views, poses.length_ratio
    )
    if motions is None:
        return np.inf
    return mean_size(errors_of_transforms(*motions), median_distance(motions[1]))[1]


def _faults(
    poses: RobotAndCamera,
    used: Bool[np.ndarray, "views"],
    agreeing: Bool[np.ndarray, "views"] | None,
) -> Iterator[SharedFault]:
    """Yield the faults that explain the views."""
    camera, mount, ratio = poses.camera_from_world, poses.mount, poses.length_ratio
    robot = host_mount_from_holder(mount, poses.base_from_tool)
    lag = find_lag(poses.base_from_tool, camera, used, mount, ratio)
    if lag is None and agreeing is not None and (agreeing != used).any():
        lag = find_lag(poses.base_from_tool, camera, agreeing, mount, ratio)
    if lag is not None:
        sentence = lag.sentence(poses.tracked)
        yield SharedFault(sentence, lag.contradicts, True, score=lag.score)
    if (change := find_change(robot, camera, used, ratio)) is not None:
        sentence, best = change.sentence(mount, poses.view_ids), change.changes[0]
        yield SharedFault(
            sentence,
            change.contradicts,
            change.explains_most,
            best.first_view,
            may_be_zoom=any(named.kind == "zoom" for named in change.changes),
            excludes_zoom=change.likeliest_kind != "zoom",
            score=best.score,
        )
    if poses.drifts:
        return
    if (drift := find_drift(robot, camera, used, ratio)) is not None:
        sentence = drift.sentence(mount, poses.view_ids)
        yield SharedFault(sentence, drift.contradicts, True, score=drift.score)
