"""Edge points of straight steps, drawn from the normal distribution's integral."""

import numpy as np
import pytest
from scipy.special import ndtr

from smartview_jax.features.edge_points import find_edge_points
from smartview_jax.features.gradient import BORDER, Gradient

SIZE = 120


@pytest.mark.parametrize("degrees", [10.0, 35.0, 60.0])
def test_an_edge_that_the_border_cuts_is_straight(degrees):
    angle = np.deg2rad(degrees)
    normal = np.array([np.cos(angle), np.sin(angle)])
    pixels = np.stack(np.meshgrid(np.arange(float(SIZE)), np.arange(float(SIZE))), axis=-1)
    picture = 50.0 + 120.0 * ndtr((pixels - 0.5 * SIZE) @ normal / 0.75)
    points = find_edge_points(Gradient.of(picture))
    assert np.abs((points.pixels - 0.5 * SIZE) @ normal).max() < 0.01
    # It is found as far as smoothing does not reach over the border.
    assert points.cells.min() == BORDER
    assert points.cells.max() == SIZE - 1 - BORDER
