"""Define `smartview export`, which prints a calibration in another program's format."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import smartview_jax as sv

from ..argument_checks import errors_at
from ..export_text import (
    MOUNT_FRAMES,
    OpenCVDistortion,
    RigCamera,
    StaticTransform,
    camera_info_text,
    easy_handeye_text,
    inverse_pose,
    kalibr_camchain_text,
    launch_text,
    opencv_distortion,
    opencv_text,
    origin_text,
    pose_matrix,
    static_transform_launch_text,
    static_transform_text,
)
from .options import DebugOption
from .robot_commands import named_arm
from .terminal import errors_reported


class ExportFormat(StrEnum):
    """The formats that `export` writes."""

    ROS = "ros"
    ROS_LAUNCH = "ros_launch"
    CAMERA_INFO = "camera_info"
    URDF = "urdf"
    ROBOT_URDF = "robot_urdf"
    OPENCV = "opencv"
    KALIBR = "kalibr"
    EASY_HANDEYE = "easy_handeye"


def export(
    calibrations: Annotated[
        list[Path],
        typer.Argument(
            help="A calibration.yaml, or one for each of several cameras, such as left.yaml "
            "right.yaml.",
            metavar="CALIBRATION...",
        ),
    ],
    to: Annotated[
        ExportFormat,
        typer.Option(
            help="Format to write: the camera's pose for ROS (a command, or a launch file), for "
            "easy_handeye2 or as a URDF origin, the camera for ROS, everything for OpenCV, the "
            "calibrated arm with its camera (robot_urdf), or Kalibr's camchain.yaml."
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
        str | None,
        typer.Option(
            help="ROS frame of the camera, such as wrist_optical_frame; by default "
            "camera_optical_frame, and for several cameras left_optical_frame for left.yaml."
        ),
    ] = None,
    arm: Annotated[
        str | None,
        typer.Option(
            help="With robot_urdf, for a calibration that does not know its arm: a name, such as "
            "puma_560, or a .urdf file."
        ),
    ] = None,
    debug: DebugOption = False,
) -> None:
    """Print the calibration of one camera or of several in another program's format."""
    with errors_reported(debug):
        from ..schemas.calibration import read_calibration_file

        several = len(calibrations) > 1
        if several and to not in SEVERAL_CAMERAS:
            names = ", ".join(form.value for form in SEVERAL_CAMERAS)
            raise ValueError(f"--to {to.value}: expected one calibration; several go to {names}")
        if several and child is not None:
            raise ValueError("--child: the frames of several cameras have the names of their files")
        if arm is not None and to is not ExportFormat.ROBOT_URDF:
            raise ValueError("--arm: only with --to robot_urdf")
        children = {path: f"{path.stem}_optical_frame" for path in calibrations}
        if len(set(children.values())) < len(calibrations):
            raise ValueError("expected files of different names, one for each camera")
        if not several:
            children = {calibrations[0]: child or "camera_optical_frame"}
        # Plain numbers suffice: JAX would take longer to import than everything here.
        contents = {path: read_calibration_file(path) for path in calibrations}
        if to is ExportFormat.ROBOT_URDF:
            path = calibrations[0]
            typer.echo(_robot_text(path, arm, parent, children[path]), nl=False)
            return
        _note_corrections(contents, to)
        typer.echo(_exported_text(contents, children, to, parent), nl=False)


SEVERAL_CAMERAS = (
    ExportFormat.ROS,
    ExportFormat.ROS_LAUNCH,
    ExportFormat.URDF,
    ExportFormat.KALIBR,
)
"""The formats that hold several cameras."""

WITHOUT_ROBOT = (ExportFormat.CAMERA_INFO, ExportFormat.KALIBR)
"""The formats in which a correction of the robot's error would not matter."""


def _note_corrections(contents: dict[Path, dict[str, Any]], to: ExportFormat) -> None:
    """Print a note if the exported calibrations lose the correction of the robot's error."""
    corrected = any(content.get("robot_error") is not None for content in contents.values())
    if not corrected or to in WITHOUT_ROBOT:
        return
    # The note goes to stderr, because stdout may be redirected to the exported file.
    advice = "export calibration_uncorrected.yaml, which was fitted without the correction"
    if len(contents) > 1:
        advice = "its transforms are the true ones, but predict worse without the correction"
    typer.echo(
        f"note: this calibration corrects the robot's error, but the exported one cannot; {advice}",
        err=True,
    )


