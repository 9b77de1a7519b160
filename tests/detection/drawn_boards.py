"""Pictures of printed boards seen in perspective, with the pixels where their points are."""

import cv2
import numpy as np

OVERSAMPLING = 4


def chessboard_print(rows, columns, margin, ground, square=40):
    """A flat print of a board with that many inner corners, its white margin on a ground.

    Returns:
        The print, grey values, and the corners in it, row by row; centres of pixels are whole.
    """
    dark = np.add.outer(np.arange(rows + 1), np.arange(columns + 1)) % 2 == 0
    board = np.kron(np.where(dark, 20, 235), np.ones((square, square))).astype(np.uint8)
    white, around = round(margin * square), 3 * square
    board = cv2.copyMakeBorder(board, *[white] * 4, cv2.BORDER_CONSTANT, value=235)
    board = cv2.copyMakeBorder(board, *[around] * 4, cv2.BORDER_CONSTANT, value=ground)
    i, j = np.mgrid[1 : rows + 1, 1 : columns + 1]
    corners = np.stack([j, i], axis=-1).reshape(-1, 2) * square + white + around - 0.5
    return board, corners


def seen_in_perspective(board, points, size=(640, 480), seed=0, tilt=0.15, noise=2.0):
    """A picture of a print from one side, with blur and noise, and where its points are in it."""
    rng = np.random.default_rng(seed)
    height, width = board.shape
    outline = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=float) - 0.5
    filling = 0.95 * min(size[0] / width, size[1] / height)
    middle = 0.5 * np.array(size)
    seen = middle + (outline - outline.mean(axis=0)) * filling
    seen += rng.uniform(-tilt, tilt, (4, 2)) * filling * min(height, width)
    # The picture is drawn larger and averaged. Its pixel p has the middle (p - 1.5) / 4.
    H = cv2.getPerspectiveTransform(outline.astype(np.float32), seen.astype(np.float32))
    finer = np.array([[OVERSAMPLING, 0, 1.5], [0, OVERSAMPLING, 1.5], [0, 0, 1]]) @ H
    large = cv2.warpPerspective(
        board,
        finer,
        (OVERSAMPLING * size[0], OVERSAMPLING * size[1]),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    picture = cv2.resize(large, size, interpolation=cv2.INTER_AREA)
    picture = cv2.GaussianBlur(picture, (0, 0), 0.7) + rng.normal(0.0, noise, size[::-1])
    pixels = cv2.perspectiveTransform(points[None].astype(float), H)[0]
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8), pixels


def tag_print(
    rows, columns, side, gap, border_bits, turned=False, from_bottom=False, squares=False
):
    """A flat print of AprilTags, and the corners of each tag: from its bottom left, anticlockwise.

    Args:
        rows, columns: number of tags down and across.
        side, gap: of a tag and between two, px.
        border_bits: width of the black border in cells.
        turned: whether each tag is turned by half a turn against OpenCV's drawing.
        from_bottom: whether the numbers begin in the bottom row.
        squares: whether black squares fill the crossings of the gaps.

    Returns:
        The print, and `(tags, 4, 2)` corners in the order of the tags' numbers.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    pitch, around = side + gap, 2 * side
    size = rows * pitch - gap, columns * pitch - gap
    board = np.full((size[0] + 2 * around, size[1] + 2 * around), 235, dtype=np.uint8)
    corners = []
    for tag in range(rows * columns):
        i, j = divmod(tag, columns)
        y, x = around + (rows - 1 - i if from_bottom else i) * pitch, around + j * pitch
        marker = cv2.aruco.generateImageMarker(dictionary, tag, side, borderBits=border_bits)
        board[y : y + side, x : x + side] = np.clip(
            marker[::-1, ::-1] if turned else marker, 20, 235
        )
        corners.append([[x, y + side], [x + side, y + side], [x + side, y], [x, y]])
        for dx in (-gap, side) if squares else ():
            for dy in (-gap, side):
                board[y + dy : y + dy + gap, x + dx : x + dx + gap] = 20
    return board, np.array(corners) - 0.5
