"""Cameras that share a target see it at one place, as exactly as their pictures tell."""

import numpy as np
import pytest
from two_cameras import POINTS, rig_of, seen_by_both

from smartview_jax import Dataset, Rig
from smartview_jax.data_checks import target_findings
from smartview_jax.geometry import host_exponentials, host_matrices

HALF_A_TURN = np.eye(4)
HALF_A_TURN[:2, :2] *= -1.0
HALF_A_TURN[:2, 3] = POINTS[0, :2] + POINTS[-1, :2]


def test_a_target_that_was_moved_between_two_cameras_is_named():
    """By 1 mm, where the robot tells its place to centimetres."""
    rig = rig_of((1, 2))
    for seed in range(5):
        moved = host_exponentials(np.array([0.6e-3, 0.8e-3, 0.0, 0.0, 0.0, 2e-3]))
        found = target_findings(rig, seen_by_both(moved, np.random.default_rng(seed)))
        (text,) = found.doubts
        assert found.problems == ()
        assert text.startswith("cameras 'left' and 'right' see the target 'target' at two places")
        millimetres = float(text.split(" degrees and ")[1].split(" mm")[0])
        assert millimetres == pytest.approx(1.0, abs=0.25)


def test_two_targets_of_one_name_are_not_calibrated():
    far = host_exponentials(np.array([0.05, 0.02, 0.0, 0.0, 0.0, 0.4]))
    found = target_findings(rig_of((1, 2)), seen_by_both(far, np.random.default_rng(0)))
    (text,) = found.problems
    assert "two targets, give them names (targets=)" in text


def test_one_target_is_not_doubted():
    rig = rig_of((1, 2))
    for seed in range(30):
        found = target_findings(rig, seen_by_both(np.eye(4), np.random.default_rng(seed)))
        assert found == ((), ())


def test_few_states_in_common_tell_nothing():
    moved = host_exponentials(np.array([2e-3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    seen = seen_by_both(moved, np.random.default_rng(0), states=5)
    assert target_findings(rig_of((1, 2), states=5), seen) == ((), ())


def test_points_numbered_from_another_corner_are_named():
    seen = seen_by_both(HALF_A_TURN, np.random.default_rng(0), place_error=2e-3)
    (text,) = target_findings(rig_of((1, 2)), seen).problems
    assert text.startswith("camera 'right': the points of the target 'target' are numbered from")
    assert "180 degrees about" in text


def test_one_picture_under_two_names_is_doubted():
    (text,) = target_findings(rig_of((1, 1)), {}).doubts
    assert "the same pixels in all 12 states" in text


def test_states_with_two_names_are_doubted():
    """The second camera's views have names of their own, but the first one's poses."""
    rig = rig_of((1, 2))
    left, right = rig.cameras.values()
    poses = host_matrices(right.base_from_tool)
    named = Dataset.from_arrays(
        right.points, right.pixels, poses, (640, 480), view_ids=[f"img{k}" for k in range(12)]
    )
    (text,) = target_findings(Rig({"left": left, "right": named}), {}).doubts
    assert "12 equal poses, such as of view 0 and view img0" in text
    poses[:, 0, 3] += 0.005
    moved = Dataset.from_arrays(
        right.points, right.pixels, poses, (640, 480), view_ids=[f"img{k}" for k in range(12)]
    )
    assert target_findings(Rig({"left": left, "right": moved}), {}).doubts == ()
