"""Collect the held-out errors of a calibration's staged and joint fits, from the same refits."""

from collections.abc import Callable
from typing import NamedTuple

from ...calibrate_data import CalibrationFit
from ...dataset import Dataset
from ..free_poses import free_pose_deviations
from .compare import UNCORRECTED
from .folds import LEAST_BY_REGION
from .held_out import HeldOut, Refit, has_correction, refit, score, without_correction
from .predicted import Foretold, foretold


class Unseen(NamedTuple):
    """The held-out errors of one fit; None where they were not requested.

    Attributes:
        held_out: by view.
        by_region: by region of the workspace.
        floor: by view, with a free pose for every hidden view: the error of the camera alone.
        foretold: by view, with the errors that the fits predicted.
        models: name of the robot error model of each fold by view; empty where it was not
            estimated.
    """

    held_out: HeldOut
    by_region: HeldOut | None = None
    floor: HeldOut | None = None
    foretold: Foretold | None = None
    models: tuple[str, ...] = ()


def unseen_errors(
    data: Dataset,
    fitter: Callable[[Dataset], CalibrationFit],
    thorough: bool = False,
    progress: Callable[[str], None] | None = None,
) -> dict[str, Unseen]:
    """Return the held-out errors of a calibration, by the report's name of each part.

    Args:
        data: all views.
        fitter: such as `calibrate`.
        thorough: also by region, where there are enough views, with the floor and the errors that
            the joint fits predicted; twice the number of fits.
        progress: called with a line of text for each fit.

    Raises:
        ValueError: fewer than four usable views.
    """
    say = progress or (lambda _: None)
    by_view = refit(data, fitter, progress=lambda text: say(f"held-out: {text}"))
    by_region = None
    # Hiding a region of few views leaves too few to fit.
    if thorough and len(data.usable_views()) >= LEAST_BY_REGION:
        by_region = refit(
            data, fitter, progress=lambda text: say(f"held-out by region: {text}"), by="region"
        )
    found = {
        name: _part(by_view, by_region, data, choose, thorough)
        for name, choose in (("staged", _staged), ("joint", _joint))
    }
    if any(fold.failure is None and has_correction(fold.fit.joint) for fold in by_view):
        found[f"joint, {UNCORRECTED}"] = _bare(by_view, by_region, data)
    return found


def _staged(fit: CalibrationFit, _: Dataset):
    """Return the staged fit of a calibration."""
    return fit.staged


def _joint(fit: CalibrationFit, _: Dataset):
    """Return the joint fit of a calibration."""
    return fit.joint


def _part(
    by_view: tuple[Refit, ...],
    by_region: tuple[Refit, ...] | None,
    data: Dataset,
    choose: Callable,
    thorough: bool,
) -> Unseen:
    """Return the held-out errors of one part of a calibration."""
    held_out, models = score(by_view, data, choose), ()
    if choose is _joint:
        fits = [fold.fit.joint for fold in by_view if fold.failure is None]
        models = tuple(fit.estimate.name for fit in fits if fit.estimate is not None)
    if not thorough:
        return Unseen(held_out, models=models)
    return Unseen(
        held_out,
        None if by_region is None else score(by_region, data, choose),
        score(by_view, data, choose, free_pose_deviations),
        foretold(by_view, data, choose) if choose is _joint else None,
        models,
    )


def _bare(by_view: tuple[Refit, ...], by_region: tuple[Refit, ...] | None, data: Dataset) -> Unseen:
    """Return the held-out errors of the joint fit without its correction of the robot's error."""
    bare = without_correction(_joint)
    regions = None if by_region is None else score(by_region, data, bare)
    return Unseen(score(by_view, data, bare), regions)
