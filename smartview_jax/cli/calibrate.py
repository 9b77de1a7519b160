"""Define `smartview calibrate`, the main job: fit, judge, print, write the results."""

import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..files import file_transaction, refuse_unwritable
from .load import load_named
from .options import (
    BadViews,
    BadViewsOption,
    BaseFromWorldOption,
    DatasetArgument,
    DebugOption,
    LensOption,
    NoiseModel,
    NoiseOption,
)
from .terminal import errors_reported, progress_line

if TYPE_CHECKING:
    from ..calibration_pipeline import CalibrationFit
    from ..dataset import Dataset
    from ..evaluation import ErrorBudget, HeldOutReport, SplitHalfDifference


def calibrate(
    dataset: DatasetArgument = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("calibration"),
    lens: LensOption = "opencv4",
    noise: NoiseOption = NoiseModel.ESTIMATED,
    held_out: Annotated[
        bool, typer.Option(help="Also refit without some views and predict those.")
    ] = True,
    diagnose: Annotated[
        bool, typer.Option(help="Also by region, halves of the views, and what causes the error.")
    ] = False,
    bad_views: BadViewsOption = BadViews.RAISE,
    base_from_world: BaseFromWorldOption = None,
    debug: DebugOption = False,
) -> None:
    """Calibrate: staged and joint fit, a table, calibration.yaml and report.html.

    Writes the staged pipeline's answer as calibration_staged.yaml besides; and, where the robot's
    error is corrected, calibration_uncorrected.yaml, for programs that cannot do that.
    """
    with errors_reported(debug):
        from ..calibration_pipeline import calibrate as fit_both
        from ..evaluation import without_rejected_views
        from ..report import Origin, error_summaries, repeatability_rows, write_page
        from .calibrate_tables import print_budget, print_result

        # Checked first, so that minutes of fitting are not lost to a folder that is read-only.
        refuse_unwritable(out, "--out")
        run = _run_name()
        with progress_line() as progress:
            data, name = load_named(dataset, bad_views, progress, base_from_world)
            notes = list(data.notes)
            fit = fit_both(data, lens, noise=noise.value, progress=progress)
            warnings = fit.warnings
            # Views that the joint fit rejected are outliers, and say nothing about the calibration.
            inlier_data = without_rejected_views(data, fit)
            held_out_reports = (
                _held_out_reports(inlier_data, lens, noise, diagnose, progress, notes)
                if held_out
                else {}
            )
            split_half = budget = None
            if diagnose:
                split_half, budget = _diagnosis(fit, inlier_data, lens, noise, progress, notes)
                warnings += () if split_half is None else split_half.warnings
        notes += [f"warning: {text}" for text in warnings]
        print_result(error_summaries(fit, data, held_out_reports), fit, data, notes)
        for _, text in repeatability_rows(split_half):
            typer.echo(f"even and odd views: {text}")
        if budget is not None:
            print_budget(budget)
        with progress_line() as progress, file_transaction(out, tuple(_RESULT_FILES)) as folder:
            # All files appear together, so that the report always belongs to the calibration.
            _save_calibrations(fit, data, name, folder, run, warnings)
            write_page(
                folder / "report.html",
                fit,
                data,
                held_out_reports,
                Origin(name, shlex.join(["smartview", *sys.argv[1:]]), run),
                progress,
                split_half,
                budget,
                notes,
            )
        for file, description in _RESULT_FILES.items():
            if (out / file).is_file():
                typer.echo(f"{out / file}: {description}")
        # The results are written nevertheless, but a script must notice a fit without convergence.
        if not fit.result.converged:
            raise typer.Exit(1)


_RESULT_FILES = {
    "calibration.yaml": "the calibration",
    "calibration_staged.yaml": "that of the staged pipeline",
    "calibration_uncorrected.yaml": "for programs that cannot correct the robot's error; predicts "
    "best without, but does not say where the camera sits",
    "report.html": "what was found, and how good it is",
}
"""Descriptions of the files that `calibrate` writes, by file name."""


def _run_name() -> str:
    """Return a unique name for a run, written to all its files: the time and a random part."""
    import secrets
    from datetime import UTC, datetime

    return f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}-{secrets.token_hex(3)}"


def _save_calibrations(
    fit: "CalibrationFit",
    data: "Dataset",
    name: str,
    folder: Path,
    run: str,
    warnings: tuple[str, ...],
) -> None:
    """Write the calibrations of a fit to a folder, by the names in `_RESULT_FILES`."""
    from ..calibration_pipeline import refit_uncorrected

    fit.joint.save(folder / "calibration.yaml", run, name, warnings)
    fit.staged.calibration.save(folder / "calibration_staged.yaml", run)
    if fit.calibration.robot_error is not None:
        uncorrected = refit_uncorrected(data, fit)
        uncorrected.save(folder / "calibration_uncorrected.yaml", run)


def _held_out_reports(
    data: "Dataset",
    lens: str,
    noise: NoiseModel,
    thorough: bool,
    progress: Callable[[str], None],
    notes: list[str],
) -> "dict[str, HeldOutReport]":
    """Return the held-out errors of both fits, refitting each fold once, or add a note why not."""
    from ..calibration_pipeline import calibrate as fit_both
    from ..evaluation import held_out_reports

    if len(data.usable_views()) < 4:
        notes.append("held-out error needs at least 4 usable views: left out")
        return {}
    return held_out_reports(
        data,
        lambda part: fit_both(part, lens, noise=noise.value),
        thorough=thorough,
        progress=progress,
    )


def _diagnosis(
    fit: "CalibrationFit",
    data: "Dataset",
    lens: str,
    noise: NoiseModel,
    progress: Callable[[str], None],
    notes: list[str],
) -> "tuple[SplitHalfDifference | None, ErrorBudget | None]":
    """Compare halves of the views and compute the error budget; note what cannot be computed."""
    from ..calibration_pipeline import calibrate as fit_both
    from ..evaluation import error_budget, split_half_difference

    def fit_half(half_data: "Dataset"):
        progress("half of the views")
        return fit_both(half_data, lens, noise=noise.value).joint

    # Each of the two may be impossible, such as with too few views, without harm to the other.
    split_half = budget = None
    try:
        split_half = split_half_difference(data, fit_half)
    except ValueError as error:
        notes.append(f"halves of the views are not compared: {error}")
    try:
        budget = error_budget(data, fit.joint, progress, held_out_by_region=True)
    except ValueError as error:
        notes.append(f"there is no error budget: {error}")
    return split_half, budget
