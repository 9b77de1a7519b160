"""Grids of tags as OpenCV and Kalibr print them, rendered with known corners."""

import numpy as np
import pytest
from drawn_boards import seen_in_perspective, tag_print

from smartview_jax.detection import detect
from smartview_jax.simulation.patterns import printed_pattern
from smartview_jax.targets import AprilGrid, TagGrid

KALIBR_CODES = (0xD5D628584, 0xD97F18B49, 0xDD280910E, 0xE479E9C98, 0xEBCBCA822, 0xF31DAB3AC)
"""Codes of the first tags of the family t36h11 in `kalibr_create_target_pdf`.

It draws bit 35 at the top left and then row by row, white where a bit is set.
"""

KALIBR = AprilGrid(6, 6, 0.03, 0.3)


def kalibrs_board(rows=6, columns=6):
    """Kalibr's board and the corners in the order of `AprilGrid`."""
    board, corners = tag_print(rows, columns, 100, 30, 2, True, True, True)
    return board, corners.reshape(-1, 2)


@pytest.mark.parametrize(("size", "least"), [((640, 480), 110), ((1280, 960), 144)])
@pytest.mark.parametrize("seed", range(3))
def test_a_board_of_kalibr_is_found_where_it_is(size, least, seed):
    picture, truth = seen_in_perspective(*kalibrs_board(), size=size, seed=seed)
    detection = detect(picture, KALIBR)
    assert detection.visible.sum() >= least
    errors = np.linalg.norm(detection.pixels - truth, axis=1)[detection.visible]
    assert errors.max() < 0.2


