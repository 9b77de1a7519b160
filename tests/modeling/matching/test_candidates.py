import numpy as np
import pytest

import smartview_jax as sv
from smartview_jax.cameras import Pinhole
from smartview_jax.modeling import direction_turn, epipolar_curve, rank_candidates

CAMERA = sv.Camera(600.0, 600.0, 319.5, 239.5, Pinhole(), (640, 480))
CALIBRATION = sv.Calibration.eye_in_hand(CAMERA, np.eye(4), np.eye(4))
FIRST, SECOND = np.eye(4), np.eye(4)
SECOND[0, 3] = 0.1
"""Cameras side by side: epipolar lines are the rows of the picture."""


@pytest.fixture(scope="module")
def curve():
    return epipolar_curve(CALIBRATION, FIRST, (400.0, 200.0), SECOND, (0.2, 2.0))


def on_row(*offsets):
    """Corners on the curve at depths 0.5, 0.4, ..., and off it by offsets in px."""
    depths = 0.5 - 0.1 * np.arange(len(offsets))
    u = 400.0 - 600.0 * 0.1 / depths
    return np.column_stack([u, 200.0 + np.array(offsets)]), depths


def test_near_ones_are_kept_with_their_depth_and_ranked_by_distance(curve):
    corners, depths = on_row(1.5, 0.1, 9.0, -0.8)
    ranked = rank_candidates(curve, corners)
    np.testing.assert_array_equal(ranked.indices, [1, 3, 0])
    np.testing.assert_allclose(ranked.distance, [0.1, 0.8, 1.5], atol=1e-6)
    # `depth` is along the ray of the pixel, longer than along the axis.
    slant = np.linalg.norm([(400.0 - 319.5) / 600.0, (200.0 - 239.5) / 600.0, 1.0])
    np.testing.assert_allclose(ranked.depth, slant * depths[ranked.indices], rtol=1e-4)
    assert (np.diff(ranked.cost) > 0.0).all()


def test_appearance_orientation_and_position_on_the_curve_rank_too(curve):
    corners, depths = on_row(0.0, 0.0, 0.0)
    alike = rank_candidates(curve, corners, similarity=np.array([0.2, 0.4, 0.95]))
    np.testing.assert_array_equal(alike.indices, [2, 1, 0])
    turned = rank_candidates(curve, corners, turn=np.array([0.6, 0.05, np.nan]))
    np.testing.assert_array_equal(turned.indices, [1, 2, 0])
    expected = rank_candidates(curve, corners, expected_depth=(depths[1], 0.05))
    assert expected.indices[0] == 1


def test_an_uncertain_corner_may_be_farther_away(curve):
    corners, _ = on_row(1.0, -1.2)
    covariances = np.array([0.01, 4.0])[:, None, None] * np.eye(2)
    assert rank_candidates(curve, corners).indices[0] == 0
    assert rank_candidates(curve, corners, covariances).indices[0] == 1


def test_nothing_near_is_an_empty_answer(curve):
    ranked = rank_candidates(curve, np.array([[300.0, 400.0]]))
    assert len(ranked.indices) == len(ranked.cost) == 0


def test_the_turn_is_the_mean_of_the_nearest_angles():
    first = np.array([0.1, np.pi - 0.05, np.nan])
    second = np.array([-np.pi + 0.05, 0.3, 1.5])
    assert direction_turn(first, second) == pytest.approx(0.5 * (0.2 + 0.1))
    assert np.isnan(direction_turn(first, np.full(3, np.nan)))
    assert direction_turn(first, first) == 0.0
