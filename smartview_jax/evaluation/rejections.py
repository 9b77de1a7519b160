"""What a fit left out of the data, and why."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..calibrate_data import CalibrationFit
from ..dataset import Dataset
from ..fit_result import Rejection
from ..joint import JointFit


class RejectionCount(NamedTuple):
    """How much was left out."""

    points: int
    views: int


def rejected_by(fit: Any) -> tuple[Rejection, ...] | None:
    """What a fit rejected; None if it cannot tell."""
    rejected = getattr(fit, "rejected", None)
    return None if rejected is None else tuple(Rejection(*entry) for entry in rejected)


def without_rejected_views(data: Dataset, fit: JointFit | CalibrationFit) -> Dataset:
    """The data without the views that a joint fit did not use at all: what to judge it on.

    A view whose pose contradicts the others' is as far off as its pose is wrong, whoever predicts
    it. Points that were left out one by one stay: others like them will be seen again.
    """
    used = np.asarray(fit.problem.observations.visible).any(axis=1)
    return data.without(np.flatnonzero(~used))


def count_rejected(rejected: Sequence[Rejection]) -> RejectionCount:
    """Points rejected one by one, and whole views."""
    views = {item.view for item in rejected if item.point is None}
    points = sum(item.point is not None and item.view not in views for item in rejected)
    return RejectionCount(points, len(views))
