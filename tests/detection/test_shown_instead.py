import dataclasses
import re

import cv2
import numpy as np
import pytest

from smartview_jax.detection import charuco_board, detect, dictionary_by_name, shown_instead
from smartview_jax.targets import Charuco, Chessboard, CircleGrid, TagGrid

BOARD = Charuco(8, 6, 0.03, 0.022)
TAGS = TagGrid(3, 4, 0.03, gap=0.009)


def seen_from_the_side(board):
    """A picture of a drawn board on a grey wall, with perspective."""
    rows, columns = board.shape
    corners = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]], dtype=np.float32)
    seen = np.array([[70, 60], [585, 95], [560, 420], [90, 435]], dtype=np.float32)
    H = cv2.getPerspectiveTransform(corners, seen)
    picture = cv2.warpPerspective(
        board, H, (640, 480), flags=cv2.INTER_AREA, borderMode=cv2.BORDER_CONSTANT, borderValue=128
    )
    return cv2.GaussianBlur(picture, (0, 0), 0.6)


def picture_of_charuco(target):
    size = (60 * target.squares_x + 40, 60 * target.squares_y + 40)
    return seen_from_the_side(charuco_board(target).generateImage(size, marginSize=20))


def picture_of_tags(target):
    pixels = {name: round(2000 * getattr(target, name)) for name in ("size", "gap")}
    board = cv2.aruco.GridBoard(
        (target.columns, target.rows),
        target.size,
        target.gap,
        dictionary_by_name(target.dictionary),
        np.array(target.ids),
    )
    pitch = pixels["size"] + pixels["gap"]
    size = tuple(count * pitch - pixels["gap"] + 40 for count in (target.columns, target.rows))
    return seen_from_the_side(board.generateImage(size, marginSize=20))


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ({"legacy": True}, r"state legacy: false$"),
        ({"dictionary": "DICT_5X5_250"}, r"state dictionary: DICT_4X4_50, not DICT_5X5_250$"),
        ({"squares_x": 6, "squares_y": 8}, r"exchanged: state squares_x: 8, squares_y: 6$"),
        ({"squares_x": 7, "squares_y": 5}, r"corners were counted.* squares_x: 8, squares_y: 6$"),
        (
            {"squares_x": 6, "squares_y": 8, "dictionary": "DICT_6X6_250"},
            r"state dictionary: DICT_4X4_50.*exchanged: state squares_x: 8, squares_y: 6$",
        ),
    ],
)
def test_a_charuco_board_that_is_stated_wrongly_is_named(stated, words):
    target, picture = dataclasses.replace(BOARD, **stated), picture_of_charuco(BOARD)
    assert detect(picture, target).reason is not None
    assert re.search(words, shown_instead([picture], target))


@pytest.mark.parametrize("target", [BOARD, TAGS])
def test_mirrored_markers_are_named(target):
    drawn = picture_of_charuco(target) if isinstance(target, Charuco) else picture_of_tags(target)
    mirrored = np.ascontiguousarray(drawn[:, ::-1])
    assert detect(mirrored, target).reason is not None
    assert "mirrored" in shown_instead([mirrored], target)


def test_squares_stated_for_the_corners_of_a_chessboard_are_named():
    squares = np.indices((7, 10)).sum(axis=0) % 2 * 255
    board = np.kron(squares, np.ones((40, 40))).astype(np.uint8)
    board = cv2.copyMakeBorder(board, *4 * (40,), cv2.BORDER_CONSTANT, value=255)
    text = shown_instead([seen_from_the_side(board)], Chessboard(7, 10, 0.025))
    assert text.endswith("state rows: 6, columns: 9")


@pytest.mark.parametrize("mirrored", [False, True])
def test_circles_whose_mark_is_in_another_corner_are_named(mirrored):
    """From the mark a mirrored grid goes on as one whose rows and columns were exchanged."""
    shown = CircleGrid(5, 7, 0.02, origin_mark=True)
    board = np.full((480, 640), 255, dtype=np.uint8)
    for k, (x, y) in enumerate(60 + 60 * shown.points[:, :2] / shown.spacing):
        cv2.circle(board, (int(x), int(y)), 21 if k == 0 else 15, 0, -1, cv2.LINE_AA)
    picture = board[:, ::-1].copy() if mirrored else board
    exchanged = dataclasses.replace(shown, rows=7, columns=5)
    right, wrong = (exchanged, shown) if mirrored else (shown, exchanged)
    assert detect(picture, right).visible.all()
    assert "rows and columns were exchanged, or the picture is" in detect(picture, wrong).reason
    assert f"state rows: {right.rows}, columns: {right.columns}" in shown_instead([picture], wrong)


def test_exchanged_rows_and_other_gaps_of_tags_are_named():
    picture = picture_of_tags(TAGS)
    exchanged = dataclasses.replace(TAGS, rows=4, columns=3)
    assert "state rows: 3, columns: 4" in shown_instead([picture], exchanged)
    # The side was measured with its white border, half a gap wide on each side.
    bordered = dataclasses.replace(TAGS, size=0.037, gap=0.002)
    text = shown_instead([picture], bordered)
    assert "0.05 is stated" in text
    seen = float(text.split("neighbouring tags is ")[1].split()[0])
    assert seen == pytest.approx(0.009 / 0.030, abs=0.02)


def test_nothing_is_named_in_pictures_of_something_else():
    noise = np.random.default_rng(0).normal(128.0, 40.0, (480, 640))
    wall = cv2.GaussianBlur(noise, (0, 0), 3.0).clip(0, 255).astype(np.uint8)
    for target in (BOARD, TAGS, Chessboard(6, 9, 0.025)):
        assert shown_instead([wall], target) == ""
