"""A view is still if the target moves by less than its points' noise, and the robot reports so."""

import numpy as np
import pytest

from smartview_jax.capture import settle_test
from smartview_jax.detection import empty_detection
from smartview_jax.detection.detection import full_detection

POSE = np.eye(4)


def grid(rng, count=8, noise=0.05, move=lambda p: p):
    points = np.stack(np.meshgrid(np.arange(count), np.arange(count)), -1).reshape(-1, 2) * 40.0
    return full_detection(move(points) + noise * rng.standard_normal(points.shape))


def turned(points, degrees=0.05):
    angle = np.deg2rad(degrees)
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return (points - 140.0) @ R.T + 140.0


def test_noise_is_no_motion():
    rng = np.random.default_rng(0)
    runs = [settle_test(grid(rng), grid(rng), POSE, POSE).is_settled for _ in range(200)]
    assert np.mean(runs) > 0.97
    # Four points, as a single tag has, tell little about their noise.
    runs = [settle_test(grid(rng, 2), grid(rng, 2), POSE, POSE).is_settled for _ in range(200)]
    assert np.mean(runs) > 0.97


@pytest.mark.parametrize(
    "move", [lambda p: p + np.array([0.1, 0.0]), turned, lambda p: (p - 140.0) * 1.001 + 140.0]
)
def test_shift_turn_and_approach_are_motions(move):
    rng = np.random.default_rng(1)
    runs = [settle_test(grid(rng), grid(rng, move=move), POSE, POSE) for _ in range(50)]
    assert np.mean([run.is_settled for run in runs]) < 0.1
    assert all("moves in the picture" in run.reason for run in runs if not run.is_settled)
    assert np.mean([run.noise for run in runs]) == pytest.approx(0.05, rel=0.1)


def test_a_motion_far_below_the_noise_does_no_harm():
    rng = np.random.default_rng(2)
    runs = [
        settle_test(grid(rng, 30), grid(rng, 30, move=lambda p: p + 0.02), POSE, POSE)
        for _ in range(20)
    ]
    assert all(run.is_settled for run in runs)


def test_pictures_without_noise_may_be_equal_but_not_moved():
    rng = np.random.default_rng(3)
    assert settle_test(grid(rng, noise=0.0), grid(rng, noise=0.0), POSE, POSE).is_settled
    moved = grid(rng, noise=0.0, move=lambda p: p + 0.01)
    assert not settle_test(grid(rng, noise=0.0), moved, POSE, POSE).is_settled


def test_the_robots_report_has_to_stand_too():
    rng = np.random.default_rng(4)
    after = POSE.copy()
    after[0, 3] = 5e-4
    test = settle_test(grid(rng), grid(rng), POSE, after)
    assert not test.is_settled
    assert "its report changed by 0.50 mm" in test.reason


def test_without_a_target_there_is_no_view():
    rng = np.random.default_rng(5)
    test = settle_test(empty_detection(64, "no circles"), grid(rng), POSE, POSE)
    assert test.reason == "target not found: no circles"
    assert np.isnan(test.motion)
