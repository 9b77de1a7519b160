"""Write a rigid transform for people, in millimetres and degrees."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from .host import host_logarithms


def transform_text(matrix: Float[np.ndarray, "4 4"]) -> str:
    """Return the translation (mm) and the rotation vector (degrees) of a transform."""
    translation = vector_text(1e3 * matrix[:3, 3], 2)
    rotation = vector_text(np.rad2deg(host_logarithms(matrix)[3:]), 3)
    return f"{translation} mm, rotated by {rotation} deg"


def vector_text(numbers: Iterable[float], decimals: int) -> str:
    """Return a vector as `(x, y, z)`, the form of all vectors that are printed.

    Args:
        numbers: its components.
        decimals: digits after the point.
    """
    return f"({', '.join(f'{number:.{decimals}f}' for number in numbers)})"
