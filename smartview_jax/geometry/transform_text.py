"""Write a rigid transform for people, in millimetres and degrees."""

import numpy as np
from jaxtyping import Float

from .host import host_logarithms


def transform_text(matrix: Float[np.ndarray, "4 4"]) -> str:
    """Return the translation (mm) and the rotation vector (degrees) of a transform."""
    translation = ", ".join(f"{1e3 * x:.2f}" for x in matrix[:3, 3])
    rotation = ", ".join(f"{x:.3f}" for x in np.rad2deg(host_logarithms(matrix)[3:]))
    return f"({translation}) mm, rotated by ({rotation}) deg"
