"""Which views are hidden together: dealt out at random, or a region of the workspace at a time.

A view dealt out at random has neighbours among those that stay, so its error says how well a fit
interpolates. A hidden region makes the fit predict where the robot has not been.
"""

import numpy as np
from jaxtyping import Float, Int

from ...dataset import Dataset

LEAVE_ONE_OUT_BELOW = 8
"""Views below which every view is its own fold."""

LEAST_BY_REGION = 6
"""Views below which hiding a region leaves too few to fit."""

BY = ("view", "region")


def split_views(data: Dataset, folds: int, by: str = "view") -> tuple[tuple[int, ...], ...]:
    """The usable views that each fold hides; the data alone decide, so they suit every method.

    Args:
        data: all views.
        folds: number of folds; fewer where there are few views.
        by: `"view"` deals them out at random; `"region"` keeps together what lies together.

    Raises:
        ValueError: fewer than two folds, too few usable views, or another way to split.
    """
    if by not in BY:
        raise ValueError(f"by is one of {', '.join(BY)}; found {by!r}")
    if folds < 2:
        raise ValueError(f"folds: expected at least 2, found {folds}")
    views = data.usable_views()
    least = LEAST_BY_REGION if by == "region" else 4
    if len(views) < least:
        raise ValueError(
            f"held-out error by {by} needs at least {least} usable views, found {len(views)}"
        )
    if by == "view":
        return view_folds(views, folds)
    positions = np.asarray(data.base_from_tool.translation())
    return region_folds(views, positions[views], folds)


def view_folds(views: Int[np.ndarray, "views"], folds: int) -> tuple[tuple[int, ...], ...]:
    """Every fold's views: a fixed permutation dealt out, or one view each below eight views."""
    count = len(views)
    number = count if count < LEAVE_ONE_OUT_BELOW else min(folds, count)
    order = np.random.default_rng(0).permutation(count)
    return tuple(tuple(int(views[k]) for k in order[i::number]) for i in range(number))


def region_folds(
    views: Int[np.ndarray, "views"], positions: Float[np.ndarray, "views 3"], folds: int
) -> tuple[tuple[int, ...], ...]:
    """Views that lie together: halved across the longest direction, and so on.

    Args:
        views: what to call them.
        positions: of the tool in the base frame, m.
        folds: number of regions, with at least two views each and as many as each other, or one
            more.
    """
    regions = _halved(positions, np.arange(len(views)), min(folds, len(views) // 2))
    return tuple(tuple(int(views[k]) for k in sorted(region)) for region in regions)


def _halved(
    positions: Float[np.ndarray, "all 3"], chosen: Int[np.ndarray, "chosen"], parts: int
) -> list[Int[np.ndarray, "region"]]:
    if parts == 1:
        return [chosen]
    offset = positions[chosen] - positions[chosen].mean(axis=0)
    axis = np.linalg.svd(offset, full_matrices=False)[2][0]
    # Either sign is as good: the one whose largest component is positive, on every machine.
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    ordered = chosen[np.argsort(offset @ axis, kind="stable")]
    first = parts // 2
    cut = len(chosen) * first // parts
    return [
        *_halved(positions, ordered[:cut], first),
        *_halved(positions, ordered[cut:], parts - first),
    ]
