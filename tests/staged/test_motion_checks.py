"""Poses that seem inaccurate are first asked for a cause: a joint, a camera, or other pictures."""

from types import SimpleNamespace

import numpy as np
import pytest

from smartview_jax.data_checks import ConventionReport
from smartview_jax.staged import motion_checks

VIEWS = 8
INACCURATE = ConventionReport((), (), 0.2, 1.0, (0.2, 0.1), (), inaccuracy="agree only to")


def views_of(misfit=None, is_small_target=False):
    """Data and views of which only the reports matter."""
    points = np.zeros((VIEWS, 4, 3))
    seen = np.ones((VIEWS, 4), dtype=bool)
    data = SimpleNamespace(
        points=points,
        pixels=points[..., :2],
        base_from_tool=None,
        mount_from_holder=None,
        mount="eye_in_hand",
        view_ids=[str(k) for k in range(VIEWS)],
        joints=None,
    )
    pictures = SimpleNamespace(
        used=np.ones(VIEWS, dtype=bool),
        common=SimpleNamespace(camera_from_world=None, inliers=seen, sigma=0.1, rms=0.1),
        steps=SimpleNamespace(camera=None),
        observations=SimpleNamespace(visible=seen),
        misfit=lambda _: misfit,
        doubts=lambda *_: (None, ()),
        unusable={},
        mismatched={},
        stretched=None,
    )
    choice = SimpleNamespace(explained=True) if is_small_target else None
    return data, SimpleNamespace(pictures=pictures, choice=choice, stale={})


@pytest.mark.parametrize("is_small_target", [False, True])
def test_inaccurate_poses_are_asked_for_other_pictures(monkeypatch, is_small_target):
    """Of a small target nothing explains the noise, also where a mistake does so by chance."""
    asked, report = [], INACCURATE._replace(explained=is_small_target)
    monkeypatch.setattr(motion_checks, "check_conventions", lambda *_, **options: report)
    monkeypatch.setattr(motion_checks, "pixel_noise", lambda _: 0.1)
    monkeypatch.setattr(motion_checks, "find_shared_fault", lambda *given: asked.append(given))
    monkeypatch.setattr(motion_checks, "resized_pictures", lambda *given: asked.append(given))
    checks = motion_checks.check_motion(*views_of(is_small_target=is_small_target))
    assert len(asked) == (1 if is_small_target else 2)
    assert not checks.report.explained


@pytest.mark.parametrize("misfit", [None, object()])
def test_a_camera_that_does_not_fit_leaves_no_inaccurate_poses(monkeypatch, misfit):
    asked = []
    monkeypatch.setattr(
        motion_checks,
        "check_conventions",
        lambda *_, may_be_inaccurate: asked.append(may_be_inaccurate) or INACCURATE,
    )
    monkeypatch.setattr(
        motion_checks, "_with_fault_of_many_views", lambda report, *_: (report, None)
    )
    motion_checks.check_motion(*views_of(misfit))
    assert asked == [misfit is None]


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
