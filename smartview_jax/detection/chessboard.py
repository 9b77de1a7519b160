"""Chessboard corners, by OpenCV's sector-based detector."""

import cv2
import numpy as np

from ..targets import Chessboard
from .detection import Detection, found, nothing_found


def detect_chessboard(image: np.ndarray, target: Chessboard) -> Detection:
    """Inner corners of a whole board, in the target's order.

    The detector's own sub-pixel answer is kept: a second refinement by `cornerSubPix` moves it by
    up to half a pixel, and normalising the picture first by 0.1 to 0.2 px.
    """
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    size = (target.columns, target.rows)
    ok, corners = cv2.findChessboardCornersSB(image, size, flags=flags)
    if not ok:
        return nothing_found(
            target.rows * target.columns,
            f"no chessboard with {target.rows} x {target.columns} inner corners found",
        )
    return found(corners)
