"""Define `smartview calibrate`, the main job: fit, judge, print, write the results."""

from pathlib import Path
from typing import Annotated

import typer

from ..files import refuse_unwritable
from . import options
from .calibrate_folder import (
    RESULT_FILES,
    CalibrateSettings,
    calibrated_folder,
    run_name,
    write_files,
)
from .calibrate_folders import calibrate_folders
from .fit_options import FitKnowledge
from .json_document import print_document
from .option_groups import with_option_groups
from .terminal import errors_reported, progress_line


@with_option_groups
def calibrate(
    datasets: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Data-set folder, or several; the sample of the package if none is given.",
            metavar="[DATASET]...",
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option(help="Folder for the results; of several folders, one by name in it.")
    ] = Path("calibration"),
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
    jobs: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Folders to calibrate at the same time; by default as many as there are "
            "processors.",
        ),
    ] = None,
    json: options.JsonOption = False,
    debug: options.DebugOption = False,
) -> None:
    """Calibrate: staged and joint fit, a table, calibration.yaml and report.html.

    The staged fit is written to calibration_staged.yaml as well. If the robot's error is corrected,
    calibration_uncorrected.yaml is for programs that cannot apply the correction. Of several
    folders a table shows all; a folder that cannot be calibrated does not stop the others.
    """
    with errors_reported(debug):
        from .calibrate_document import calibrate_document
        from .calibrate_tables import print_calibrate_result

        settings = CalibrateSettings(
            lens, noise.value, held_out, diagnose, known, bad_views, base_from_world, time_offset
        )
        if datasets is not None and len(datasets) > 1:
            code = calibrate_folders(datasets, out, settings, jobs, json)
            if code:
                raise typer.Exit(code)
            return
        dataset = datasets[0] if datasets else None
        # Checked first, so that minutes of fitting are not lost to a folder that is read-only.
        refuse_unwritable(out, "--out")
        run = run_name()

        with progress_line() as progress:
            result, given = calibrated_folder(dataset, settings, progress)
        if not json:
            print_calibrate_result(result)
        with progress_line() as progress:
            files = write_files(result, out, run, given, progress)
        if json:
            print_document("calibrate", calibrate_document(result, run, given, files))
        else:
            for file in files:
                typer.echo(f"{file}: {RESULT_FILES[file.name]}")
        # The results are written, but a script must notice that the fit did not converge.
        if not result.fit.result.converged:
            raise typer.Exit(1)
