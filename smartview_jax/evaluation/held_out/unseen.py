"""Everything that held-out views say of a calibration, both of its fits from the same refits."""

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
    """What one fit does on views it never saw; None where that was not asked.

    Attributes:
        held_out: by view.
        by_region: by region of the workspace.
        floor: by view, with a free pose for every hidden view: what the camera alone allows.
        foretold: by view, beside what the fits expected.
        models: name of what each fold by view took the robot's error for; empty where it was not
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
    """Held-out errors of a calibration, by what the report calls its parts.

    Args:
        data: all views.
        fitter: such as `calibrate`.
        thorough: also by region, where there are views enough, with the floor and the errors that
            the joint fits expected; twice the fits.
        progress: told what is being fitted.

    Raises:
        ValueError: fewer than four usable views.
    """
    say = progress or (lambda _: None)
    by_view = refit(data, fitter, progress=lambda text: say(f"held-out: {text}"))
    by_region = None
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
    return fit.staged


def _joint(fit: CalibrationFit, _: Dataset):
    return fit.joint


def _part(
    by_view: tuple[Refit, ...],
    by_region: tuple[Refit, ...] | None,
    data: Dataset,
    choose: Callable,
    thorough: bool,
) -> Unseen:
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
    bare = without_correction(_joint)
    regions = None if by_region is None else score(by_region, data, bare)
    return Unseen(score(by_view, data, bare), regions)