def _exported_text(
    contents: dict[Path, dict[str, Any]],
    children: dict[Path, str],
    to: ExportFormat,
    parent: str | None,
) -> str:
    """Return one calibration, or several, in a format.

    Args:
        contents: content of each calibration file.
        children: name of each camera's frame.
        to: the format.
        parent: name of the mount's frame; None for ROS's usual one.
    """
    if to is ExportFormat.ROS_LAUNCH and len(contents) > 1:
        return launch_text(
            {
                path.stem: StaticTransform(*_mounted(content, parent), children[path])
                for path, content in contents.items()
            }
        )
    if to is ExportFormat.KALIBR:
        return _camchain_text(contents)
    if to in (ExportFormat.CAMERA_INFO, ExportFormat.OPENCV):
        (path, content), *_ = contents.items()
        return _camera_text(path, content, to)
    texts = [_pose_text(content, to, parent, children[path]) for path, content in contents.items()]
    if to is ExportFormat.URDF and len(contents) > 1:
        texts = [
            f"<!-- {path.stem} -->\n{text}" for path, text in zip(contents, texts, strict=True)
        ]
    return "".join(texts)


def _mounted(content: dict[str, Any], parent: str | None) -> tuple[np.ndarray, str]:
    """Return the pose of the camera in its mount's frame, and the name of this frame."""
    mount = content["mount"]
    name = "camera_from_base" if mount == "eye_to_hand" else "camera_from_tool"
    return inverse_pose(_pose(content[name])), parent or MOUNT_FRAMES[mount]


def _camchain_text(contents: dict[Path, dict[str, Any]]) -> str:
    """Return the cameras as Kalibr's camchain."""
    return kalibr_camchain_text(
        {
            path.stem: RigCamera(
                content["camera"],
                _opencv_lens(path, content),
                content["mount"],
                _mounted(content, None)[0],
            )
            for path, content in contents.items()
        }
    )


def _pose_text(content: dict[str, Any], to: ExportFormat, parent: str | None, child: str) -> str:
    """Return the pose of the camera in its mount's frame, for ROS, easy_handeye2 or URDF."""
    mount_from_camera, frame = _mounted(content, parent)
    if to is ExportFormat.URDF:
        return f"{origin_text(pose_matrix(mount_from_camera))}\n"
    if to is ExportFormat.EASY_HANDEYE:
        return easy_handeye_text(mount_from_camera, content["mount"], frame, child, "smartview")
    if to is ExportFormat.ROS_LAUNCH:
        return static_transform_launch_text(mount_from_camera, frame, child)
    return static_transform_text(mount_from_camera, frame, child)


def _robot_text(path: Path, arm: str | None, parent: str | None, child: str) -> str:
    """Return the arm as the calibration found it, with its camera, as URDF."""
    loaded = sv.Calibration.load(path)
    on_hand = loaded.mount != "eye_to_hand"
    # A fixed camera is on the base link, whose name does not change.
    if parent is not None and not on_hand:
        raise ValueError("--parent: with robot_urdf a fixed camera is on base_link")
    tool = parent or "tool0"
    return sv.io.robot_urdf(loaded, None if arm is None else named_arm(arm), tool, child)


def _camera_text(path: Path, content: dict[str, Any], to: ExportFormat) -> str:
    """Return the camera for ROS, or the camera and both transforms for OpenCV."""
    camera, lens = content["camera"], _opencv_lens(path, content)
    if to is ExportFormat.CAMERA_INFO:
        return camera_info_text(camera, lens, "camera")
    names = [name for name in content if "_from_" in name]
    return opencv_text(camera, lens, {name: pose_matrix(_pose(content[name])) for name in names})


def _opencv_lens(path: Path, content: dict[str, Any]) -> OpenCVDistortion:
    """Return the lens of a calibration file as OpenCV's model, or as the nearest one."""
    with errors_at(path):
        lens = opencv_distortion(content["camera"]["lens"])
    if lens is None:
        # OpenCV's nearest lens is fitted.
        lens = sv.io.opencv_coefficients(sv.Calibration.load(path).camera)
    return lens


def _pose(entry: dict[str, Any]) -> np.ndarray:
    """Return a transform of a file as seven numbers: quaternion, real part first, and m."""
    return np.array([*entry["quaternion_wxyz"], *entry["translation"]], dtype=float)
