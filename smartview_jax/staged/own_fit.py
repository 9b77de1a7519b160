"""Which views show the target by themselves, before anything is said of the robot.

A view whose points lie on one line has no pose of its own, and one whose points are not where any
view of the target has them (corners numbered wrongly, another object) spoils what all views share.
"""

import numpy as np
from jaxtyping import Bool, Float

ONE_LINE = 1e-3
"""Second over largest extent of the points, under which they are one line."""

UNLIKE = 10.0
"""Times the deviation of the median view that no lens and no noise reach."""

UNLIKE_LEAST = 0.01
"""Deviation at the least, as a share of the picture's larger side."""


def on_one_line(
    points: Float[np.ndarray, "views points 3"], visible: Bool[np.ndarray, "views points"]
) -> Bool[np.ndarray, "views"]:
    """Tell the views of which all visible points lie on one line of the target."""
    answer = np.zeros(len(points), dtype=bool)
    for view, (where, seen) in enumerate(zip(points, visible, strict=True)):
        if seen.sum() >= 2:
            extent = np.linalg.svd(where[seen] - where[seen].mean(axis=0), compute_uv=False)
            answer[view] = extent[1] < ONE_LINE * extent[0]
    return answer


def unlike_the_target(
    rms: Float[np.ndarray, "views"],
    used: Bool[np.ndarray, "views"],
    image_size: tuple[int, int],
) -> dict[int, str]:
    """Say of which views the points are no view of the target, and by how much.

    Args:
        rms: deviation of each view's points from the best view of the target, px.
        used: views that are asked about.
        image_size: width and height, px.
    """
    median = float(np.median(rms[used]))
    limit = max(UNLIKE * median, UNLIKE_LEAST * max(image_size))
    return {
        int(view): (
            f"its points are not those of the target: {rms[view]:.0f} px RMS from the best view "
            f"of it, {median:.2f} px in the median view: wrongly detected or numbered?"
        )
        for view in np.flatnonzero(used & ~(rms <= limit))
    }
