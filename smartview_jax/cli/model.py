"""Define `smartview model`, which opens the editor of object models in a browser."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .load import load_views
from .options import DebugOption
from .terminal import errors_reported

if TYPE_CHECKING:
    from ..calibration import Calibration
    from ..joint import SavedEstimate


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
            help="The calibration, such as calibration.yaml; by default the one in the folder."
        ),
    ] = None,
    port: Annotated[
        int, typer.Option(help="Port of the page, such as 8765; 0 takes a free one.")
    ] = 0,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")
    ] = True,
    debug: DebugOption = False,
) -> None:
    """Model an object by clicking its features in several calibrated pictures.

    The page is served to this machine only. Every click is saved at once next to the model's file;
    the same command resumes where an earlier one ended.
    """
    with errors_reported(debug):
        from ..editor import ModelSession, serve

        names, pictures, command = load_views(dataset)
        target = out or dataset / "object.json"
        try:
            estimate, covariance = load_calibration(dataset, calibration)
            with ModelSession(
                estimate, command, pictures, names, target, covariance=covariance
            ) as session:
                for note in session.notes:
                    typer.echo(note)
                serve(session, port, lambda address: _announce(address, target, browser))
        except ImportError as error:
            # The user can install a missing extra: one line, no traceback.
            raise ValueError(str(error)) from error


def load_calibration(
    dataset: Path, calibration: Path | None
) -> "tuple[Calibration, SavedEstimate | None]":
    """Return the calibration of the option or of the folder, with its covariance if it has one."""
    from ..joint import load_with_uncertainty

    candidates = [dataset / "calibration.yaml", dataset / "calibration" / "calibration.yaml"]
    path_found = calibration or next((path for path in candidates if path.is_file()), None)
    if path_found is None:
        raise FileNotFoundError(
            f"{candidates[0]}: no such file; give a calibration by --calibration "
            "(smartview calibrate makes one)"
        )
    loaded, estimate = load_with_uncertainty(path_found)
    if estimate is None:
        typer.echo(f"{path_found} has no covariance: taken as exact", err=True)
    return loaded, estimate


def _announce(address: str, target: Path, browser: bool) -> None:
    """Print the page's address, and open it if requested."""
    import webbrowser

    typer.echo(f"the editor of {target} is at\n{address}\nCtrl-C stops it; all clicks are saved")
    if browser:
        webbrowser.open(address)