def test_kalibrs_own_codes_give_the_same_board():
    """Drawn bit by bit, with nothing of OpenCV: turned by half a turn against its drawings."""
    cell, side, gap, around = 10, 100, 30, 200
    board = np.full((2 * 130 - 30 + 2 * around, 3 * 130 - 30 + 2 * around), 235, dtype=np.uint8)
    for tag, code in enumerate(KALIBR_CODES):
        x = around + tag % 3 * (side + gap)
        y = around + (1 - tag // 3) * (side + gap)
        board[y : y + side, x : x + side] = 20
        for bit in range(36):
            r, c = divmod(bit, 6)
            if code >> (35 - bit) & 1:
                top, left = y + (2 + r) * cell, x + (2 + c) * cell
                board[top : top + cell, left : left + cell] = 235
        for dx in (-gap, side):
            for dy in (-gap, side):
                board[y + dy : y + dy + gap, x + dx : x + dx + gap] = 20
    np.testing.assert_array_equal(board, kalibrs_board(2, 3)[0])


def test_points_are_where_kalibr_has_them():
    """Its frame begins at the bottom left corner of tag 0, and a pitch is 1 + 0.3 sides."""
    points = AprilGrid(2, 2, 0.1, 0.3).points
    expected = [[0, 0], [0.1, 0], [0.1, 0.1], [0, 0.1]]
    np.testing.assert_allclose(points[:4, :2], expected, atol=1e-12)
    np.testing.assert_allclose(points[4:8, :2] - points[:4, :2], 4 * [[0.13, 0]], atol=1e-12)
    np.testing.assert_allclose(points[8:12, :2] - points[:4, :2], 4 * [[0, 0.13]], atol=1e-12)
    with pytest.raises(ValueError, match="spacing: expected the gap"):
        AprilGrid(6, 6, 0.088, 26.4)


@pytest.mark.parametrize("seed", range(2))
def test_another_border_than_the_stated_one_is_named(seed):
    """A border of two cells read as one puts every corner a cell off."""
    picture, _ = seen_in_perspective(*kalibrs_board(), size=(1280, 960), seed=seed)
    narrow = detect(picture, TagGrid(6, 6, 0.03, 0.009))
    assert not narrow.visible.any()
    assert "border" in narrow.reason
    board, corners = tag_print(4, 5, 80, 40, 1)
    picture, _ = seen_in_perspective(board, corners.reshape(-1, 2), size=(1280, 960), seed=seed)
    wide = detect(picture, TagGrid(4, 5, 0.04, 0.02, border_bits=2))
    assert "state border_bits: 1" in wide.reason


@pytest.mark.parametrize("rows_from", ["top", "bottom"])
@pytest.mark.parametrize("border_bits", [1, 2])
def test_a_grid_of_tags_has_its_order_and_border(rows_from, border_bits):
    board, corners = tag_print(3, 4, 80, 40, border_bits, from_bottom=rows_from == "bottom")
    # OpenCV counts the corners of a tag from its top left, clockwise.
    corners = corners[:, [3, 2, 1, 0]].reshape(-1, 2)
    picture, truth = seen_in_perspective(board, corners, size=(1280, 960))
    target = TagGrid(3, 4, 0.04, 0.02, border_bits=border_bits, rows_from=rows_from)
    detection = detect(picture, target)
    assert detection.visible.all()
    np.testing.assert_allclose(detection.pixels, truth, atol=0.6)
    other = TagGrid(
        3, 4, 0.04, 0.02, border_bits=border_bits, rows_from={"top": "bottom"}.get(rows_from, "top")
    )
    assert "the points found do not match this target" in detect(picture, other).reason


def test_tags_that_are_turned_by_half_a_turn_are_named():
    """A board of Kalibr's described as another, and the other way round."""
    picture, _ = seen_in_perspective(*kalibrs_board(3, 4), size=(1280, 960))
    other = TagGrid(3, 4, 0.03, 0.009, border_bits=2, rows_from="bottom")
    assert "state kind: aprilgrid for a board of Kalibr's" in detect(picture, other).reason
    board, corners = tag_print(3, 4, 100, 30, 2, False, True, True)
    picture, _ = seen_in_perspective(board, corners.reshape(-1, 2), size=(1280, 960))
    assert "tag_grid for others" in detect(picture, AprilGrid(3, 4, 0.03, 0.3)).reason
    assert detect(picture, other).visible.sum() > 40


def test_a_corner_that_cannot_be_refined_is_not_visible():
    """Without a gradient around it, a corner stays where the contour put it."""
    board, corners = tag_print(2, 2, 100, 50, 1)
    picture = board.copy()
    # A black smear over the lower right corner of tag 0 and what is around it.
    x, y = np.rint(corners[0, 1]).astype(int)
    target = TagGrid(2, 2, 0.04, 0.02)
    assert detect(picture, target).visible.all()
    picture[y - 3 : y + 14, x - 3 : x + 14] = 20
    detection = detect(picture, target)
    assert not detection.visible[2]
    assert detection.visible.sum() >= 12


def test_a_drawing_of_an_aprilgrid_is_kalibrs():
    """What the simulation prints is what was drawn here."""
    board, _ = kalibrs_board(2, 3)
    target = AprilGrid(2, 3, 0.1, 0.3)
    y, x = np.mgrid[0 : board.shape[0], 0 : board.shape[1]]
    # One pixel of the drawing is a millimetre; the origin is the bottom left corner of tag 0.
    left, bottom = 200, board.shape[0] - 200
    dark = printed_pattern(target)(
        1e-3 * (x + 0.5 - left).ravel(), 1e-3 * (bottom - y - 0.5).ravel()
    )
    np.testing.assert_array_equal(dark.reshape(board.shape), board < 128)


def test_a_tag_that_is_there_twice_is_not_taken():
    board, corners = tag_print(2, 2, 100, 50, 1)
    tag_from_left = round(corners[0, 1, 0]) + 25
    twice = np.hstack([board, board[:, :tag_from_left]])
    detection = detect(twice, TagGrid(2, 2, 0.04, 0.02))
    # The tags 0 and 2 are in the left column, and in the picture twice.
    assert detection.visible.tolist() == [False] * 4 + [True] * 4 + [False] * 4 + [True] * 4
