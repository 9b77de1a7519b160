"""Define `smartview calibrate`, the main job: fit, judge, print, write the results."""

from pathlib import Path
from typing import Annotated

import typer

import smartview_jax as sv

from ..files import refuse_unwritable
from . import options
from .calibrate_folder import CalibrateSettings
from .calibrate_folders import calibrate_folders, fitted_folder
from .calibrate_result import run_name
from .calibrate_rig import fitted_rig, loaded_rig
from .documents import print_document
from .options import with_option_groups
from .terminal import errors_reported, progress_line


@with_option_groups
def calibrate(
    datasets: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Data-set folder or file of easy_handeye2's samples, or several; the sample of "
            "the package if none is given.",
        ),
    ] = None,
    out: Annotated[
        Path,
        typer.Option(
            help="Folder for the results, such as calibration; with several data sets, each has "
            "a folder of its own name in it."
        ),
    ] = Path("calibration"),
    *,
    settings: CalibrateSettings,
    jobs: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of folders to calibrate at the same time, such as 4; by default as many "
            "as there are processors.",
        ),
    ] = None,
    together: Annotated[
        bool,
        typer.Option(
            "--together",
            help="Several folders are cameras that watched one robot, such as left right: one fit "
            "of all. Views of the same name have the same pose.",
        ),
    ] = False,
    json: options.JsonOption = False,
    debug: options.DebugOption = False,
) -> None:
    """Calibrate: staged and joint fit, a table, calibration.yaml and report.html.

    The staged fit is written to calibration_staged.yaml as well. If the robot's error is corrected,
    calibration_uncorrected.yaml is for programs that cannot apply the correction. Several folders
    are calibrated one by one and shown in a table; one that fails does not stop the others.
    Instead of pictures, a file may give the target's poses that a tracker measured; the result is
    then hand_eye.calib.
    """
    with errors_reported(debug):
        folders = datasets or []
        # Several cameras: of one folder, or each in a folder of its own.
        is_rig = together or (len(folders) == 1 and sv.io.is_rig_folder(folders[0]))
        if len(folders) > 1 and not is_rig:
            raise typer.Exit(calibrate_folders(folders, out, settings, jobs, json))
        # Checked first, so that minutes of fitting are not lost to a folder that is read-only.
        refuse_unwritable(out, "--out")
        run = run_name()
        with progress_line() as progress:
            if is_rig:
                result = fitted_rig(*loaded_rig(folders, settings, progress), settings, progress)
            else:
                result = fitted_folder(folders[0] if folders else None, settings, progress)
        if not json:
            result.print()
        with progress_line() as progress:
            files = result.write(out, run, progress)
        if json:
            print_document("calibrate", result.document(run, list(files)))
        else:
            for file, text in files.items():
                typer.echo(f"{file}: {text}")
        # The results are written, but a script must notice that the fit did not converge.
        if not result.converged:
            raise typer.Exit(1)
