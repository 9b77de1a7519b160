"""A joint that was not read again is named with its views; one that may stand still is not."""

import numpy as np
from described_arm import readings

from smartview_jax.data_checks import stuck_joints

VIEWS = 12
EVERY_VIEW = np.ones(VIEWS, dtype=bool)
IDS = [f"v{view}" for view in range(VIEWS)]


def frozen(joint, views):
    """Readings of a joint that stay as they were in the first of these views."""
    joints = readings(VIEWS)
    joints[views, joint] = joints[views.start or 0, joint]
    return joints


def test_the_views_of_a_joint_that_was_not_read_are_named():
    text = stuck_joints(frozen(3, slice(5, 11)), EVERY_VIEW, IDS)
    assert "while most joints move: joint 4 from view v5 to v10: was it read" in text
    both = frozen(3, slice(None))
    both[4:, 1] = both[4, 1]
    text = stuck_joints(both, EVERY_VIEW, IDS)
    assert "joint 2 from view v4 to v11, joint 4 from view v0 to v11" in text


def test_joints_that_are_read_and_views_from_one_pose_are_not_named():
    assert stuck_joints(readings(VIEWS), EVERY_VIEW, IDS) == ""
    assert stuck_joints(frozen(3, slice(5, 8)), EVERY_VIEW, IDS) == ""
    # Five pictures from one pose, and masked views.
    joints = readings(VIEWS)
    joints[4:9] = joints[4]
    assert stuck_joints(joints, EVERY_VIEW, IDS) == ""
    assert stuck_joints(frozen(3, slice(5, 11)), EVERY_VIEW & (np.arange(VIEWS) < 8), IDS) == ""


def test_an_arm_that_is_jogged_by_one_or_two_joints_at_a_time_is_not_doubted():
    moves = np.kron(np.eye(3), np.ones((VIEWS // 3, 2))) * readings(VIEWS)
    joints = np.cumsum(moves, axis=0)
    assert stuck_joints(joints, EVERY_VIEW, IDS) == ""
