"""Define `smartview calibrate`, the main job: fit, judge, print, write the results."""

import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..files import file_transaction, refuse_unwritable
from . import options
from .fit_options import FitKnowledge, parse_fit_options
from .json_document import print_document
from .load import load_named, with_estimated_clock
from .option_groups import with_option_groups
from .terminal import errors_reported, progress_line

if TYPE_CHECKING:
    from ..calibration_pipeline import CalibrationFit
    from ..dataset import Dataset
    from .calibrate_result import CalibrateResult


@with_option_groups
def calibrate(
    dataset: options.DatasetArgument = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("calibration"),
    lens: options.LensOption = "opencv4",
    noise: options.NoiseOption = options.NoiseModel.ESTIMATED,
    held_out: Annotated[
        bool,
        typer.Option(
            help="Cross-validate: refit without some views and measure the error on them."
        ),
    ] = True,
    diagnose: Annotated[
        bool,
        typer.Option(help="Also: error by workspace region, split-half agreement, error budget."),
    ] = False,
    *,
    known: FitKnowledge,
    bad_views: options.BadViewsOption = options.BadViews.RAISE,
    base_from_world: options.BaseFromWorldOption = None,
    time_offset: options.TimeOffsetOption = False,
    json: options.JsonOption = False,
    debug: options.DebugOption = False,
) -> None:
    """Calibrate: staged and joint fit, a table, calibration.yaml and report.html.

    The staged fit is written to calibration_staged.yaml as well. If the robot's error is corrected,
    calibration_uncorrected.yaml is for programs that cannot apply the correction.
    """
    with errors_reported(debug):
        from ..calibration_pipeline import calibrate as fit_both
        from .calibrate_document import calibrate_document
        from .calibrate_result import fit_and_judge
        from .calibrate_tables import print_calibrate_result

        # Checked first, so that minutes of fitting are not lost to a folder that is read-only.
        refuse_unwritable(out, "--out")
        run = _run_name()

        with progress_line() as progress:
            data, name = load_named(dataset, bad_views, progress, base_from_world)
            if time_offset:
                data = with_estimated_clock(data, dataset, lens, progress)
            # The names of the transforms depend on the mount, which the data set states.
            fit_options = parse_fit_options(lens, data.mount, known)

            # Folds and halves are fitted with the same options as all views.
            def fit_views(
                part: "Dataset", progress: Callable[[str], None] | None
            ) -> "CalibrationFit":
                given = fit_options.arguments()
                return fit_both(part, lens, noise=noise.value, progress=progress, **given)

            result = fit_and_judge(data, name, fit_views, held_out, diagnose, progress)
        if not json:
            print_calibrate_result(result)
        with progress_line() as progress:
            files = _write_files(result, out, run, fit_options.given, progress)
        if json:
            print_document("calibrate", calibrate_document(result, run, fit_options.given, files))
        else:
            for file in files:
                typer.echo(f"{file}: {_RESULT_FILES[file.name]}")
        # The results are written, but a script must notice that the fit did not converge.
        if not result.fit.result.converged:
            raise typer.Exit(1)


_RESULT_FILES = {
    "calibration.yaml": "the calibration",
    "calibration_staged.yaml": "the calibration of the staged pipeline",
    "calibration_uncorrected.yaml": "for programs that cannot correct the robot's error: predicts "
    "best without the correction, but its hand-eye transform is not the true one",
    "report.html": "the report: results and accuracy",
}
"""Descriptions of the files that `calibrate` writes, by file name."""


def _run_name() -> str:
    """Return a unique name for a run, written to all its files: the time and a random part."""
    import secrets
    from datetime import UTC, datetime

    return f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}-{secrets.token_hex(3)}"


def _write_files(
    result: "CalibrateResult",
    out: Path,
    run: str,
    given: str,
    progress: Callable[[str], None],
) -> list[Path]:
    """Write all files of a run, or none, and return the paths written."""
    from ..report import Origin, write_page

    # All files appear together, so that the report always belongs to the calibration.
    with file_transaction(out, tuple(_RESULT_FILES)) as folder:
        _save_calibrations(result, folder, run, given)
        write_page(
            folder / "report.html",
            result.fit,
            result.data,
            result.held_out_reports,
            Origin(result.name, shlex.join(["smartview", *sys.argv[1:]]), run, given),
            progress,
            result.split_half,
            result.budget,
            result.remarks,
        )
    return [out / file for file in _RESULT_FILES if (out / file).is_file()]


def _save_calibrations(result: "CalibrateResult", folder: Path, run: str, given: str) -> None:
    """Write the calibrations of a fit to a folder, by the names in `_RESULT_FILES`."""
    from ..calibration_pipeline import refit_uncorrected
    from ..dataset import picture_digests

    # A view without points has no digest.
    pictures = [digest for digest in picture_digests(result.data) if digest]
    fit = result.fit
    # Values that were given, not estimated, belong to the provenance of the numbers.
    source = f"{result.name}; given: {given}" if given else result.name
    fit.joint.save(folder / "calibration.yaml", run, source, result.warnings, pictures)
    fit.staged.calibration.save(folder / "calibration_staged.yaml", run, pictures=pictures)
    if fit.calibration.robot_error is not None:
        # With the robot's error corrected, the transforms alone do not predict best.
        uncorrected = refit_uncorrected(result.data, fit)
        uncorrected.save(folder / "calibration_uncorrected.yaml", run, pictures=pictures)
