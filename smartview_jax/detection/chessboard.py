"""Detect chessboard corners with OpenCV's sector-based detector."""

import cv2
import numpy as np
from jaxtyping import Float

from ..targets import Chessboard, grid_symmetries
from .detection import Detection, empty_detection, full_detection


def detect_chessboard(image: np.ndarray, target: Chessboard) -> Detection:
    """Detect the inner corners of a completely visible board, in the target's order.

    Args:
        image: grey, uint8.
        target: the board.
    """
    # The detector's own sub-pixel corners are kept. A second refinement by `cornerSubPix` was tried
    # and shifts them by up to half a pixel; normalising the picture first shifts them by 0.1 to
    # 0.2 px.
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    size = (target.columns, target.rows)
    ok, corners = cv2.findChessboardCornersSB(image, size, flags=flags)
    if not ok:
        return empty_detection(
            target.rows * target.columns,
            f"no chessboard with {target.rows} x {target.columns} inner corners found",
        )
    return full_detection(_start_at_light_square(image, corners.reshape(-1, 2), target))


def _start_at_light_square(
    image: np.ndarray, corners: Float[np.ndarray, "corners 2"], target: Chessboard
) -> Float[np.ndarray, "corners 2"]:
    """Return the corners in the order whose first square is light, if there is such an order."""
    # With the brightness b of each square's middle and s = +1, -1, +1, ... over the squares, the
    # first square is light where sum s (b - mean b) > 0. All squares are compared, so that a single
    # one in shadow does not decide.
    rows, columns = target.rows, target.columns
    sign = (-1.0) ** np.add.outer(np.arange(rows - 1), np.arange(columns - 1))
    for order in grid_symmetries(rows, columns):
        grid = corners[order].reshape(rows, columns, 2)
        centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4.0
        x, y = np.moveaxis(centres.astype(np.float32), -1, 0)
        brightness = cv2.remap(image, x, y, cv2.INTER_LINEAR)
        if np.mean(sign * brightness) > np.mean(sign) * np.mean(brightness):
            return corners[order]
    return corners
