"""Define `smartview model`, which opens the editor of object models in a browser."""

from pathlib import Path
from typing import Annotated

import typer

import smartview_jax as sv

from .load import NamedViews, RigOptions, load_calibrated_views, load_views
from .options import DebugOption, PageOptions, with_option_groups
from .terminal import errors_reported, print_lines


@with_option_groups
def model(
    dataset: Annotated[Path, typer.Argument(help="Data-set folder with pictures of the object.")],
    out: Annotated[
        Path | None,
        typer.Option(
            help="The model's file, such as block.json; by default object.json in the folder."
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="The calibration, such as calibration.yaml, or the folder of a calibrated rig; by "
            "default the one in the folder."
        ),
    ] = None,
    *,
    wanted: RigOptions,
    page: PageOptions,
    debug: DebugOption = False,
) -> None:
    """Model an object by clicking its features in several calibrated pictures.

    The page is served to this machine only. Every click is saved at once next to the model's file;
    the same command resumes where an earlier one ended.
    """
    with errors_reported(debug):
        views = load_views(dataset)
        target = out or dataset / "object.json"
        estimate, covariance = load_calibration(dataset, calibration, views, wanted)
        with sv.ModelSession(
            estimate, views.command, views.pictures, views.names, target, covariance=covariance
        ) as session:
            print_lines(*session.notes)
            announce = page.announcement(f"the editor of {target}", "all clicks are saved")
            sv.editor.serve(session, page.port, announce)


def load_calibration(
    dataset: Path, calibration: Path | None, views: NamedViews, wanted: RigOptions
) -> "tuple[sv.modeling.AnyCalibration, sv.joint.SavedEstimate | None]":
    """Return the calibration of the option or of the folder, with its covariance if it has one."""
    candidates = [
        place / file
        for file in ("calibration.yaml", sv.joint.RIG_FILE)
        for place in (dataset, dataset / "calibration")
    ]
    path_found = calibration or next((path for path in candidates if path.is_file()), None)
    if path_found is None:
        raise FileNotFoundError(
            f"{candidates[0]}: no such file; give a calibration by --calibration "
            "(smartview calibrate makes one)"
        )
    loaded, estimate, is_exact = load_calibrated_views(path_found, views, wanted)
    if is_exact:
        typer.echo(f"{path_found} has no covariance: taken as exact", err=True)
    return loaded, estimate
