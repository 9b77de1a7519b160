"""Find views that do not show the target properly, before the robot's poses are used.

A view whose points lie on one line does not determine a pose. A view whose points do not match any
view of the target (corners numbered wrongly, another object) would spoil the common camera.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from ..cameras import SymmetricLensFit, fit_symmetric_lens
from ..dataset import Observations, extents

COLLINEARITY_TOLERANCE = 1e-3
"""Ratio of second to largest extent of the points below which they count as one line."""

MAX_MISFIT = 0.01
"""Largest misfit of a view that shows the target, as a fraction of the picture's longer side.

No detector is off by so much, and points of something else are off by many times as much.
"""

MAX_MISFIT_OF_SPACING = 0.25
"""Largest misfit of a view that shows the target, as a fraction of its points' distance in pixels.

Points that are numbered wrongly lie at least half a distance off, in the middle between two places,
and detections that are off by a quarter of it cannot be told from their neighbours.
"""

DETECTION_NOISE = 0.5
"""Standard deviation of a detected point, px, beyond which it counts less in a view's own fit."""

_WRONG = "wrongly detected or numbered"

_REVERSED = "they fit in reverse order: was the grid detected turned by half a turn"


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
    observations: Observations,
    image_size: tuple[int, int],
) -> dict[int, str]:
    """Return, by view, a sentence about points that do not match the target.

    A view that the lens of Step 1 does not explain is fitted again, by itself, with any lens that
    is symmetric about its axis. So no view of a fisheye lens is blamed, and views that are all
    wrong in the same way have no other view by which they seem right.

    Args:
        rms: RMS reprojection error of each view with its own best pose and Step 1's lens, px.
        used: mask of the views to check.
        observations: target points and pixels.
        image_size: width and height, px.
    """
    points, pixels = np.asarray(observations.points), np.asarray(observations.pixels)
    visible, mismatches = np.asarray(observations.visible), {}
    for view in np.flatnonzero(used):
        seen = visible[view]
        limit = _misfit_limit(pixels[view, seen], image_size)
        if rms[view] <= limit:
            continue
        fit = fit_of_any_lens(points[view, seen], pixels[view, seen], image_size)
        # Where its points are too few to tell a lens, the fit of Step 1 decides.
        misfit = float(rms[view]) if fit is None else median_distance(fit)
        if not misfit <= limit:
            back = fit_of_any_lens(points[view, seen][::-1], pixels[view, seen], image_size)
            is_reversed = back is not None and median_distance(back) <= limit
            mismatches[int(view)] = (
                f"its points are not the target's: {misfit:.0f} px from the best view of "
                f"it by any lens, in the median: {_REVERSED if is_reversed else _WRONG}?"
            )
    return mismatches


def _misfit_limit(pixels: Float[np.ndarray, "points 2"], image_size: tuple[int, int]) -> float:
    """Return the largest misfit of a view that shows the target, px."""
    by_picture = MAX_MISFIT * max(image_size)
    if len(pixels) < 2:
        return by_picture
    # The first neighbour of a point is the point itself.
    spacing = float(np.median(KDTree(pixels).query(pixels, 2)[0][:, 1]))
    return min(by_picture, max(MAX_MISFIT_OF_SPACING * spacing, DETECTION_NOISE))


def fit_of_any_lens(
    points: Float[np.ndarray, "points 3"],
    pixels: Float[np.ndarray, "points 2"],
    image_size: tuple[int, int],
) -> SymmetricLensFit | None:
    """Return a view's fit with a symmetric lens of its own; None for too few points."""
    everything = np.ones(len(points), dtype=bool)
    fit = fit_symmetric_lens(points, pixels, image_size, everything, DETECTION_NOISE)
    # As many numbers as parameters fit anything.
    if fit is None or 2 * len(points) <= fit.parameter_count:
        return None
    return fit


def median_distance(fit: SymmetricLensFit) -> float:
    """Return the median distance of a view's pixels from its own fit, px."""
    return float(np.median(np.linalg.norm(fit.residuals, axis=1)))
