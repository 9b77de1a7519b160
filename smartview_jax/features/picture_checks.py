"""Refuse arrays that are not pictures of the camera, and pictures without usable content."""

import cv2
import numpy as np
from jaxtyping import Float

from ..cameras import Camera

MIN_CONTRAST = 8.0
"""Smallest difference, grey levels, between the darkest and the brightest hundredth of pixels."""

MAX_WHITE_FRACTION, MAX_BLACK_FRACTION = 0.6, 0.98
"""Largest fractions of pixels at 255 and at 0; objects may be in front of black."""


def grey_levels(picture: np.ndarray, camera: Camera) -> Float[np.ndarray, "rows columns"]:
    """Return the grey levels, 0 to 255, of a picture: uint8, grey, or BGR with a third axis."""
    if not isinstance(picture, np.ndarray) or picture.size == 0:
        raise ValueError("picture: expected an array of grey levels, found nothing")
    if (
        picture.dtype != np.uint8
        or picture.ndim not in (2, 3)
        or picture.shape[2:] not in ((), (3,))
    ):
        raise ValueError(
            f"picture: expected uint8 (h, w) or (h, w, 3), found {picture.dtype} {picture.shape}"
        )
    width, rows = camera.image_size
    if picture.shape[:2] != (rows, width):
        raise ValueError(
            f"picture: expected {width} x {rows} px, the camera's size, found "
            f"{picture.shape[1]} x {picture.shape[0]} px"
        )
    grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    counts = cv2.calcHist([grey], [0], None, [256], [0.0, 256.0]).ravel().astype(int)
    black, white = float(counts[0]) / grey.size, float(counts[255]) / grey.size
    ranks = np.array([0.01, 0.99]) * (grey.size - 1)
    darkest, brightest = np.searchsorted(np.cumsum(counts), ranks, side="right")
    # A dark object may be a few bright pixels on black, so blackness is tested first.
    if black > MAX_BLACK_FRACTION:
        raise ValueError(f"picture: under-exposed, {black:.0%} of its pixels are 0")
    if white > MAX_WHITE_FRACTION:
        raise ValueError(f"picture: over-exposed, {white:.0%} of its pixels are 255")
    if brightest - darkest < MIN_CONTRAST:
        raise ValueError(
            f"picture: blank, its grey levels are between {darkest:.0f} and {brightest:.0f}"
        )
    return grey.astype(float)
