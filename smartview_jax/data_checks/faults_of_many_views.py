"""Find the one fault that makes many views wrong together: a change of the set-up, or a lag.

No single view looks wrong with either. Where both explain the views, the better explanation is
named.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool

from ..calibration import host_mount_from_holder
from .changes import find_change
from .pose_lag import PoseLag, find_lag


class SharedFault(NamedTuple):
    """A fault of many views.

    Attributes:
        sentence: what is wrong, how large it is and what it explains.
        contradicts: whether no calibration can be right with it.
        explains_most: whether robot and camera agree far better without it.
        spares_no_view: whether every view is wrong, so that no majority of them can be right.
    """

    sentence: str
    contradicts: bool
    explains_most: bool
    spares_no_view: bool


class RobotAndCamera(NamedTuple):
    """The poses of robot and camera in the views.

    Attributes:
        base_from_tool: as reported, `(views)`, in the order in which the views were taken.
        camera_from_world: from the pictures alone or from a tracker, `(views)`.
        mount: where the camera is stated to be.
        view_ids: names of the views.
        length_ratio: of the camera's motion to the robot's, as in `find_change`.
        tracked: whether a tracker gave the camera's poses, without pictures.
    """

    base_from_tool: SE3
    camera_from_world: SE3
    mount: str
    view_ids: Sequence[str]
    length_ratio: float = 1.0
    tracked: bool = False


def find_shared_fault(
    poses: RobotAndCamera,
    used: Bool[np.ndarray, "views"],
    agreeing: Bool[np.ndarray, "views"] | None = None,
) -> SharedFault | None:
    """Return the change of the set-up or the lag of the robot's poses that explains the views best.

    Args:
        poses: of robot and camera.
        used: mask of the views to use.
        agreeing: mask of the views without gross errors, in which a lag is looked for if it is not
            in all; by default the same. (With a lag the views after long moves do not agree, and
            after a change the views of one side alone may.)

    Returns:
        The fault; None if there is none.
    """
    robot = host_mount_from_holder(poses.mount, poses.base_from_tool)
    change = find_change(robot, poses.camera_from_world, used, poses.length_ratio)
    lag = _lag(poses, used)
    if lag is None and agreeing is not None and (agreeing != used).any():
        lag = _lag(poses, agreeing)
    if lag is not None and (change is None or lag.score < change.changes[0].score):
        return SharedFault(lag.sentence(poses.tracked), lag.contradicts, True, True)
    if change is None:
        return None
    sentence = change.sentence(poses.mount, poses.view_ids)
    return SharedFault(sentence, change.contradicts, change.explains_most, False)


def _lag(poses: RobotAndCamera, used: Bool[np.ndarray, "views"]) -> PoseLag | None:
    """Return the lag of the robot's poses that explains most of some views' misfit, if any."""
    return find_lag(
        poses.base_from_tool, poses.camera_from_world, used, poses.mount, poses.length_ratio
    )
