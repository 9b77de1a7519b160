"""Split views into folds: at random, or by region of the workspace.

A view held out at random has neighbours among the fitted ones, so its error measures interpolation.
With a hidden region, the fit has to extrapolate.
"""

import numpy as np
from jaxtyping import Float, Int

from ...argument_checks import require_one_of
from ...dataset import Dataset, Rig

LEAVE_ONE_OUT_BELOW = 8
"""The number of views below which every view is its own fold."""

MIN_HELD_OUT_VIEWS = 4
"""The number of views below which hiding one leaves too few to fit."""

MIN_VIEWS_BY_REGION = 6
"""The number of views below which hiding a region leaves too few to fit."""

FOLD_KINDS = ("view", "region")
"""The accepted values of `by`."""


def split_views(data: Dataset | Rig, folds: int, by: str = "view") -> tuple[tuple[int, ...], ...]:
    """Return the usable views, or states of a rig's robot, that each fold hides.

    They depend on the data only, so that all methods have the same folds.

    Args:
        data: all views.
        folds: number of folds; fewer where there are few views.
        by: `"view"` assigns views at random; `"region"` keeps neighbouring views together.

    Raises:
        ValueError: fewer than two folds, too few usable views, or an unknown `by`.
    """
    require_one_of("by", by, FOLD_KINDS)
    if folds < 2:
        raise ValueError(f"folds: expected at least 2, found {folds}")
    views = data.usable_views()
    minimum = MIN_VIEWS_BY_REGION if by == "region" else MIN_HELD_OUT_VIEWS
    if len(views) < minimum:
        raise ValueError(
            f"held-out error by {by} needs at least {minimum} usable views, found {len(views)}"
        )
    if by == "view":
        return view_folds(views, folds)
    positions = np.asarray(data.base_from_tool.translation())
    return region_folds(views, positions[views], folds)


def view_folds(views: Int[np.ndarray, "views"], folds: int) -> tuple[tuple[int, ...], ...]:
    """Return the views of each fold by a fixed random permutation.

    Below `LEAVE_ONE_OUT_BELOW` views, each view is its own fold.
    """
    # A fixed seed, so that all methods and runs have the same folds.
    count = len(views)
    fold_count = count if count < LEAVE_ONE_OUT_BELOW else min(folds, count)
    order = np.random.default_rng(0).permutation(count)
    return tuple(tuple(int(views[k]) for k in order[i::fold_count]) for i in range(fold_count))


def region_folds(
    views: Int[np.ndarray, "views"], positions: Float[np.ndarray, "views 3"], folds: int
) -> tuple[tuple[int, ...], ...]:
    """Return the views of each region, found by repeatedly halving along the longest direction.

    Args:
        views: indices of the views.
        positions: positions of the tool in the base frame, m.
        folds: number of regions, with at least two views each; sizes differ by at most one.
    """
    regions = _bisect_regions(positions, np.arange(len(views)), min(folds, len(views) // 2))
    return tuple(tuple(int(views[k]) for k in sorted(region)) for region in regions)


def _bisect_regions(
    positions: Float[np.ndarray, "all 3"],
    view_indices: Int[np.ndarray, "chosen"],
    region_count: int,
) -> list[Int[np.ndarray, "region"]]:
    """Return the regions of some views, halved across their longest direction."""
    if region_count == 1:
        return [view_indices]
    offset = positions[view_indices] - positions[view_indices].mean(axis=0)
    # The first principal direction of the positions: the right singular vector of the largest
    # singular value.
    axis = np.linalg.svd(offset, full_matrices=False)[2][0]
    # The sign is arbitrary; with the largest component positive it is the same on every machine.
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    ordered = view_indices[np.argsort(offset @ axis, kind="stable")]
    left_count = region_count // 2
    # In proportion to the number of regions on either side, so that all regions have equal size.
    split_index = len(view_indices) * left_count // region_count
    return [
        *_bisect_regions(positions, ordered[:split_index], left_count),
        *_bisect_regions(positions, ordered[split_index:], region_count - left_count),
    ]
