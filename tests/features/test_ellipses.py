import numpy as np

from smartview_jax.features import find_ellipses


def points_on(middle, half, turn, angles):
    """Points of an ellipse, and its outward unit normals."""
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s], [s, c]])
    unit = np.column_stack([np.cos(angles), np.sin(angles)])
    normals = unit / half
    return middle + unit * half @ R.T, (
        normals / np.linalg.norm(normals, axis=1, keepdims=True)
    ) @ R.T


def conic_of(middle, half, turn):
    to_unit = np.eye(3)
    c, s = np.cos(turn), np.sin(turn)
    to_unit[:2, :2] = np.diag(1.0 / np.asarray(half)) @ [[c, s], [-s, c]]
    to_unit[:2, 2] = -to_unit[:2, :2] @ middle
    return to_unit.T @ np.diag([1.0, 1.0, -1.0]) @ to_unit


def scaled(conic):
    return conic / np.cbrt(-np.linalg.det(conic))


def test_an_ellipse_is_found_where_straight_sides_continue_it():
    """As in a picture of a pipe: half a rim with both sides of the tube, and clutter."""
    rng = np.random.default_rng(0)
    middle, half, turn = np.array([30.0, -20.0]), np.array([60.0, 25.0]), 0.3
    # From 0 to pi, and straight on in the direction of the tangents there.
    rim, normals = points_on(middle, half, turn, np.linspace(-0.4, np.pi + 0.4, 180))
    ends, sides = points_on(middle, half, turn, np.array([-0.4, np.pi + 0.4]))
    ways = np.array([[sides[0, 1], -sides[0, 0]], [-sides[1, 1], sides[1, 0]]])
    t = np.arange(1.0, 120.0)[:, None]
    tubes = np.concatenate([end + t * way for end, way in zip(ends, ways, strict=True)])
    tube_normals = np.repeat(sides, len(t), axis=0)
    clutter = rng.uniform(-200.0, 200.0, (400, 2))
    turns = rng.uniform(0.0, 2.0 * np.pi, 400)
    points = np.concatenate([rim, tubes, clutter])
    points += 0.05 * rng.standard_normal(points.shape)
    clutter_normals = np.column_stack([np.cos(turns), np.sin(turns)])
    ellipses = find_ellipses(points, np.concatenate([normals, tube_normals, clutter_normals]))
    assert len(ellipses) == 1
    truth = scaled(conic_of(middle, half, turn))
    centre = -np.linalg.solve(ellipses[0][:2, :2], ellipses[0][:2, 2])
    np.testing.assert_allclose(centre, middle, atol=0.5)
    values = [np.sort(np.linalg.eigvalsh(scaled(q)[:2, :2])) for q in (ellipses[0], truth)]
    np.testing.assert_allclose(values[0], values[1], rtol=0.03)


def test_straight_edges_are_no_ellipses():
    t = np.linspace(0.0, 200.0, 200)
    square = np.concatenate([np.column_stack([t, 0.0 * t]), np.column_stack([0.0 * t, t])])
    normals = np.repeat([[0.0, 1.0], [1.0, 0.0]], 200, axis=0)
    assert not len(find_ellipses(square, normals))
    assert not len(find_ellipses(np.zeros((0, 2)), np.zeros((0, 2))))
