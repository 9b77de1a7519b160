"""The region in which objects are looked for."""

import numpy as np

from smartview_jax.picking import Region


def test_its_corners_are_those_of_a_box_on_its_floor():
    corners = Region(np.array([0.1, -0.1, 0.0]), (0.24, 0.18, 0.08)).corners
    assert np.allclose(corners.min(axis=0), [-0.02, -0.19, 0.0])
    assert np.allclose(corners.max(axis=0), [0.22, -0.01, 0.08])
