"""What is detected is tested against the target: rendered truth, and lenses of all kinds."""

import cv2
import numpy as np
import pytest
from drawn_boards import chessboard_print, seen_in_perspective

from smartview_jax.detection import DetectionLimits, check_points, checked_pixels, detect
from smartview_jax.targets import Chessboard, CircleGrid

SIZE = (1280, 1024)
GRID = CircleGrid(7, 10, 0.04)


def through_a_fisheye(seed, points=GRID.points, focal=300.0):
    """Pixels of an equidistant lens (r = f angle) near the board: points beyond 90 degrees too."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    # The board's middle lies 60 to 80 degrees off the lens's axis, 16 cm away.
    angle, around = rng.uniform(1.0, 1.4), rng.uniform(0.0, 2.0 * np.pi)
    middle = 0.16 * np.array(
        [np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)]
    )
    facing = cv2.Rodrigues(angle * np.array([-np.sin(around), np.cos(around), 0.0]))[0]
    seen = (points - points.mean(axis=0)) @ (facing @ cv2.Rodrigues(0.2 * axis)[0]).T + middle
    angles = np.arctan2(np.linalg.norm(seen[:, :2], axis=1), seen[:, 2])
    direction = seen[:, :2] / np.linalg.norm(seen[:, :2], axis=1, keepdims=True)
    pixels = 0.5 * np.array(SIZE) + [9.0, -7.0] + focal * angles[:, None] * direction
    return pixels + rng.normal(0.0, 0.1, pixels.shape), angles


def pinhole(seed, points, noise=0.1):
    rng = np.random.default_rng(seed)
    outline = np.array([[400, 250], [900, 300], [850, 760], [420, 700]], dtype=float)
    corners = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    (left, top), (right, bottom) = corners
    flat = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
    outline += rng.uniform(-60.0, 60.0, outline.shape)
    H = cv2.getPerspectiveTransform(flat.astype(np.float32), outline.astype(np.float32))
    pixels = cv2.perspectiveTransform(points[None, :, :2], H)[0]
    return pixels + rng.normal(0.0, noise, pixels.shape)


@pytest.mark.parametrize("margin", [0.2, 0.35, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_chessboard_with_a_narrow_margin_is_found_where_it_is(margin, seed):
    """Three by four corners on a dark ground: OpenCV's first detector is 40 to 90 px off."""
    board, corners = chessboard_print(3, 4, margin, ground=20)
    picture, truth = seen_in_perspective(board, corners, seed=seed)
    target = Chessboard(3, 4, 0.03)
    detection = detect(picture, target)
    assert detection.visible.all()
    # The print's first square is dark, so that the order begins at its other end.
    np.testing.assert_allclose(detection.pixels, truth[::-1], atol=0.15)


def test_a_board_that_only_the_classic_detector_finds():
    board, corners = chessboard_print(6, 9, 0.2, ground=20)
    picture, truth = seen_in_perspective(board, corners)
    detection = detect(picture, Chessboard(6, 9, 0.03))
    np.testing.assert_allclose(detection.pixels, truth[::-1], atol=0.15)


@pytest.mark.parametrize(("rows", "columns"), [(6, 10), (5, 9), (5, 6), (4, 4), (3, 3)])
def test_another_number_of_corners_is_not_found(rows, columns):
    board, corners = chessboard_print(6, 9, 1.0, ground=128)
    picture, _ = seen_in_perspective(board, corners, seed=1)
    detection = detect(picture, Chessboard(rows, columns, 0.03))
    assert not detection.visible.any()
    assert detection.reason


@pytest.mark.parametrize(
    ("whole", "part"),
    [((6, 8), (5, 6)), ((6, 8), (3, 3)), ((6, 8), (6, 7)), ((9, 4), (8, 4)), ((9, 4), (7, 3))],
)
def test_a_part_of_a_grid_of_circles_is_not_taken_for_a_smaller_one(whole, part):
    asymmetric = whole == (9, 4)
    grid = CircleGrid(*whole, 0.02, asymmetric=asymmetric)
    centres = 60.0 + 30.0 * grid.points[:, :2] / grid.spacing
    picture = np.full(np.ceil(centres.max(axis=0) + 60).astype(int)[::-1], 255, dtype=np.uint8)
    for x, y in centres:
        cv2.circle(picture, (round(x), round(y)), 9, 0, -1, cv2.LINE_AA)
    assert detect(picture, grid).visible.all()
    assert not detect(picture, CircleGrid(*part, 0.02, asymmetric=asymmetric)).visible.any()


