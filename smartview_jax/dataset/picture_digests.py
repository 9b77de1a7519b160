"""Recognise pictures that a calibration was fitted to, by digests of their detected points."""

import hashlib
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .dataset import Dataset

DIGEST_DIGITS = 16
"""Hexadecimal digits of a digest: 64 bits, so that two pictures never agree by chance."""

ROUNDING = 1e-3
"""Rounding of pixel coordinates, px; files of detections have at least three decimals."""


def picture_digests(data: "Dataset") -> tuple[str, ...]:
    """Return a digest of the detected points of each view; empty where none is visible.

    The same picture has the same digest in any data set, whatever its name and its robot pose.
    """
    pixels, visible = np.asarray(data.pixels), np.asarray(data.visible)
    return tuple(
        _digest(points[seen]) if seen.any() else ""
        for points, seen in zip(pixels, visible, strict=True)
    )


def digests_to_keep(data: "Dataset") -> tuple[str, ...]:
    """Return the digests of the pictures with visible points, which a calibration's file keeps."""
    return tuple(digest for digest in picture_digests(data) if digest)


def _digest(pixels: np.ndarray) -> str:
    # Sorted by u, because the order of the points depends on the target's description.
    steps = np.round(pixels / ROUNDING).astype("<i8")
    steps = steps[np.lexsort(steps.T[::-1])]
    return hashlib.sha256(steps.tobytes()).hexdigest()[:DIGEST_DIGITS]
