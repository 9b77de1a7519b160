"""Views that show no target, or a line of it, are told from poses that do not belong to them."""

import cv2
import numpy as np
import pytest

from smartview_jax import Dataset
from smartview_jax.data_checks.target_checks import collinear_views, mismatched_views
from smartview_jax.simulation import random_scene
from smartview_jax.staged import fit_staged
from smartview_jax.targets import Chessboard, CircleGrid

VIEWS, BOARD = 8, (7, 12)
ROW = np.arange(84) < 12


@pytest.fixture(scope="module")
def board():
    """As many views and points as the scenes of the other tests, so that they share programs."""
    return random_scene(4, VIEWS, Chessboard(*BOARD, 0.0045).points, pixel_noise=0.3)


def changed(data, pixels):
    return Dataset.from_arrays(data.points, pixels, data.base_from_tool, data.image_size)


def whole(fit):
    return {view: text for view, point, text in fit.rejected if point is None}


def test_random_points_and_points_on_a_line_are_named_for_what_they_are(board):
    pixels = np.array(board.data.pixels)
    width, height = board.data.image_size
    pixels[5] = np.random.default_rng(0).uniform([0, 0], [width - 1, height - 1], (84, 2))
    pixels[2, ~ROW] = np.nan
    seen = np.isfinite(pixels[2, :, 0]).sum()
    messages = []
    fit = fit_staged(changed(board.data, pixels), progress=messages.append)
    assert set(whole(fit)) == {"5", "2"}
    assert "its points are not the target's" in whole(fit)["5"]
    assert whole(fit)["2"] == f"the {seen} points seen lie on one line"
    assert {5, 2}.isdisjoint(fit.views)
    assert "each of 7 views" in messages[0]
    # Nor do they spoil the camera: what is left fits as well as its noise.
    assert float(fit.step2.rms) < 0.6
    truth = board.calibration.camera.alpha_u
    assert float(fit.calibration.camera.alpha_u) == pytest.approx(float(truth), rel=0.02)


def test_points_on_a_line_in_all_views_are_named(board):
    pixels = np.array(board.data.pixels)
    pixels[:, ~ROW] = np.nan
    with pytest.raises(
        ValueError, match=r"0 of 8 views have them \(view 0: the 11 points seen lie"
    ):
        fit_staged(changed(board.data, pixels))


def test_a_line_is_told_from_a_narrow_band():
    points = np.stack([np.linspace(0.0, 1.0, 8), np.zeros(8), np.zeros(8)], axis=1)
    band = points + np.where(np.arange(8)[:, None] % 2, [0.0, 0.01, 0.0], 0.0)
    seen = np.ones((3, 8), dtype=bool)
    seen[2] = False
    assert collinear_views(np.stack([points, band, points]), seen).tolist() == [True, False, False]


def equidistant_pixels(board, angle):
    """The board before a fisheye lens, whose circle of the stated angle touches the border."""
    seen = board.calibration.camera_from_world(board.base_from_tool)
    rotations, places = (np.asarray(x) for x in (seen.rotation().as_matrix(), seen.translation()))
    points = np.asarray(board.data.points)[0]
    # Near enough to fill the picture.
    places = places * np.array([1.0, 1.0, 0.15])
    x = np.einsum("vij,pj->vpi", rotations, points) + places[:, None]
    across = np.linalg.norm(x[..., :2], axis=-1, keepdims=True)
    scale = 0.5 * min(board.data.image_size) / angle
    middle = 0.5 * (np.array(board.data.image_size) - 1.0)
    pixels = middle + scale * np.arctan2(across, x[..., 2:]) * x[..., :2] / across
    inside = ((pixels >= 0.0) & (pixels <= 2.0 * middle)).all(axis=-1, keepdims=True)
    return np.where(inside, pixels, np.nan)


def judged(board, pixels, rms):
    observations = changed(board.data, pixels).observations
    return mismatched_views(rms, np.ones(VIEWS, dtype=bool), observations, board.data.image_size)


def test_a_view_of_a_fisheye_lens_is_one_of_the_target(board):
    """Step 1's lens leaves many pixels in one view, which is right all the same."""
    rms = np.array([0.2] * 7 + [40.0])
    assert judged(board, equidistant_pixels(board, 1.2), rms) == {}


def test_views_that_are_all_wrong_alike_are_named(board):
    pixels = np.array(board.data.pixels)
    wrong = pixels[:, np.random.default_rng(0).permutation(84)]
    found = judged(board, wrong, np.full(VIEWS, 90.0))
    assert set(found) == set(range(VIEWS))
    assert "by any lens, in the median" in found[2]
    assert judged(board, pixels, np.full(VIEWS, np.nan)) == {}


@pytest.mark.parametrize("rows", [11, 10])
def test_an_asymmetric_grid_that_was_detected_from_its_other_end_is_named(rows):
    """Half a turn moves each of its circles by half a distance; a few pixels, if it is small.

    A grid of ten rows goes into itself, so that no picture tells.
    """
    points = CircleGrid(rows, 4, 0.008, asymmetric=True).points
    K, size = np.array([[1100.0, 0.0, 640.0], [0.0, 1100.0, 480.0], [0.0, 0.0, 1.0]]), (1280, 960)
    turns = np.random.default_rng(0).uniform(-0.4, 0.4, (4, 3))
    pixels = np.array(
        [
            cv2.projectPoints(points, turn, np.array([0.0, 0.0, 0.4]), K, None)[0][:, 0]
            for turn in turns
        ]
    )
    pixels += 0.1 * np.random.default_rng(1).standard_normal(pixels.shape)
    pixels[2] = pixels[2, ::-1]
    data = Dataset.from_arrays(points, pixels, np.tile(np.eye(4), (4, 1, 1)), size)
    used, rms = np.ones(4, dtype=bool), np.array([0.2, 0.2, 11.0, 0.2])
    found = mismatched_views(rms, used, data.observations, size)
    assert set(found) == ({2} if rows == 11 else set())
    if found:
        assert "they fit in reverse order: was the grid detected turned by half a turn?" in found[2]