@pytest.mark.parametrize("seed", range(4))
def test_a_fisheye_picture_is_a_good_detection(seed):
    pixels, angles = through_a_fisheye(seed)
    test = check_points(GRID.points, pixels, SIZE)
    assert np.rad2deg(angles.max()) > 85.0
    assert test.reason is None
    assert test.passed.all()
    # Where the linear solution is good enough, it leaves more than the noise that was added.
    assert test.noise < 0.5


@pytest.mark.parametrize("kind", [pinhole, lambda seed, points: through_a_fisheye(seed)[0]])
def test_single_wrong_points_are_told_from_the_others(kind):
    pixels = kind(0, GRID.points)
    wrong = [3, 27, 64]
    pixels[wrong] += [[9.0, 0.0], [0.0, -14.0], [35.0, 20.0]]
    test = check_points(GRID.points, pixels, SIZE)
    assert test.reason is None
    assert np.flatnonzero(~test.passed).tolist() == wrong


def test_a_bent_board_is_judged_by_neighbours():
    """No camera sees a flat board like this, but every point lies where its neighbours say."""
    points = CircleGrid(14, 16, 0.02).points
    pixels = pinhole(0, points)
    pixels += 12.0 * np.sin((pixels[:, :1] - 400.0) / 90.0)
    assert check_points(points, pixels, SIZE).reason is None
    pixels[40] += 25.0
    test = check_points(points, pixels, SIZE)
    assert not test.passed[40]
    # A wrong point also spoils what its nearest neighbours are compared with.
    assert test.passed.mean() > 0.85


@pytest.mark.parametrize("rows", [3, 4, 7])
@pytest.mark.parametrize("columns", [5, 12])
def test_an_outer_row_that_was_taken_from_the_outline_is_not_believed(rows, columns):
    points = CircleGrid(rows, columns, 0.04).points
    pixels = pinhole(1, points).reshape(rows, columns, 2)
    pixels[0] += 0.45 * (pixels[1] - pixels[0])
    test = check_points(points, pixels.reshape(-1, 2), SIZE)
    assert test.reason is not None or not test.passed.reshape(rows, columns)[0].any()


def test_noise_that_no_subpixel_detector_has_is_refused():
    points = CircleGrid(7, 10, 0.04).points
    assert check_points(points, pinhole(0, points, noise=0.5), SIZE).reason is None
    assert "up to" in check_points(points, pinhole(0, points, noise=3.0), SIZE).reason
    lenient = DetectionLimits(largest_noise=5.0)
    assert check_points(points, pinhole(0, points, noise=3.0), SIZE, lenient).reason is None
    with pytest.raises(ValueError, match="noise: expected a positive number"):
        DetectionLimits(noise=0.0)


def test_a_board_at_several_heights_is_no_plane():
    """Its points are tested together, as they were seen by one camera."""
    board = CircleGrid(4, 5, 0.02).points
    points = np.concatenate([board, board + np.array([0.0, 0.0, 0.03])])
    seen = points - points.mean(axis=0) + [0.0, 0.0, 0.4]
    pixels = 0.5 * np.array(SIZE) + 1500.0 * seen[:, :2] / seen[:, 2:]
    assert check_points(points, pixels, SIZE).passed.all()
    pixels[7] += 20.0
    assert np.flatnonzero(~check_points(points, pixels, SIZE).passed).tolist() == [7]


def test_few_points_are_not_judged():
    for points in (np.zeros((1, 3)), GRID.points[:4], GRID.points[:8]):
        pixels = 100.0 + 30.0 * points[:, :2] / 0.04
        assert check_points(points, pixels, SIZE).passed.all()


def test_points_on_top_of_each_other_are_no_detection():
    assert "px apart" in check_points(GRID.points, np.full((70, 2), 7.0), SIZE).reason
    shrunk = 100.0 + 0.01 * pinhole(0, GRID.points)
    assert check_points(GRID.points, shrunk, SIZE).reason is not None


def test_imported_views_are_tested_one_by_one():
    target = Chessboard(5, 8, 0.03)
    pixels = np.stack([pinhole(seed, target.points) for seed in range(3)])
    pixels[0, 11] += 30.0
    # The rows of this view were written in another order.
    pixels[1] = pixels[1].reshape(5, 8, 2).swapaxes(0, 1).reshape(-1, 2)
    tested, failed, notes = checked_pixels(target.points, pixels, ["a", "b", "c"], SIZE)
    assert list(failed) == ["b"]
    assert np.isnan(tested[1]).all()
    assert np.flatnonzero(np.isnan(tested[0, :, 0])).tolist() == [11]
    np.testing.assert_array_equal(tested[2], pixels[2])
    assert notes[0].endswith("other points: 1 (views a)")
