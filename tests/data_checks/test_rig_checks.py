"""Cameras that share a target see it at one place, as exactly as their pictures tell."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax import Dataset, Rig
from smartview_jax.data_checks import SeenTarget, target_findings
from smartview_jax.geometry import host_exponentials
from smartview_jax.targets import Chessboard

POINTS = Chessboard(6, 9, 0.025).points
NOISE = np.repeat([1e-4, 3e-4], 3)
"""Standard deviations of a pose from one picture: m, rad."""

HALF_A_TURN = np.eye(4)
HALF_A_TURN[:2, :2] *= -1.0
HALF_A_TURN[:2, 3] = POINTS[0, :2] + POINTS[-1, :2]


def rig_of(pixels, states=12):
    """Two cameras on the hand, with the states `0, 1, ...` in common."""
    cameras = {}
    for name, seed in zip(("left", "right"), pixels, strict=True):
        seen = np.random.default_rng(seed).uniform(100.0, 400.0, (states, len(POINTS), 2))
        poses = np.tile(np.eye(4), (states, 1, 1))
        poses[:, :3, 3] = np.arange(states)[:, None] * [0.01, 0.0, 0.0]
        cameras[name] = Dataset.from_arrays(POINTS, seen, poses, (640, 480))
    return Rig(cameras)


def seen_by_both(displacement, rng, states=12, place_error=0.02):
    """The poses of a target in two cameras; the second sees it displaced.

    The places that each camera tells with its robot are wrong by centimetres.
    """
    turns = Rotation.from_rotvec(rng.normal(0.0, 0.4, (states, 3))).as_matrix()
    first = np.tile(np.eye(4), (states, 1, 1))
    first[:, :3, :3] = turns
    first[:, :3, 3] = rng.normal([0.0, 0.0, 0.45], 0.05, (states, 3))
    second_from_first = host_exponentials(np.array([-0.12, 0.01, 0.0, 0.02, -0.2, 0.05]))
    second = second_from_first @ first @ displacement
    poses = [
        host_exponentials(rng.normal(0.0, NOISE, (states, 6))) @ exact for exact in (first, second)
    ]
    places = [
        host_exponentials(rng.normal(0.0, place_error, 6) * [1, 1, 1, 0.1, 0.1, 0.1]) @ place
        for place in (np.eye(4), displacement)
    ]
    views = np.arange(states)
    return {
        name: SeenTarget(views, seen, place)
        for name, seen, place in zip(("left", "right"), poses, places, strict=True)
    }


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
