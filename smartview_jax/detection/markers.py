"""Detect boards with numbered markers: ChArUco boards and grids of AprilTag or ArUco tags.

A view may show only a part of the board.
"""

import cv2
import numpy as np

from ..targets import Charuco, TagGrid
from .detection import Detection, empty_detection, partial_detection


def dictionary_by_name(name: str) -> cv2.aruco.Dictionary:
    """Return one of OpenCV's marker dictionaries.

    Args:
        name: OpenCV's name for it, which targets have already checked.
    """
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def charuco_board(target: Charuco) -> cv2.aruco.CharucoBoard:
    """Return OpenCV's description of a ChArUco board."""
    board = cv2.aruco.CharucoBoard(
        (target.squares_x, target.squares_y),
        target.square,
        target.marker,
        dictionary_by_name(target.dictionary),
    )
    board.setLegacyPattern(target.legacy)
    return board


def detect_charuco(image: np.ndarray, target: Charuco) -> Detection:
    """Detect the inner corners of a ChArUco board that are between recognised markers.

    Args:
        image: grey, uint8.
        target: the board.
    """
    count = (target.squares_x - 1) * (target.squares_y - 1)
    detector = cv2.aruco.CharucoDetector(charuco_board(target))
    corners, ids, _, marker_ids = detector.detectBoard(image)
    if ids is None or len(ids) == 0:
        marker_count = 0 if marker_ids is None else len(marker_ids)
        hint = ": try the legacy pattern" if marker_count and not target.legacy else ""
        return empty_detection(
            count,
            f"no ChArUco corner found ({marker_count} markers of {target.dictionary} seen){hint}",
        )
    return partial_detection(count, ids.ravel(), corners)


def detect_tags(image: np.ndarray, target: TagGrid) -> Detection:
    """Detect the four corners of every visible tag of a grid, with sub-pixel refinement.

    Args:
        image: grey, uint8.
        target: the grid.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(dictionary_by_name(target.dictionary), parameters)
    corners, ids, _ = detector.detectMarkers(image)
    count = 4 * len(target.ids)
    detected_ids = [] if ids is None else [int(k) for k in ids.ravel()]
    matching = [k for k, tag in enumerate(detected_ids) if tag in target.ids]
    if not matching:
        others = f"; tags {sorted(detected_ids)} seen" if detected_ids else ""
        return empty_detection(
            count,
            f"no tag {target.ids[0]} to {target.ids[-1]} of {target.dictionary} found{others}",
        )
    # Corner k of the tag with number n is point 4 (n - first_id) + k of the target.
    index = np.concatenate(
        [4 * (detected_ids[k] - target.first_id) + np.arange(4) for k in matching]
    )
    return partial_detection(
        count, index, np.concatenate([corners[k].reshape(4, 2) for k in matching])
    )
