"""Corners of the gradient on drawn pictures, whose vertices are known."""

import cv2
import numpy as np
import pytest

from smartview_jax.features.corners import gradient_corners
from smartview_jax.features.gradient import Gradient

VERTEX = np.array([40.3, 30.6])
"""Of a quadrilateral that is darker than what is behind it, px."""

SIDES = np.array([[-1.0, -0.1], [-0.05, 1.0]])


def quadrilateral(contrast, rim=None):
    """A picture of a vertex; with `rim`, there is a patch as dark as print so many px from it."""
    scale, background = 8, 165.0
    picture = np.full((80 * scale, 80 * scale), background, np.float32)

    def fill(corners, level):
        # Drawn large and averaged, so that edges are where they should be.
        cv2.fillConvexPoly(
            picture, np.rint(scale * (np.array(corners) + 0.5) - 0.5).astype(np.int32), level
        )

    a, b = SIDES
    fill([VERTEX, VERTEX + 60 * a, VERTEX + 60 * (a + b), VERTEX + 60 * b], background - contrast)
    if rim is not None:
        patch = VERTEX + [-rim, 0.0] + 0.3 * rim * b
        ends = [patch, patch + 10 * a, patch + 10 * a + 7 * b, patch + 7 * b + [-2, 0]]
        fill(ends, background - 50.0)
    small = cv2.resize(picture, (80, 80), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(0).normal(0.0, 0.6, small.shape)
    return np.rint(cv2.GaussianBlur(small, (0, 0), 0.7) + noise).astype(float)


def found_in(picture):
    return gradient_corners(picture, Gradient.of(picture))


@pytest.mark.parametrize("rim", [0.5, 1.0, 1.5])
def test_the_vertex_of_weak_edges_next_to_a_patch_is_a_candidate(rim):
    """The structure peaks in the patch, more than 1.5 px from where the edges meet."""
    corners, covariances = found_in(quadrilateral(20.0, rim))
    distance = np.linalg.norm(corners - VERTEX, axis=1)
    k = int(np.argmin(distance))
    assert distance[k] < 1.1
    # It is as uncertain as it says, and the peak remains a candidate of its own.
    error = corners[k] - VERTEX
    assert error @ np.linalg.solve(covariances[k], error) < 6.0
    assert np.sqrt(np.linalg.eigvalsh(covariances[k])[1]) > 0.5
    assert np.sort(distance)[1] > 1.5


@pytest.mark.parametrize("contrast", [40.0, 140.0])
def test_the_vertex_of_two_edges_is_found_next_to_the_peak_within(contrast):
    corners, _ = found_in(quadrilateral(contrast))
    distance = np.sort(np.linalg.norm(corners - VERTEX, axis=1))
    assert distance[0] < 0.4
    assert 1.0 < distance[1] < 2.5
