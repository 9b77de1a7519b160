"""Calibrate one folder for `smartview calibrate`: load, fit, judge, and write the results."""

import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..files import file_transaction
from . import options
from .fit_options import FitKnowledge, parse_fit_options
from .load import load_named, load_samples, with_estimated_clock

if TYPE_CHECKING:
    from ..calibration_pipeline import CalibrationFit
    from ..dataset import Dataset
    from .calibrate_result import CalibrateResult


@dataclass(frozen=True)
class CalibrateSettings:
    """The options of `smartview calibrate` that are the same for all folders."""

    lens: options.LensOption = "opencv4"
    noise: options.NoiseOption = options.NoiseModel.ESTIMATED
    held_out: Annotated[
        bool,
        typer.Option(
            help="Cross-validate: refit without some views and measure the error on them.",
            show_default="on",
        ),
    ] = True
    diagnose: Annotated[
        bool,
        typer.Option(
            help="Also: error by workspace region, split-half agreement, error budget.",
            show_default="off",
        ),
    ] = False
    known: FitKnowledge = field(default_factory=FitKnowledge)
    bad_views: options.BadViewsOption = options.BadViews.RAISE
    base_from_world: options.BaseFromWorldOption = None
    time_offset: options.TimeOffsetOption = False
    mount: options.MountOption = None


def loaded_folder(
    dataset: Path | None, settings: CalibrateSettings, progress: Callable[[str], None]
) -> "tuple[Dataset, str]":
    """Load a data set, with poses at the estimated clock if requested, and return its name too."""
    if dataset is not None and dataset.is_file():
        return load_samples(dataset, settings.mount and settings.mount.value)
    if settings.mount is not None:
        raise ValueError("--mount: expected a file of samples; a data-set folder states its mount")
    data, name = load_named(
        dataset, settings.bad_views, progress, settings.base_from_world, tracked_poses=True
    )
    if settings.time_offset:
        data = with_estimated_clock(data, dataset, settings.lens, progress)
    return data, name


def calibrated_folder(
    data: "Dataset", name: str, settings: CalibrateSettings, progress: Callable[[str], None]
) -> "tuple[CalibrateResult, str]":
    """Fit a data set with pictures, and judge the fit.

    Returns:
        The result, and the options that state prior knowledge, in words.
    """
    from ..calibration_pipeline import calibrate as fit_both
    from .calibrate_result import fit_and_judge

    lens = settings.lens
    # The names of the transforms depend on the mount, which the data set states.
    fit_options = parse_fit_options(lens, data.mount, settings.known)

    # Folds and halves are fitted with the same options as all views.
    def fit_views(part: "Dataset", progress: Callable[[str], None] | None) -> "CalibrationFit":
        given = fit_options.arguments()
        return fit_both(part, lens, noise=settings.noise.value, progress=progress, **given)

    result = fit_and_judge(data, name, fit_views, settings.held_out, settings.diagnose, progress)
    return result, fit_options.given


RESULT_FILES = {
    "calibration.yaml": "the calibration",
    "calibration_staged.yaml": "the calibration of the staged pipeline",
    "calibration_uncorrected.yaml": "for programs that cannot correct the robot's error: predicts "
    "best without the correction, but its hand-eye transform is not the true one",
    "report.html": "the report: results and accuracy",
}
"""Descriptions of the files that `calibrate` writes, by file name."""


def run_name() -> str:
    """Return a unique name for a run, written to all its files: the time and a random part."""
    import secrets
    from datetime import UTC, datetime

    return f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}-{secrets.token_hex(3)}"


def command_line() -> str:
    """Return the command that runs, as a person would type it."""
    return shlex.join(["smartview", *sys.argv[1:]])


def provenance(name: str, given: str) -> str:
    """Return where the numbers come from: the data set, and values that were given."""
    return f"{name}; given: {given}" if given else name


def write_files(
    result: "CalibrateResult",
    out: Path,
    run: str,
    given: str,
    progress: Callable[[str], None],
) -> list[Path]:
    """Write all files of a run, or none, and return the paths written."""
    from ..report import Judgement, Origin, write_page

    # All files appear together, so that the report always belongs to the calibration.
    with file_transaction(out, tuple(RESULT_FILES)) as folder:
        _save_calibrations(result, folder, run, given)
        write_page(
            folder / "report.html",
            result.fit,
            result.data,
            Judgement(result.held_out_reports, result.split_half, result.budget, result.remarks),
            Origin(result.name, command_line(), run, given),
            progress,
        )
    return [out / file for file in RESULT_FILES if (out / file).is_file()]


def _save_calibrations(result: "CalibrateResult", folder: Path, run: str, given: str) -> None:
    """Write the calibrations of a fit to a folder, by the names in `RESULT_FILES`."""
    from ..calibration_pipeline import refit_uncorrected

    fit = result.fit
    pictures = fit.picture_digests
    source = provenance(result.name, given)
    fit.joint.save(folder / "calibration.yaml", run, source, result.warnings)
    fit.staged.calibration.save(folder / "calibration_staged.yaml", run, pictures=pictures)
    if fit.calibration.robot_error is not None:
        # With the robot's error corrected, the transforms alone do not predict best.
        uncorrected = refit_uncorrected(result.data, fit)
        uncorrected.save(folder / "calibration_uncorrected.yaml", run, pictures=pictures)
