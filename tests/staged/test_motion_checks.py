"""Poses that seem inaccurate are first asked for a cause: a joint or a camera."""

from types import SimpleNamespace

import numpy as np

from smartview_jax.data_checks import ConventionReport
from smartview_jax.staged import motion_checks

VIEWS = 8
INACCURATE = ConventionReport((), (), 0.2, 1.0, (0.2, 0.1), (), inaccuracy="agree only to")


def test_a_joint_whose_reading_is_not_read_again_is_named_before_inaccurate_poses(monkeypatch):
    monkeypatch.setattr(motion_checks, "joint_problem", lambda *_: "")
    monkeypatch.setattr(motion_checks, "find_other_arm", lambda *_: None)
    joints = np.random.default_rng(0).normal(size=(VIEWS, 6))
    joints[:, 2] = joints[0, 2]
    data = SimpleNamespace(
        joints=joints, arm=object(), mount="eye_in_hand", view_ids=[str(k) for k in range(VIEWS)]
    )
    used = np.ones(VIEWS, dtype=bool)
    report = motion_checks._with_mistake_in_joints(INACCURATE, data, None, used)
    (problem,) = report.problems
    assert problem.startswith("a reading stays the same to the last digit")
    assert report.doubts == ()
    monkeypatch.setattr(motion_checks, "joint_problem", lambda *_: "joint 3 counts backwards")
    report = motion_checks._with_mistake_in_joints(INACCURATE, data, None, used)
    assert report.problems == ("joint 3 counts backwards",)
    assert report.doubts == ()
