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
    StackedTarget,
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
"""Detector of each kind of target, except the chessboard, which has two."""

_TURNED_TAGS = (
    "but every tag turned by half a turn would: Kalibr's boards are of kind aprilgrid, others are "
    "tag_grid, with rows_from: bottom where the numbers begin there"
)
"""What to do where each tag is turned, as in the boards of Kalibr against others."""


def detect(
    image: np.ndarray, target: AbstractTarget, limits: DetectionLimits | None = None
) -> Detection:
    """Detect a target's points in a picture, and test them against each other.

    If nothing is found, or what is found does not lie as the target's points do, the result is an
    empty detection with a reason, not an error. Single points that fail the test are not visible.

    Args:
        image: uint8, grey `(h, w)` or BGR `(h, w, 3)`.
        target: a flat target; for a `StackedTarget`, its board.
        limits: of the test; by default `DetectionLimits()`.

    Raises:
        ValueError: an array that is not a picture, or a target without a detector.
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
            found = detector(grey, target)
            checked = checked_detection(found, target.points, size, limits)
            if checked.reason is not None and _has_turned_tags(found, target, size, limits):
                return checked._replace(reason=f"{checked.reason}; {_TURNED_TAGS}")
            return checked
    raise ValueError(f"there is no detector for a {type(target).__name__}; detect its board")


def _has_turned_tags(
    found: Detection,
    target: AbstractTarget,
    size: tuple[int, int],
    limits: DetectionLimits | None,
) -> bool:
    """Return whether tags lie as the target's do if each is turned by half a turn."""
    if not isinstance(target, TagGrid | AprilGrid) or not found.visible.any():
        return False
    turned = found.pixels.reshape(-1, 4, 2)[:, [2, 3, 0, 1]].reshape(-1, 2)
    visible = np.asarray(np.isfinite(turned).all(axis=1))
    again = Detection(turned, visible, None)
    return checked_detection(again, target.points, size, limits).reason is None


def detection_identity(target: AbstractTarget) -> str:
    """Return a text that is equal for targets whose detections are the same.

    Lengths count only in relation to each other: a square that was measured more accurately, or the
    heights of a board, change no pixel.
    """
    board = target.board if isinstance(target, StackedTarget) else target
    fields = {
        field.name: getattr(board, field.name)
        for field in dataclasses.fields(board)
        if field.name not in board.lengths
    }
    # Only the centres of circles are detected, whatever their radii.
    lengths = board.lengths[:1] if isinstance(board, CircleGrid) else board.lengths
    # A length that is not there, as the gap of a single tag, counts as 0.
    sizes = [getattr(board, name) or 0.0 for name in lengths]
    ratios = [round(size / sizes[0], 9) for size in sizes]
    heights = len(target.heights) if isinstance(target, StackedTarget) else 1
    return repr((type(board).__name__, fields, ratios, heights))
