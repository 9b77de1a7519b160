"""Edge points near other edges: found as by brute force, and displaced as the theory says."""

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.special import erf

from smartview_jax.features.edge_points import EdgePoints, find_edge_points
from smartview_jax.features.gradient import SMOOTHING, Gradient
from smartview_jax.features.lone_edges import (
    CLEARANCE,
    MAX_ALONG,
    OTHER_EDGE,
    SPREAD,
    lone_points,
)

BLUR = 0.7
"""Blur of the drawn pictures, px, before the edges are found in them."""


def next_to_another(points):
    """Which points have a point of another edge nearby, from the distances of all pairs."""
    is_near = np.zeros(len(points.pixels), dtype=bool)
    along = np.column_stack([-points.normals[:, 1], points.normals[:, 0]])
    for a, b in KDTree(points.pixels).query_pairs(CLEARANCE + MAX_ALONG, output_type="ndarray"):
        gap = points.pixels[b] - points.pixels[a]
        for k in (a, b):
            across = abs(gap @ points.normals[k])
            is_other = OTHER_EDGE < across < CLEARANCE and abs(gap @ along[k]) <= MAX_ALONG
            is_near[k] |= is_other
    return is_near


def spread(cells, marked):
    """Marked points and those within `SPREAD` pixels of one."""
    if not marked.any():
        return marked
    gap, _ = KDTree(cells[marked]).query(cells, p=np.inf)
    return gap <= SPREAD


def polygons(seed):
    """A grey picture of some blurred polygons, near each other in places."""
    rng = np.random.default_rng(seed)
    picture = np.full((240, 320), 90.0, dtype=np.float32)
    for _ in range(12):
        corners = rng.uniform([0, 0], [320, 240], (1, 2)) + rng.uniform(-50, 50, (4, 2))
        cv2.fillConvexPoly(picture, cv2.convexHull(corners.astype(np.int32)), rng.uniform(20, 230))
    return cv2.GaussianBlur(picture, (0, 0), BLUR).astype(float)


@pytest.mark.parametrize("seed", range(3))
def test_lone_edges_are_found_as_by_all_pairs(seed):
    points = find_edge_points(Gradient.of(polygons(seed)))
    expected = ~spread(points.cells, next_to_another(points))
    assert 0.2 < expected.mean() < 0.98
    # Pixels that hold two points are seen once.
    assert (lone_points(points) == expected).mean() > 0.995


def two_steps(distance, ratio):
    """A picture of a vertical step at u = 40 and of another one `distance` px away from it."""
    u = np.arange(100.0)
    sigma = np.sqrt(2.0) * BLUR
    profile = 50.0 * erf((u - 40.0) / sigma) + 50.0 * ratio * erf((u - 40.0 - distance) / sigma)
    return np.tile(120.0 + profile, (60, 1))


@pytest.mark.parametrize("distance", [3.5, 4.0, 4.5])
@pytest.mark.parametrize("ratio", [-0.8, 0.6])
def test_another_edge_displaces_a_point_as_the_formula_says(distance, ratio):
    points = find_edge_points(Gradient.of(two_steps(distance, ratio)))
    first = np.abs(points.pixels[:, 0] - 40.0) < 1.5
    s2 = SMOOTHING**2 + BLUR**2
    expected = ratio * 0.5 * s2 * np.exp(-0.5 * distance * (distance - 2.0) / s2)
    moved = float((points.pixels[first, 0] - 40.0).mean())
    assert moved == pytest.approx(expected, rel=0.15)
    assert not lone_points(points).any()


@pytest.mark.parametrize("distance", [5.5, 9.0])
def test_edges_that_are_far_apart_are_lone_and_stay_where_they_are(distance):
    points = find_edge_points(Gradient.of(two_steps(distance, 0.8)))
    first = np.abs(points.pixels[:, 0] - 40.0) < 1.5
    assert abs(float((points.pixels[first, 0] - 40.0).mean())) < 2e-3
    assert lone_points(points).all()


def test_points_where_two_edges_run_into_each_other_are_not_lone():
    """The border of a shadow that leaves an edge at a small angle, and a lone edge far away."""
    picture = np.full((120, 300), 200.0, dtype=np.float32)
    picture[60:] = 120.0
    shadow = np.array([[20, 60], [280, 60], [280, 80]], dtype=np.int32)
    cv2.fillConvexPoly(picture, shadow, 40.0)
    points = find_edge_points(Gradient.of(cv2.GaussianBlur(picture, (0, 0), BLUR).astype(float)))
    u, v = points.pixels.T
    at_the_edge = np.abs(v - 59.5) < 1.0
    # The shadow's border is 1 + (u - 20) / 13 below the edge, its last row being drawn in full.
    near, far = (u > 40) & (u < 65), (u > 110) & (u < 260)
    lone = lone_points(points)
    assert not lone[at_the_edge & near].any()
    assert lone[at_the_edge & far].all()


def test_no_points_are_no_error():
    none = np.zeros((0, 2))
    points = EdgePoints(none, none, np.zeros(0), none.astype(int))
    assert lone_points(points).shape == (0,)
