"""Edge points in the picture that a camera without distortion would take."""

import numpy as np
import pytest

import smartview_jax as sv
from smartview_jax.cameras import OpenCV5
from smartview_jax.features import IdealPlane

PLANE = IdealPlane(
    sv.Camera(600.0, 560.0, 319.5, 239.5, OpenCV5(-0.2, 0.05, 1e-3, -2e-3, 0.0), (640, 480))
)


def test_a_gradient_stays_at_a_right_angle_to_its_edge():
    """The edge's direction in the ideal plane is the difference of two places on it."""
    rng, step = np.random.default_rng(0), 1e-3
    pixels, angles = rng.uniform((20.0, 20.0), (620.0, 460.0), (50, 2)), rng.uniform(0.0, 6.28, 50)
    normals = np.column_stack([np.cos(angles), np.sin(angles)])
    edges = np.column_stack([-np.sin(angles), np.cos(angles)])
    points, turned = PLANE.with_normals(pixels, normals)
    assert np.array_equal(points, PLANE.from_pixels(pixels))
    along, across = (
        PLANE.from_pixels(pixels + step * way) - PLANE.from_pixels(pixels - step * way)
        for way in (edges, normals)
    )
    assert np.abs((turned * along).sum(axis=1) / (2.0 * step)).max() < 1e-8
    assert ((turned * across).sum(axis=1) > 0.0).all()
    assert np.linalg.norm(turned, axis=1) == pytest.approx(1.0)
    # The lens turns some of them by degrees.
    assert (turned * normals).sum(axis=1).min() < np.cos(np.deg2rad(1.0))
