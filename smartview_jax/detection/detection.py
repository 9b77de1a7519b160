"""What a detector answers."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float


class Detection(NamedTuple):
    """Where a target's points were seen in a picture.

    Attributes:
        pixels: one row a target point, px; NaN where not seen.
        visible: which were seen.
        reason: why nothing was found; None where something was.
    """

    pixels: Float[np.ndarray, "points 2"]
    visible: Bool[np.ndarray, "points"]
    reason: str | None


def found(pixels: np.ndarray) -> Detection:
    """Every point of the target was seen."""
    pixels = np.asarray(pixels, dtype=float).reshape(-1, 2)
    return Detection(pixels, np.ones(len(pixels), dtype=bool), None)


def some_found(count: int, index: np.ndarray, pixels: np.ndarray) -> Detection:
    """Points of the target by index; the others were not seen."""
    everywhere = np.full((count, 2), np.nan)
    everywhere[index] = np.asarray(pixels, dtype=float).reshape(-1, 2)
    return Detection(everywhere, np.asarray(np.isfinite(everywhere).all(axis=1)), None)


def nothing_found(count: int, reason: str) -> Detection:
    """An empty view, with its reason."""
    return Detection(np.full((count, 2), np.nan), np.zeros(count, dtype=bool), reason)
