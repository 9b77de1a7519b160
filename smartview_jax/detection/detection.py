"""Define the result of a detector."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float


class Detection(NamedTuple):
    """The result of detecting a target's points in a picture.

    Attributes:
        pixels: one row for each point of the target, px; NaN where the point was not detected.
        visible: whether each point was detected.
        reason: the reason why nothing was found; None if any point was found.
        noise: standard deviation of the points as measured by `plausibility`, px; 0 if not tested.
        left_out: number of points that were found but failed the test of `plausibility`.
        edge_width: width of the target's edges in the picture, px; None if not measured.
    """

    pixels: Float[np.ndarray, "points 2"]
    visible: Bool[np.ndarray, "points"]
    reason: str | None
    noise: float = 0.0
    left_out: int = 0
    edge_width: float | None = None


def full_detection(pixels: np.ndarray) -> Detection:
    """Return a detection of all points of the target, px, one row for each."""
    pixels = np.asarray(pixels, dtype=float).reshape(-1, 2)
    return Detection(pixels, np.ones(len(pixels), dtype=bool), None)


def partial_detection(count: int, index: np.ndarray, pixels: np.ndarray) -> Detection:
    """Return a detection of the target's points of some indices, px, one row for each."""
    all_pixels = np.full((count, 2), np.nan)
    all_pixels[index] = np.asarray(pixels, dtype=float).reshape(-1, 2)
    return Detection(all_pixels, np.asarray(np.isfinite(all_pixels).all(axis=1)), None)


def empty_detection(count: int, reason: str) -> Detection:
    """Return an empty detection."""
    return Detection(np.full((count, 2), np.nan), np.zeros(count, dtype=bool), reason)
