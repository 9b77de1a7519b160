"""Find views that do not show the target properly, before the robot's poses are used.

A view whose points lie on one line does not determine a pose. A view whose points do not match any
view of the target (corners numbered wrongly, another object) would spoil the common camera.
"""

import numpy as np
from jaxtyping import Bool, Float

from .weng_start import extents

COLLINEARITY_TOLERANCE = 1e-3
"""Ratio of second to largest extent of the points below which they count as one line."""

MAX_RMS_RATIO = 10.0
"""Limit on a view's RMS error, in multiples of the median view's.

No lens and no noise reach it."""

RMS_LIMIT_FLOOR = 0.01
"""Lower bound of that limit, as a fraction of the picture's longer side."""


def collinear_views(
    points: Float[np.ndarray, "views points 3"], visible: Bool[np.ndarray, "views points"]
) -> Bool[np.ndarray, "views"]:
    """Return the mask of views whose visible points all lie on one line of the target."""
    # A view of fewer than two points has no extent; it is reported elsewhere as showing too few.
    _, second, largest = extents(points, visible).T
    return second < COLLINEARITY_TOLERANCE * largest


def mismatched_views(
    rms: Float[np.ndarray, "views"],
    used: Bool[np.ndarray, "views"],
    image_size: tuple[int, int],
) -> dict[int, str]:
    """Return, by view, a sentence about points that do not match the target.

    Args:
        rms: RMS reprojection error of each view with its own best pose, px.
        used: mask of the views to check.
        image_size: width and height, px.
    """
    # The lower bound keeps nearly exact data from being rejected for a tenth of a pixel.
    median = float(np.median(rms[used]))
    limit = max(MAX_RMS_RATIO * median, RMS_LIMIT_FLOOR * max(image_size))
    return {
        int(view): (
            f"its points are not those of the target: {rms[view]:.0f} px RMS from the best view "
            f"of it, {median:.2f} px in the median view: wrongly detected or numbered?"
        )
        # Negated, so that a NaN error is reported too.
        for view in np.flatnonzero(used & ~(rms <= limit))
    }
