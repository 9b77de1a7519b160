"""Define `smartview new`, which begins a data-set folder for one's own robot and target."""

from pathlib import Path
from typing import Annotated

import typer

from .options import DebugOption
from .terminal import errors_reported

DEFAULT_SIZE = (1280, 1024)
"""Width and height that a description has until somebody knows better, px."""


def new(
    folder: Annotated[Path, typer.Argument(help="Folder of the new data set.")],
    robot: Annotated[
        str, typer.Option(help="abb, fanuc, kawasaki, kuka, puma, ros, ur, or matrix.")
    ] = "matrix",
    target: Annotated[
        str, typer.Option(help="chessboard, circle_grid, charuco or tag_grid.")
    ] = "charuco",
    eye_to_hand: Annotated[
        bool, typer.Option("--eye-to-hand", help="The camera stands, the target is on the tool.")
    ] = False,
    debug: DebugOption = False,
) -> None:
    """Begin a data set: a commented dataset.yaml and an empty poses.csv, to be filled in.

    What to do next is printed; `smartview check` then looks at what was filled in.
    """
    with errors_reported(debug):
        from ..io import write_new_dataset

        mount = "eye_to_hand" if eye_to_hand else "eye_in_hand"
        size = _picture_size(folder)
        path = write_new_dataset(folder, robot, target, mount, size or DEFAULT_SIZE)
        typer.echo(f"{path}: now")
        steps = [
            *([] if size else ["state the pictures' size in it"]),
            "measure the target and state its size in it: an error of 1 % there is one of 1 % in "
            "every distance",
            f"take 15 pictures or more into {folder / 'images'}, with the target filling half of "
            "each, tilted by up to 40 degrees to all sides and turned about the optical axis",
            f"write the robot's pose for each picture into {folder / 'poses.csv'}",
            f"smartview check {folder}",
            f"smartview calibrate {folder}",
        ]
        for number, step in enumerate(steps, start=1):
            typer.echo(f"  {number}. {step}")


def _picture_size(folder: Path) -> tuple[int, int] | None:
    """Return width and height of the first picture that is in the folder already, or None."""
    pictures = sorted((folder / "images").glob("*.*")) if (folder / "images").is_dir() else []
    if not pictures:
        return None
    from ..detection import read_picture

    rows, columns = read_picture(pictures[0]).shape[:2]
    return columns, rows
