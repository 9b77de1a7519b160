"""How far along an edge its points err alike, against noise that SciPy smooths."""

import tracemalloc

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from smartview_jax.features import SMOOTHED_LENGTH, EdgePoints, correlated_length


def rough_edges(blur, rng, count=20, length=600):
    """Lines, and edge points a pixel apart along them with white noise that is smoothed."""
    segments, pixels, normals = [], [], []
    for k in range(count):
        angle = rng.uniform(0.0, np.pi)
        d, n = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        start = np.array([2000.0 * k, 0.0])
        noise = gaussian_filter1d(rng.standard_normal(length + 100), blur)[50:-50]
        noise *= 0.1 / noise.std()
        pixels.append(start + np.arange(length)[:, None] * d + noise[:, None] * n)
        normals.append(np.tile(n, (length, 1)))
        segments.append([start, start + (length - 1) * d])
    pixels = np.concatenate(pixels)
    points = EdgePoints(
        pixels, np.concatenate(normals), np.full(len(pixels), 20.0), np.rint(pixels).astype(int)
    )
    return np.array(segments), points


@pytest.mark.parametrize("blur", [2.0, 4.0])
def test_the_length_of_smoothed_noise_is_known(blur):
    """The correlation of the noise is exp(-d^2 / 4 s^2), whose integral is 2 sqrt(pi) s."""
    segments, points = rough_edges(blur, np.random.default_rng(0))
    length = correlated_length(segments, points, np.ones(len(points.pixels), dtype=bool))
    # Fitting the lines takes some of the longest waves away, the more the shorter they are.
    assert length == pytest.approx(2.0 * np.sqrt(np.pi) * blur, rel=0.15)


def test_no_length_is_shorter_than_what_smoothing_makes_it():
    segments, points = rough_edges(0.1, np.random.default_rng(1))
    everywhere = np.ones(len(points.pixels), dtype=bool)
    assert correlated_length(segments, points, everywhere) == SMOOTHED_LENGTH
    # Without segments, or where other edges displace all points, nothing is measured.
    assert correlated_length(segments[:0], points, everywhere) == SMOOTHED_LENGTH
    assert correlated_length(segments, points, ~everywhere) == SMOOTHED_LENGTH


def test_points_next_to_another_edge_do_not_count():
    segments, points = rough_edges(2.0, np.random.default_rng(2))
    lone = np.random.default_rng(3).random(len(points.pixels)) < 0.8
    displaced = points.pixels + np.where(lone, 0.0, 1.0)[:, None] * points.normals
    spoilt = points._replace(pixels=displaced)
    kept = correlated_length(segments, spoilt, lone)
    assert kept == pytest.approx(correlated_length(segments, points, lone), rel=1e-9)
    assert kept == pytest.approx(2.0 * np.sqrt(np.pi) * 2.0, rel=0.2)


def test_a_long_edge_takes_little_memory():
    """A matrix of all pairs of its points would have 200 MB."""
    segments, points = rough_edges(2.0, np.random.default_rng(4), count=1, length=5000)
    tracemalloc.start()
    measured = correlated_length(segments, points, np.ones(len(points.pixels), dtype=bool))
    assert tracemalloc.get_traced_memory()[1] < 50e6
    tracemalloc.stop()
    assert measured == pytest.approx(2.0 * np.sqrt(np.pi) * 2.0, rel=0.2)
