"""The noise of edge points and lines, against pictures of straight steps."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ndtr

from smartview_jax.features import STANDARD_WIDTH
from smartview_jax.features.edge_points import find_edge_points
from smartview_jax.features.gradient import Gradient
from smartview_jax.localization.edges.edge_line_fit import (
    GRID_SIGMA,
    POINT_OF_GRADIENT,
    EdgeSamples,
    fitted_lines,
    grid_variance,
)

ROWS, COLUMNS = 900, 60


def upright_step(place, blur, noise=0.0):
    """The grey levels of a blurred step along the columns, the mean over each pixel's area."""
    inside = np.linspace(-0.5, 0.5, 41)
    across = np.arange(float(COLUMNS))[:, None] + inside - place
    grey = 50.0 + 120.0 * ndtr(across / blur).mean(axis=1)
    white = np.random.default_rng(0).standard_normal((ROWS, COLUMNS))
    return grey + noise * white


@pytest.mark.parametrize("noise", [1.0, 3.0])
def test_points_have_the_noise_of_the_picture(noise):
    gradient = Gradient.of(upright_step(29.8, STANDARD_WIDTH, noise))
    points = find_edge_points(gradient)
    expected = POINT_OF_GRADIENT * gradient.sigma / points.strengths.mean()
    assert points.pixels[:, 0].std() == pytest.approx(expected, rel=0.15)


def test_only_edges_along_the_grid_are_off_as_a_whole():
    """By the place between two pixels; the mean over all places in a sharp picture."""
    errors = []
    for place in np.linspace(29.0, 30.0, 9)[:-1]:
        points = find_edge_points(Gradient.of(upright_step(place, 0.5)[:20]))
        errors.append(points.pixels[:, 0].mean() - place)
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(GRID_SIGMA, rel=0.1)
    for slope, expected in ((0.0, GRID_SIGMA**2), (0.2, 0.0)):
        count = 50
        p = np.column_stack([29.3 + slope * np.arange(count), np.arange(float(count))])
        d = np.tile(np.array([slope, 1.0]) / np.hypot(slope, 1.0), (count, 1))
        n, ones = np.column_stack([-d[:, 1], d[:, 0]]), jnp.ones(count)
        samples = EdgeSamples(
            ones > 0.0, p, d, jnp.asarray(n), ones, jnp.zeros(count, int), ones[None]
        )
        line = fitted_lines(samples, jnp.zeros(count), ones)
        np.testing.assert_allclose(grid_variance(samples, line), [expected], atol=1e-9)
