import numpy as np
import pytest

from smartview_jax.targets import (
    Charuco,
    Chessboard,
    CircleGrid,
    ListedPoints,
    StackedTarget,
    TagGrid,
    target_from_dict,
    target_to_dict,
)

TARGETS = [
    ListedPoints(((0.0, 0.0, 0.0), (0.1, 0.02, 0.0), (0.0, 0.07, 0.0))),
    CircleGrid(4, 5, 0.02),
    CircleGrid(4, 4, 0.02),
    CircleGrid(4, 4, 0.02, origin_mark=True),
    CircleGrid(5, 4, 0.01, asymmetric=True, light_on_dark=True),
    CircleGrid(4, 11, 0.01, asymmetric=True),
    Chessboard(6, 9, 0.025),
    Charuco(5, 7, 0.024, 0.018, legacy=True),
    TagGrid(2, 3, 0.04, 0.01, first_id=5),
    StackedTarget(CircleGrid(3, 3, 0.01), (0.0, 0.005)),
    CircleGrid(4, 5, 0.02, origin_mark=True, radius=0.004, mark_radius=0.006),
]


@pytest.mark.parametrize("target", TARGETS, ids=repr)
def test_symmetries_are_motions_of_the_points(target):
    """Every order maps distances to themselves, and turns the plane without mirroring it."""
    points = target.points
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
    np.testing.assert_array_equal(target.symmetries[0], np.arange(len(points)))
    for order in target.symmetries:
        assert sorted(order) == list(range(len(points)))
        np.testing.assert_allclose(distances[order][:, order], distances, atol=1e-12)
        a, b = (p - p.mean(axis=0) for p in (points, points[order]))
        flat = (b[:, :2].T @ a[:, :2]) / np.sum(a[:, :2] ** 2)
        assert np.linalg.det(flat) > 0.0


@pytest.mark.parametrize("target", TARGETS, ids=repr)
def test_descriptions_round_trip(target):
    assert target_from_dict(target_to_dict(target)) == target


def test_only_what_a_picture_cannot_tell_is_a_symmetry():
    counts = [len(target.symmetries) for target in TARGETS]
    assert counts == [1, 2, 4, 1, 1, 2, 1, 1, 1, 4, 1]
    # Colours tell the turns of a board with an odd number of squares one way and even the other.
    assert [len(Chessboard(*size, 0.1).symmetries) for size in ((6, 8), (5, 5), (6, 6))] == [
        2,
        2,
        4,
    ]


def test_points_lie_where_they_should():
    np.testing.assert_allclose(CircleGrid(2, 3, 0.1).points[4], [0.1, 0.1, 0.0])
    # OpenCV's asymmetric grid: the second row is shifted by one spacing.
    np.testing.assert_allclose(CircleGrid(3, 2, 0.1, asymmetric=True).points[2], [0.1, 0.1, 0.0])
    np.testing.assert_allclose(Charuco(3, 3, 0.1, 0.05).points[0], [0.1, 0.1, 0.0])
    np.testing.assert_allclose(
        TagGrid(1, 1, 0.048, first_id=10).points,
        0.024 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]),
    )
    assert StackedTarget(Chessboard(2, 2, 0.1), (0.0, 0.3)).points[4:, 2].tolist() == [0.3] * 4


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"kind": "sudoku"}, "target.kind is one of circle_grid, .*found 'sudoku'"),
        ({"kind": "chessboard", "rows": 6, "columns": 9}, "a chessboard needs square"),
        (
            {"kind": "chessboard", "rows": 6, "columns": 9, "square": 0.1, "size": 2},
            "a chessboard has no size",
        ),
        (
            {"kind": "chessboard", "rows": 6, "columns": 9, "square": -1.0},
            "square: expected a positive",
        ),
        ({"kind": "circle_grid", "rows": 1, "columns": 9, "spacing": 0.1}, "rows: .* at least 2"),
        (
            {"kind": "circle_grid", "rows": 2, "columns": 9, "spacing": 0.1, "radius": 0.05},
            "radius: circles 0.1 m apart would touch",
        ),
        (
            {"kind": "circle_grid", "rows": 2, "columns": 9, "spacing": 0.1, "radius": -0.01},
            "radius: expected a positive",
        ),
        (
            {"kind": "circle_grid", "rows": 2, "columns": 9, "spacing": 0.1, "mark_radius": 0.05},
            "mark_radius: this grid has no origin_mark",
        ),
        (
            {"kind": "charuco", "squares_x": 5, "squares_y": 7, "square": 0.1, "marker": 0.2},
            "marker: expected a length below the square",
        ),
        (
            {"kind": "tag_grid", "rows": 1, "columns": 1, "size": 0.1, "dictionary": "DICT_9X9"},
            "dictionary is one of .*found 'DICT_9X9'",
        ),
        (
            {"kind": "tag_grid", "rows": 1, "columns": 1, "size": 0.1, "first_id": 587},
            "has 587 markers, 0 to 586; the target needs marker 587",
        ),
    ],
)
def test_wrong_descriptions_are_named(content, message):
    with pytest.raises(ValueError, match=message):
        target_from_dict(content)
