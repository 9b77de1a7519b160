"""Report which observations a fit left out of the data, and why."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..dataset import Dataset, Rig
from ..fit_result import Rejection
from ..joint import JointFit, RigFit


class RejectionCount(NamedTuple):
    """The numbers of points and of whole views that were left out."""

    points: int
    views: int


def rejected_by(fit: Any) -> tuple[Rejection, ...] | None:
    """Return a fit's rejections; None if it does not report any."""
    rejected = getattr(fit, "rejected", None)
    return None if rejected is None else tuple(Rejection(*entry) for entry in rejected)


def without_rejected_views(data: Dataset, fit: JointFit) -> Dataset:
    """Return the data without the views that a joint fit did not use at all, to evaluate the fit.

    A view with a grossly wrong pose has a large error for any predictor. Points that were rejected
    one by one stay, because new data will have similar outliers.
    """
    used = np.asarray(fit.problem.observations.visible).any(axis=1)
    return data.mask_views(np.flatnonzero(~used))


def without_rejected_rig_views(rig: Rig, fit: RigFit) -> Rig:
    """Return a rig without the views that its fit left out as a whole, to evaluate the fit."""
    cameras = {}
    for name, data in rig.cameras.items():
        rejected = {
            entry.view for camera, entry in fit.rejected if camera == name and entry.point is None
        }
        cameras[name] = data.mask_views([k for k, v in enumerate(data.view_ids) if v in rejected])
    return rig.with_cameras(cameras)


def count_rejected(rejected: Sequence[Rejection]) -> RejectionCount:
    """Return how many points were rejected one by one, and how many whole views."""
    # A rejection without a point is a whole view, with all its points.
    views = {item.view for item in rejected if item.point is None}
    points = sum(item.point is not None and item.view not in views for item in rejected)
    return RejectionCount(points, len(views))
