"""Detect the points of any target in a picture."""

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np

from ..targets import (
    AbstractTarget,
    AprilGrid,
    Charuco,
    Chessboard,
    CircleGrid,
    ListedPoints,
    TagGrid,
)
from .chessboard import detect_chessboard
from .circles import detect_circles
from .detection import Detection
from .markers import detect_charuco, detect_tags
from .plausibility import DetectionLimits, checked_detection

_DETECTORS: tuple[tuple[type[AbstractTarget], Callable[..., Detection]], ...] = (
    (CircleGrid, detect_circles),
    (Charuco, detect_charuco),
    (TagGrid, detect_tags),
    (AprilGrid, detect_tags),
)
"""Detector of each kind of target, except the chessboard, whose detector takes limits."""

_TURNED_TAGS = (
    "with every tag rotated by 180 degrees they would match: state kind: aprilgrid for a board of "
    "Kalibr's and tag_grid for others, with rows_from: bottom if the numbers begin at the bottom"
)
"""Advice if each tag is rotated by 180 degrees, as Kalibr's boards differ from others."""


def detect(
    image: np.ndarray, target: AbstractTarget, limits: DetectionLimits | None = None
) -> Detection:
    """Detect a target's points in a picture, and test their positions against each other.

    If nothing is found, or the points found do not match the target, the result is an empty
    detection with a reason, not an error. Single points that fail the test are not visible.

    Args:
        image: uint8, grey `(h, w)` or BGR `(h, w, 3)`.
        target: a flat target; for a `StackedTarget`, its board.
        limits: limits of the test; by default `DetectionLimits()`.

    Raises:
        ValueError: the array is not a picture, or there is no detector for the target.
    """
    if image.dtype != np.uint8 or image.ndim not in (2, 3):
        raise ValueError(
            f"image: expected uint8 (h, w) or (h, w, 3), found {image.dtype} {image.shape}"
        )
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if isinstance(target, Chessboard):
        return detect_chessboard(grey, target, limits)
    for kind, detector in _DETECTORS:
        if isinstance(target, kind):
            size = (grey.shape[1], grey.shape[0])
            detection = detector(grey, target)
            checked = checked_detection(detection, target.points, size, limits)
            if checked.reason is not None and _has_turned_tags(detection, target, size, limits):
                return checked._replace(reason=f"{checked.reason}; {_TURNED_TAGS}")
            return checked
    if isinstance(target, ListedPoints):
        raise ValueError(
            "listed points are not detected in pictures: give a table of detected points "
            "(detections.csv) instead of the entry 'pictures'"
        )
    raise ValueError(f"there is no detector for a {type(target).__name__}; detect its board")


def _has_turned_tags(
    detection: Detection,
    target: AbstractTarget,
    size: tuple[int, int],
    limits: DetectionLimits | None,
) -> bool:
    """Return whether tags match the target if each tag is rotated by 180 degrees."""
    if not isinstance(target, TagGrid | AprilGrid) or not detection.visible.any():
        return False
    pixels = detection.pixels.reshape(-1, 4, 2)[:, [2, 3, 0, 1]].reshape(-1, 2)
    visible = np.asarray(np.isfinite(pixels).all(axis=1))
    rotated = Detection(pixels, visible, None)
    return checked_detection(rotated, target.points, size, limits).reason is None


def detection_identity(target: AbstractTarget) -> str:
    """Return a text that is equal for targets with equal detections.

    Only ratios of lengths count: a square that was measured more accurately, or other heights of a
    board, change no pixel.
    """
    board = target.flat_board
    fields = {
        field.name: getattr(board, field.name)
        for field in dataclasses.fields(board)
        if field.name not in board.lengths
    }
    # Only the centres of circles are detected, whatever their radii.
    lengths = board.lengths[:1] if isinstance(board, CircleGrid) else board.lengths
    # A missing length, such as the gap of a single tag, counts as 0.
    sizes = [getattr(board, name) or 0.0 for name in lengths]
    ratios = [round(size / sizes[0], 9) for size in sizes]
    heights = target.height_count
    return repr((type(board).__name__, fields, ratios, heights))
