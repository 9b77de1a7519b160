"""Define `smartview export`, which prints a calibration in another program's format."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from .options import DebugOption
from .terminal import errors_reported


class ExportFormat(StrEnum):
    """The formats that `export` writes."""

    ROS = "ros"
    CAMERA_INFO = "camera_info"
    URDF = "urdf"
    OPENCV = "opencv"


def export(
    calibration: Annotated[Path, typer.Argument(help="A calibration.yaml.")],
    to: Annotated[ExportFormat, typer.Option(help="Format to write.")],
    parent: Annotated[
        str | None,
        typer.Option(
            help="ROS frame of the mount; by default tool0, or base_link for a fixed camera."
        ),
    ] = None,
    child: Annotated[str, typer.Option(help="ROS frame of the camera.")] = "camera_optical_frame",
    debug: DebugOption = False,
) -> None:
    """Print a calibration in another program's format."""
    with errors_reported(debug):
        from .. import io
        from ..calibration import Calibration

        # The note goes to stderr, because stdout may be redirected to the exported file.
        loaded_calibration = Calibration.load(calibration)
        if loaded_calibration.robot_error is not None and to is not ExportFormat.CAMERA_INFO:
            typer.echo(
                "note: this calibration corrects the robot's error, but the exported one cannot; "
                "export calibration_uncorrected.yaml, which was fitted without the correction",
                err=True,
            )
        if to is ExportFormat.ROS:
            frame = parent or (
                "tool0" if loaded_calibration.mount == "eye_in_hand" else "base_link"
            )
            text = io.ros_static_transform(loaded_calibration, frame, child)
        elif to is ExportFormat.CAMERA_INFO:
            text = io.ros_camera_info(loaded_calibration)
        elif to is ExportFormat.URDF:
            text = io.urdf_origin(loaded_calibration)
        else:
            text = io.opencv_yaml(loaded_calibration)
        typer.echo(text, nl=False)
