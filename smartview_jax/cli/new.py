"""Define `smartview new`, which begins a data-set folder for a robot and a target."""

from pathlib import Path
from typing import Annotated

import typer

from .options import DebugOption
from .terminal import errors_reported

DEFAULT_SIZE = (1280, 1024)
"""Width and height in a new description, px; to be replaced by the real ones."""


def new(
    folder: Annotated[Path, typer.Argument(help="Folder of the new data set.")],
    robot: Annotated[
        str,
        typer.Option(
            help="The robot's pose format, such as ur: abb, fanuc, kawasaki, kuka, puma, ros, ur, "
            "or matrix."
        ),
    ] = "matrix",
    target: Annotated[
        str,
        typer.Option(
            help="The target, such as chessboard: chessboard, circle_grid, charuco, tag_grid, or "
            "Kalibr's aprilgrid."
        ),
    ] = "charuco",
    eye_to_hand: Annotated[
        bool, typer.Option("--eye-to-hand", help="Fixed camera; the target is on the tool.")
    ] = False,
    debug: DebugOption = False,
) -> None:
    """Begin a data set: a commented dataset.yaml and an empty poses.csv, to be filled in.

    The next steps are printed; `smartview check` then checks what was filled in.
    """
    with errors_reported(debug):
        from ..io import found_pictures, write_new_dataset

        mount = "eye_to_hand" if eye_to_hand else "eye_in_hand"
        pictures = found_pictures(folder)
        size = pictures.image_size if pictures else DEFAULT_SIZE
        suffix = pictures.suffix if pictures else ".png"
        path = write_new_dataset(folder, robot, target, mount, size, suffix)
        images = folder / "images"
        if pictures:
            count = pictures.picture_count
            typer.echo(f"{images}: {count} pictures named *{suffix}, {size[0]} x {size[1]} px")
            if pictures.others:
                typer.echo(f"{images}: other files: {', '.join(pictures.others[:5])}")
        typer.echo(f"{path}: written; next steps:")
        steps = [
            *([] if pictures else [f"write the pictures' size and suffix into {path}"]),
            f"measure the target and write its size into {path}: a 1 % error there makes a 1 % "
            "error in every distance",
            f"take 15 pictures or more into {images}, with the target filling half of each, tilted "
            "by up to 40 degrees to all sides and turned about the optical axis",
            f"write the robot's pose for each picture into {folder / 'poses.csv'}",
            f"smartview check {folder}",
            f"smartview calibrate {folder}",
        ]
        for number, step in enumerate(steps, start=1):
            typer.echo(f"  {number}. {step}")
