"""Read pictures and detect the points of any target in them."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from ..targets import AbstractTarget, Charuco, Chessboard, CircleGrid, TagGrid
from .chessboard import detect_chessboard
from .circles import detect_circles
from .detection import Detection
from .markers import detect_charuco, detect_tags

_DETECTORS: tuple[tuple[type[AbstractTarget], Callable[..., Detection]], ...] = (
    (CircleGrid, detect_circles),
    (Chessboard, detect_chessboard),
    (Charuco, detect_charuco),
    (TagGrid, detect_tags),
)
"""Detector of each kind of target."""


def detect(image: np.ndarray, target: AbstractTarget) -> Detection:
    """Detect a target's points in a picture.

    If nothing is found, the result is an empty detection with a reason, not an error.

    Args:
        image: uint8, grey `(h, w)` or BGR `(h, w, 3)`.
        target: a flat target; for a `StackedTarget`, its board.

    Raises:
        ValueError: an array that is not a picture, or a target without a detector.
    """
    if image.dtype != np.uint8 or image.ndim not in (2, 3):
        raise ValueError(
            f"image: expected uint8 (h, w) or (h, w, 3), found {image.dtype} {image.shape}"
        )
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    for kind, detector in _DETECTORS:
        if isinstance(target, kind):
            return detector(grey, target)
    raise ValueError(f"there is no detector for a {type(target).__name__}; detect its board")


def read_picture(path: Path, image_size: tuple[int, int] | None = None) -> np.ndarray:
    """Read a picture as grey uint8, in the orientation of the sensor.

    An orientation stored in the file (EXIF) is ignored: a camera's pixels are those of its sensor,
    and if only some of the files store an orientation, only those would be rotated.

    Args:
        path: the file.
        image_size: expected width and height, px; None accepts any size.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: the file cannot be read as a picture, or the picture has another size.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such picture")
    # `cv2.imread` is not used: it prints to stderr, and on some systems cannot open file names
    # outside ASCII.
    data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(data, flags) if data.size else None
    except cv2.error as error:
        raise ValueError(f"{path}: not a picture that can be read: {error}") from error
    if image is None:
        raise ValueError(f"{path}: not a picture that can be read")
    size = (image.shape[1], image.shape[0])
    if image_size is not None and size != tuple(image_size):
        raise ValueError(
            f"{path}: expected {image_size[0]} x {image_size[1]} px, found {size[0]} x {size[1]}"
        )
    return image
