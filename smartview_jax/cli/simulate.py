"""Define `smartview simulate`, which writes a data set whose truth is known."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

import smartview_jax as sv

from ..files import refuse_existing
from .options import DebugOption, PoseFormatOption, with_option_groups
from .terminal import errors_reported, progress_line

TRUTH_FILE = "truth.yaml"
"""The name of the file with the true calibration."""


@dataclass(frozen=True)
class ErrorSizes:
    """The options that say how large the simulated errors are."""

    pixel_noise: Annotated[
        float, typer.Option(min=0.0, help="Standard deviation of u and of v, px, such as 0.2.")
    ] = 0.15
    position_noise: Annotated[
        float,
        typer.Option(min=0.0, help="Standard deviation of reported positions, mm, such as 0.3."),
    ] = 0.1
    angle_noise: Annotated[
        float,
        typer.Option(min=0.0, help="Standard deviation of reported angles, degrees, such as 0.05."),
    ] = 0.01
    outliers: Annotated[
        float,
        typer.Option(
            min=0.0, max=0.5, help="Fraction of points that are gross errors, such as 0.02."
        ),
    ] = 0.0


@with_option_groups
def simulate(
    folder: Annotated[Path, typer.Argument(help="Folder of the new data set.")],
    views: Annotated[int, typer.Option(min=3, max=1000, help="Number of views, such as 20.")] = 15,
    *,
    errors: ErrorSizes,
    pictures: Annotated[
        bool, typer.Option("--pictures", help="Render pictures, with sensor noise.")
    ] = False,
    pose_format: PoseFormatOption = "matrix",
    seed: Annotated[
        int,
        typer.Option(help="Random seed, a number such as 3: the same seed gives the same data."),
    ] = 0,
    debug: DebugOption = False,
) -> None:
    """Write a simulated data set of a chessboard seen by the paper's camera, and the truth.

    To test a calibration: smartview calibrate FOLDER, then compare its calibration.yaml with
    truth.yaml.
    """
    with errors_reported(debug):
        refuse_existing(folder, [sv.io.DESCRIPTION_FILE])
        sv.geometry.pose_codec(pose_format)
        board = sv.targets.Chessboard(9, 6, 0.004)
        scene = sv.simulation.random_target_scene(
            seed,
            views,
            board,
            pixel_noise=errors.pixel_noise,
            translation_noise=1e-3 * errors.position_noise,
            rotation_noise=math.radians(errors.angle_noise),
            outlier_fraction=errors.outliers,
        )
        with progress_line() as progress:
            if pictures:
                progress(f"rendering {views} pictures")
                sv.simulation.write_pictures(
                    folder,
                    scene.calibration,
                    scene.base_from_tool,
                    board,
                    reported_poses=scene.data.base_from_tool,
                    pose_format=pose_format,
                )
            else:
                sv.save_dataset(scene.data, folder, pose_format)
        scene.calibration.save(folder / TRUTH_FILE, source="simulated")
        typer.echo(f"{folder}: {views} views; {folder / TRUTH_FILE}: the truth")
