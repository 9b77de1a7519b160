"""Draw a picture's edges as a map of pixels."""

import numpy as np
from jaxtyping import Bool

from ..cameras import Camera
from .edge_points import find_edge_points
from .gradient import Gradient
from .picture_checks import grey_levels


def edge_map(picture: np.ndarray, camera: Camera) -> Bool[np.ndarray, "rows columns"]:
    """Return which pixels have an edge point by Canny's criteria; thresholds follow the noise.

    Args:
        picture: uint8, grey `(rows, columns)` or BGR `(rows, columns, 3)`.
        camera: the camera that took it.

    Raises:
        ValueError: as `find` does.
    """
    grey = grey_levels(picture, camera)
    column, row = find_edge_points(Gradient.of(grey)).cells.T
    edges = np.zeros(grey.shape, dtype=bool)
    edges[row, column] = True
    return edges
