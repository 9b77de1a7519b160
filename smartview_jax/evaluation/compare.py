"""The methods side by side: what the paper compares, and the joint fit."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from ..dataset import Dataset
from ..joint import calibrate
from ..staged import fit_one_view_intrinsics, fit_staged
from .held_out import HeldOut, held_out
from .measures import Deviations, deviations


def _interpolation(data: Dataset) -> Any:
    return fit_staged(data).interpolation(data)


METHODS: dict[str, Callable[[Dataset], Any]] = {
    "joint": calibrate,
    "staged": fit_staged,
    "staged, no distortion": lambda data: fit_staged(data, lens="pinhole"),
    "linear interpolation": _interpolation,
    "one view's intrinsics": fit_one_view_intrinsics,
}
"""From a data set to a fit, or to a predictor, by the name it is reported under."""


class Row(NamedTuple):
    """One method on one data set.

    Attributes:
        name: of the method.
        fitted: deviations on the views it was fitted to; None where it failed.
        held_out: deviations on views it never saw; None where it failed.
        failure: why, where it failed.
    """

    name: str
    fitted: Deviations | None
    held_out: HeldOut | None
    failure: str | None = None


def compare(
    data: Dataset,
    methods: Mapping[str, Callable[[Dataset], Any]] = METHODS,
    folds: int = 5,
    progress: Callable[[str], None] | None = None,
) -> list[Row]:
    """Fit every method to all views, and again in every fold; the folds are the same for all."""
    say = progress or (lambda _: None)
    rows = []
    for name, fitter in methods.items():
        say(name)
        try:
            fit = fitter(data)
            unseen = held_out(data, fitter, folds, lambda text, name=name: say(f"{name}: {text}"))
            rows.append(Row(name, deviations(getattr(fit, "calibration", fit), data), unseen))
        except (ValueError, np.linalg.LinAlgError) as error:
            rows.append(Row(name, None, None, str(error)))
    return rows
