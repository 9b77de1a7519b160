"""The methods side by side: what the paper compares, and the joint fit."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from ...calibrate_data import LENS, calibrate
from ...cameras import AbstractLens
from ...dataset import Dataset
from ...fit_result import Rejection
from ...staged import fit_one_view_intrinsics, fit_staged
from ..free_poses import free_pose_deviations
from ..measures import Deviations, deviations
from ..rejections import rejected_by
from .held_out import (
    HeldOut,
    Refit,
    has_correction,
    predictor_of,
    refit,
    score,
    whole,
    without_correction,
)

UNCORRECTED = "correction left out"
"""What a row adds to its method's name where the robot's error is not corrected."""


class Method(NamedTuple):
    """One line of the comparison.

    Attributes:
        fitter: from a data set to a fit. Methods that share a fitter share its fits.
        choose: from a fit and the data to the part that is this method.
        measure: from a predictor and the data to deviations.
    """

    fitter: Callable[[Dataset], Any]
    choose: Callable[[Any, Dataset], Any] = whole
    measure: Callable[[Any, Dataset], Deviations] = deviations


class Row(NamedTuple):
    """One method on one data set.

    Attributes:
        name: of the method.
        fitted: deviations on the views it was fitted to; None where it failed.
        held_out: deviations on views it never saw; None where it failed.
        rejected: what the method left out; None where it failed or cannot tell.
        failure: why, where it failed.
    """

    name: str
    fitted: Deviations | None
    held_out: HeldOut | None
    rejected: tuple[Rejection, ...] | None = None
    failure: str | None = None


def standard_methods(lens: str | AbstractLens = LENS) -> dict[str, Method]:
    """The paper's methods, the joint fit, and the bound that no chain can pass."""

    def both(data: Dataset) -> Any:
        return calibrate(data, lens, noise="trusted")

    return {
        "staged": Method(both, lambda fit, _: fit.staged),
        "staged, no distortion": Method(lambda data: fit_staged(data, lens="pinhole")),
        "linear interpolation": Method(both, lambda fit, data: fit.staged.interpolation(data)),
        "one view's intrinsics": Method(fit_one_view_intrinsics),
        "joint, robot trusted": Method(both),
        "joint, errors estimated": Method(lambda data: calibrate(data, lens)),
        "free pose a view": Method(both, measure=free_pose_deviations),
    }


def compare(
    data: Dataset,
    methods: Mapping[str, Method | Callable[[Dataset], Any]] | None = None,
    folds: int = 5,
    progress: Callable[[str], None] | None = None,
    by: str = "view",
) -> list[Row]:
    """Fit every method to all views, and again in every fold; the folds are the same for all.

    A fit that corrects the robot's error has a second row without the correction: what a program
    sees that takes the transforms alone. Those are the best answer for the mount, not the chain
    that predicts best without a correction; that one is a fit that trusts the robot, whose
    transforms bend to absorb the robot's error.

    Args:
        data: all views.
        methods: by the name to report them under: a `Method`, or a fitter as `held_out` takes it;
            by default `standard_methods()`.
        folds: number of folds; below eight views, as many as there are views.
        progress: told what is being fitted.
        by: `"view"` or `"region"`: what is hidden together, as for `held_out`.
    """
    say = progress or (lambda _: None)
    fits: dict[Callable, _Fits | ValueError] = {}
    rows = []
    for name, given in (standard_methods() if methods is None else methods).items():
        method = given if isinstance(given, Method) else Method(given)
        if method.fitter not in fits:
            say(name)
            fits[method.fitter] = _fit(
                data, method.fitter, folds, lambda s, n=name: say(f"{n}: {s}"), by
            )
        found = fits[method.fitter]
        rows.append(_row(name, method, found, data))
        if isinstance(found, _Fits) and method.measure is deviations:
            bare = method._replace(choose=without_correction(method.choose))
            if any(has_correction(method.choose(fit, data)) for fit in found.every):
                rows.append(_row(f"{name}, {UNCORRECTED}", bare, found, data))
    return rows


class _Fits(NamedTuple):
    fit: Any
    refits: tuple[Refit, ...]

    @property
    def every(self) -> tuple[Any, ...]:
        """The fit to all views, and those of the folds that did not fail."""
        return (self.fit, *(fold.fit for fold in self.refits if fold.failure is None))


def _fit(
    data: Dataset,
    fitter: Callable[[Dataset], Any],
    folds: int,
    progress: Callable[[str], None],
    by: str,
) -> _Fits | ValueError:
    try:
        return _Fits(fitter(data), refit(data, fitter, folds, progress, by))
    except ValueError as error:
        return error


def _row(name: str, method: Method, fits: _Fits | ValueError, data: Dataset) -> Row:
    if isinstance(fits, ValueError):
        return Row(name, None, None, failure=str(fits))
    part = method.choose(fits.fit, data)
    fitted = method.measure(predictor_of(part), data)
    unseen = score(fits.refits, data, method.choose, method.measure)
    return Row(name, fitted, unseen, rejected_by(part))
