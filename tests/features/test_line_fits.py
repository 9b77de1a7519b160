"""Lines fitted to edge points, many at once, against the singular value decomposition of each."""

import numpy as np
import pytest

from smartview_jax.features.line_fits import (
    MAX_GAP,
    PointGrid,
    directions_of,
    fit_lines,
    total_least_squares,
)


def points_along(start, angle, length, rng, noise=0.05):
    """Edge points a pixel apart, and the normal that all of them have."""
    d = np.array([np.cos(angle), np.sin(angle)])
    n = np.array([-d[1], d[0]])
    along = np.arange(0.0, length)
    across = noise * rng.standard_normal(len(along))
    return start + along[:, None] * d + across[:, None] * n, np.tile(n, (len(along), 1))


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def scene(rng, count=12):
    """Lines that do not meet, with a proposal in the middle of each."""
    angles, starts = rng.uniform(0.0, 2.0 * np.pi, count), 200.0 * np.arange(count)
    parts = [
        points_along(np.array([x, 300.0]), a, 60.0, rng)
        for x, a in zip(starts, angles, strict=True)
    ]
    points, normals = (np.concatenate(part) for part in zip(*parts, strict=True))
    proposals = np.array([[own[20], own[40]] for own, _ in parts])
    return points, normals, proposals


def test_lines_are_those_of_the_singular_value_decomposition(rng):
    points, normals, proposals = scene(rng)
    grid = PointGrid(points, normals)
    fits = fit_lines(grid, proposals)
    assert (np.bincount(fits.members.line) == 60).all()
    means, fitted, variances = total_least_squares(grid, fits.members, fits.lines.normals)
    for k in range(len(proposals)):
        own = points[60 * k : 60 * k + 60]
        _, s, Vt = np.linalg.svd(own - own.mean(axis=0))
        np.testing.assert_allclose(means[k], own.mean(axis=0))
        assert abs(Vt[1] @ fitted[k]) == pytest.approx(1.0)
        # To the light side, where the gradients point.
        assert fitted[k] @ normals[60 * k] > 0.99
        assert variances[k] == pytest.approx(s[1] ** 2 / 58.0)


def test_many_lines_are_those_of_each_alone(rng):
    points, normals, proposals = scene(rng)
    grid = PointGrid(points, normals)
    together = fit_lines(grid, proposals)
    for k in range(len(proposals)):
        alone = fit_lines(grid, proposals[k : k + 1])
        np.testing.assert_allclose(alone.lines.centres[0], together.lines.centres[k])
        np.testing.assert_allclose(alone.lines.normals[0], together.lines.normals[k])
        own = together.members.point[together.members.line == k]
        assert set(alone.members.point) == set(own)


def test_a_line_ends_at_a_gap(rng):
    first, normals = points_along(np.array([50.0, 50.0]), 0.3, 40.0, rng)
    direction = directions_of(normals[:1])[0]
    second = first + (39.0 + MAX_GAP + 1.5) * -direction
    grid = PointGrid(np.concatenate([first, second]), np.tile(normals, (2, 1)))
    fits = fit_lines(grid, np.array([[first[10], first[30]]]))
    assert set(fits.members.point) == set(range(40))


def test_points_near_lines_are_all_found(rng):
    points = rng.uniform(0.0, 80.0, (500, 2))
    grid = PointGrid(points, np.tile([1.0, 0.0], (500, 1)))
    angles, centres = rng.uniform(0.0, 2.0 * np.pi, 20), rng.uniform(20.0, 60.0, (20, 2))
    normals = np.column_stack([np.cos(angles), np.sin(angles)])
    near = grid.near(centres, normals, np.full(20, 25.0), 2.5)
    for k in range(20):
        gaps = points - centres[k]
        inside = (np.abs(gaps @ normals[k]) < 2.5) & (
            np.abs(gaps @ directions_of(normals[k : k + 1])[0]) <= 25.0
        )
        actual = set(near.point[near.line == k])
        assert actual == set(np.flatnonzero(inside))


def test_no_points_or_no_proposals_give_no_lines(rng):
    empty = PointGrid(np.zeros((0, 2)), np.zeros((0, 2)))
    assert not len(fit_lines(empty, np.array([[[0.0, 0.0], [10.0, 0.0]]])).members.line)
    points, normals, _ = scene(rng)
    assert not len(fit_lines(PointGrid(points, normals), np.zeros((0, 2, 2))).lines.centres)
