"""Define `smartview export`, which prints a calibration in another program's format."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .options import DebugOption
from .terminal import errors_reported

if TYPE_CHECKING:
    import numpy as np


class ExportFormat(StrEnum):
    """The formats that `export` writes."""

    ROS = "ros"
    ROS_LAUNCH = "ros_launch"
    CAMERA_INFO = "camera_info"
    URDF = "urdf"
    ROBOT_URDF = "robot_urdf"
    OPENCV = "opencv"
    EASY_HANDEYE = "easy_handeye"


def export(
    calibration: Annotated[Path, typer.Argument(help="A calibration.yaml.")],
    to: Annotated[
        ExportFormat,
        typer.Option(
            help="Format to write: the camera's pose for ROS (a command, or a launch file), for "
            "easy_handeye2 or as a URDF origin, the camera for ROS, everything for OpenCV, or the "
            "calibrated arm with its camera (robot_urdf)."
        ),
    ],
    parent: Annotated[
        str | None,
        typer.Option(
            help="ROS frame of the mount, such as flange; by default tool0, or base_link for a "
            "fixed camera."
        ),
    ] = None,
    child: Annotated[
        str, typer.Option(help="ROS frame of the camera, such as camera_optical_frame.")
    ] = "camera_optical_frame",
    arm: Annotated[
        str | None,
        typer.Option(
            help="With robot_urdf, for a calibration that does not know its arm: a name, such as "
            "puma_560, or a .urdf file."
        ),
    ] = None,
    debug: DebugOption = False,
) -> None:
    """Print a calibration in another program's format."""
    with errors_reported(debug):
        from ..schemas.calibration import read_calibration_file

        # Plain numbers suffice: JAX would take longer to import than everything here.
        content = read_calibration_file(calibration)
        if to is ExportFormat.ROBOT_URDF:
            typer.echo(_robot_text(calibration, arm, parent, child), nl=False)
            return
        if arm is not None:
            raise ValueError("--arm: only with --to robot_urdf")
        # The note goes to stderr, because stdout may be redirected to the exported file.
        if content.get("robot_error") is not None and to is not ExportFormat.CAMERA_INFO:
            typer.echo(
                "note: this calibration corrects the robot's error, but the exported one cannot; "
                "export calibration_uncorrected.yaml, which was fitted without the correction",
                err=True,
            )
        if to not in (ExportFormat.CAMERA_INFO, ExportFormat.OPENCV):
            text = _pose_text(content, to, parent, child)
        else:
            text = _camera_text(calibration, content, to)
        typer.echo(text, nl=False)


def _pose_text(content: dict[str, Any], to: ExportFormat, parent: str | None, child: str) -> str:
    """Return the pose of the camera in its mount's frame, for ROS, easy_handeye2 or URDF."""
    from ..export_text import (
        MOUNT_FRAMES,
        easy_handeye_text,
        inverse_pose,
        origin_text,
        pose_matrix,
        static_transform_launch_text,
        static_transform_text,
    )

    mount = content["mount"]
    name = "camera_from_tool" if mount == "eye_in_hand" else "camera_from_base"
    frame = parent or MOUNT_FRAMES[mount]
    mount_from_camera = inverse_pose(_pose(content[name]))
    if to is ExportFormat.URDF:
        return f"{origin_text(pose_matrix(mount_from_camera))}\n"
    if to is ExportFormat.EASY_HANDEYE:
        return easy_handeye_text(mount_from_camera, mount, frame, child, "smartview")
    if to is ExportFormat.ROS_LAUNCH:
        return static_transform_launch_text(mount_from_camera, frame, child)
    return static_transform_text(mount_from_camera, frame, child)


def _robot_text(path: Path, arm: str | None, parent: str | None, child: str) -> str:
    """Return the arm as the calibration found it, with its camera, as URDF."""
    from ..calibration import Calibration
    from ..io import robot_urdf
    from .robot_commands import named_arm

    loaded = Calibration.load(path)
    on_hand = loaded.mount == "eye_in_hand"
    # A fixed camera is on the base link, whose name does not change.
    if parent is not None and not on_hand:
        raise ValueError("--parent: with robot_urdf a fixed camera is on base_link")
    tool = parent or "tool0"
    return robot_urdf(loaded, None if arm is None else named_arm(arm), tool, child)


def _camera_text(path: Path, content: dict[str, Any], to: ExportFormat) -> str:
    """Return the camera for ROS, or the camera and both transforms for OpenCV."""
    from ..export_text import camera_info_text, opencv_distortion, opencv_text, pose_matrix

    camera = content["camera"]
    try:
        lens = opencv_distortion(camera["lens"])
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if lens is None:
        from ..calibration import Calibration
        from ..io import opencv_coefficients

        # OpenCV's nearest lens is fitted.
        lens = opencv_coefficients(Calibration.load(path).camera)
    if to is ExportFormat.CAMERA_INFO:
        return camera_info_text(camera, lens, "camera")
    names = [name for name in content if "_from_" in name]
    return opencv_text(camera, lens, {name: pose_matrix(_pose(content[name])) for name in names})


def _pose(entry: dict[str, Any]) -> "np.ndarray":
    """Return a transform of a file as seven numbers: quaternion, real part first, and m."""
    import numpy as np

    return np.array([*entry["quaternion_wxyz"], *entry["translation"]], dtype=float)
