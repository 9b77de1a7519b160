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
        typer.Option(help="The model's file, a .json; by default object.json in the folder."),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(help="A calibration.yaml; by default the one in the folder."),
    ] = None,
    port: Annotated[int, typer.Option(help="Port of the page; 0 takes a free one.")] = 0,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")
    ] = True,
    debug: DebugOption = False,
) -> None:
    """Model an object by clicking its features in several calibrated pictures.

    The page is on this machine only. Every click is kept at once beside the model's file, so that
    the same command goes on where an earlier one ended.
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
            # An extra that is not installed is for the user to install, not a fault to trace.
            raise ValueError(str(error)) from error


def load_calibration(
    dataset: Path, calibration: Path | None
) -> "tuple[Calibration, SavedEstimate | None]":
    """Return the calibration of the option or of the folder, with its covariance if it has one."""
    from ..joint import load_with_uncertainty

    candidates = [dataset / "calibration.yaml", dataset / "calibration" / "calibration.yaml"]
    found = calibration or next((path for path in candidates if path.is_file()), None)
    if found is None:
        raise FileNotFoundError(
            f"{candidates[0]}: no such file; name the camera's calibration by --calibration "
            "(smartview calibrate makes one)"
        )
    loaded, estimate = load_with_uncertainty(found)
    if estimate is None:
        typer.echo(f"{found} says nothing of its uncertainty: taken as exact", err=True)
    return loaded, estimate


def _announce(address: str, target: Path, browser: bool) -> None:
    """Print the page's address, and open it if that is wanted."""
    import webbrowser

    typer.echo(f"the editor of {target} is at\n{address}\nCtrl-C ends it; nothing is lost")
    if browser:
        webbrowser.open(address)
