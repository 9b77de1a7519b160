"""The width of edges, compared with steps blurred by SciPy and with pictures of real targets."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, uniform_filter1d
from shared_data import shared_data

from smartview_jax.detection import read_picture
from smartview_jax.features import target_edge_width

SQUARE, SIZE = 40, 240
CORNERS = np.stack(np.meshgrid(*[np.arange(SQUARE, SIZE, SQUARE) - 0.5] * 2), axis=-1).reshape(
    -1, 2
)

FINER = 4
"""The board is drawn so many times larger, and averaged."""


def board(blur):
    """A chessboard of whole squares, blurred before the pixels average it."""
    light = np.add.outer(*[np.arange(SIZE // SQUARE)] * 2) % 2
    fine = 40.0 + 160.0 * np.kron(light, np.ones((FINER * SQUARE, FINER * SQUARE)))
    noise = np.random.default_rng(0).normal(0.0, 2.0, (SIZE, SIZE))
    return blur(fine).reshape(SIZE, FINER, SIZE, FINER).mean(axis=(1, 3)) + noise


@pytest.mark.parametrize("sigma", [0.7, 2.0, 5.0])
def test_a_lens_widens_edges_by_its_blur(sigma):
    picture = board(lambda fine: gaussian_filter(fine, FINER * sigma, truncate=3.0))
    # A pixel averages over its area, whose variance is 1/12.
    expected = 2.0 * np.sqrt(2.0 * np.log(2.0) * (sigma**2 + 1.0 / 12.0))
    assert target_edge_width(picture, CORNERS) == pytest.approx(expected, rel=0.05, abs=0.35)


def test_a_movement_widens_edges_by_its_length_although_half_of_them_stay_sharp():
    picture = board(lambda fine: uniform_filter1d(fine, 11 * FINER, axis=1))
    assert target_edge_width(picture, CORNERS) == pytest.approx(11.0, rel=0.1)


def test_of_a_picture_without_the_target_all_edges_are_measured():
    picture = board(lambda fine: gaussian_filter(fine, FINER * 3.0, truncate=3.0))
    none, blank = np.zeros((0, 2)), np.full((100, 100), 80, dtype=np.uint8)
    assert target_edge_width(picture, none) == pytest.approx(7.1, rel=0.15)
    assert target_edge_width(blank, none) is None
    assert target_edge_width(blank, CORNERS[:6]) is None


@pytest.mark.parametrize(
    ("name", "corners", "picture"),
    [
        ("rct_circle10x10", "corners.csv", "images/0.png"),
        ("koide_charuco", "20230920_corners.csv", "images/20230920_000.png"),
        ("visp_franka_eih", "corners.csv", "franka_image-1.png"),
        ("visp_franka_eth", "corners.csv", "franka_image-1.png"),
    ],
)
def test_edges_of_real_targets_are_sharp_until_they_are_blurred(name, corners, picture):
    folder = shared_data(name)
    table = np.genfromtxt(folder / corners, delimiter=",", skip_header=1)
    pixels = table[table[:, 0] == 0, 4:6]
    grey = read_picture(folder / picture)
    assert 1.0 < target_edge_width(grey, pixels) < 3.5
    assert 4.5 < target_edge_width(cv2.GaussianBlur(grey, (0, 0), 2.5), pixels) < 7.0
