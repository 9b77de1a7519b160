"""Define `smartview calibrate`, the main job: fit, judge, print, write the results."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..files import refuse_unwritable
from . import options
from .calibrate_folder import (
    RESULT_FILES,
    CalibrateSettings,
    calibrated_folder,
    loaded_folder,
    run_name,
    write_files,
)
from .calibrate_folders import calibrate_folders
from .calibrate_rig import calibrate_rig_folders
from .json_document import print_document
from .options import with_option_groups
from .terminal import errors_reported, progress_line

if TYPE_CHECKING:
    from ..dataset import Dataset


@with_option_groups
def calibrate(
    datasets: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Data-set folder, or several; a file of easy_handeye2's samples; the sample of "
            "the package if none is given.",
            metavar="[DATASET]...",
        ),
    ] = None,
    out: Annotated[
        Path,
        typer.Option(
            help="Folder for the results, such as calibration; of several folders, one by name "
            "in it."
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
    calibration_uncorrected.yaml is for programs that cannot apply the correction. Of several
    folders a table shows all; a folder that cannot be calibrated does not stop the others.
    Poses that a tracker measured may take the place of pictures; hand_eye.calib has the result.
    """
    with errors_reported(debug):
        # Several cameras: of one folder, or each in a folder of its own.
        if together or _has_cameras(datasets):
            if not calibrate_rig_folders(datasets or [], out, settings, json):
                raise typer.Exit(1)
            return
        if datasets is not None and len(datasets) > 1:
            code = calibrate_folders(datasets, out, settings, jobs, json)
            if code:
                raise typer.Exit(code)
            return
        dataset = datasets[0] if datasets else None
        # Checked first, so that minutes of fitting are not lost to a folder that is read-only.
        refuse_unwritable(out, "--out")
        with progress_line() as progress:
            data, name = loaded_folder(dataset, settings, progress)
        ends = _calibrate_poses if _has_tracked_poses(data) else _calibrate_pictures
        # The results are written, but a script must notice that the fit did not converge.
        if not ends(data, name, settings, out, json):
            raise typer.Exit(1)


def _has_cameras(folders: "list[Path] | None") -> bool:
    """Return whether the only data set is a folder with several cameras."""
    from ..io import is_rig_folder

    return folders is not None and len(folders) == 1 and is_rig_folder(folders[0])


def _has_tracked_poses(data: "Dataset") -> bool:
    """Return whether a data set has tracked poses in place of pictures."""
    from ..dataset import PoseDataset

    return isinstance(data, PoseDataset)


def _calibrate_pictures(
    data: "Dataset", name: str, settings: CalibrateSettings, out: Path, json: bool
) -> bool:
    """Calibrate pictures, print and write the results; return whether the fit converged."""
    from .calibrate_document import calibrate_document
    from .calibrate_tables import print_calibrate_result

    run = run_name()
    with progress_line() as progress:
        result, given = calibrated_folder(data, name, settings, progress)
    if not json:
        print_calibrate_result(result)
    with progress_line() as progress:
        files = write_files(result, out, run, given, progress)
    if json:
        print_document("calibrate", calibrate_document(result, run, given, files))
    else:
        _print_files(files, RESULT_FILES)
    return result.fit.result.converged


def _calibrate_poses(
    data: "Dataset", name: str, settings: CalibrateSettings, out: Path, json: bool
) -> bool:
    """Calibrate tracked poses, print and write the results; return whether the fit converged."""
    from ..dataset import PoseDataset
    from .calibrate_poses import (
        POSE_RESULT_FILES,
        calibrated_poses,
        pose_document,
        print_pose_result,
        write_pose_files,
    )

    run = run_name()
    assert isinstance(data, PoseDataset)
    with progress_line() as progress:
        result = calibrated_poses(data, name, settings, progress)
    if not json:
        print_pose_result(result)
    files = write_pose_files(result, out, run)
    if json:
        print_document("calibrate", pose_document(result, run, files))
    else:
        _print_files(files, POSE_RESULT_FILES)
    return result.fit.result.converged


def _print_files(files: "list[Path]", descriptions: dict[str, str]) -> None:
    """Print which files were written."""
    for file in files:
        typer.echo(f"{file}: {descriptions[file.name]}")
