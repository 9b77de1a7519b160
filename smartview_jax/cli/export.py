"""Define `smartview export`, which prints a calibration in another program's format."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

import smartview_jax as sv

from .. import schemas
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
from ..files import read_yaml
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
            "right.yaml, or the folder of a calibrated rig.",
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
        calibrations = _camera_files(calibrations)
        several = len(calibrations) > 1
        if several and to not in SEVERAL_CAMERAS:
            names = ", ".join(form.value for form in SEVERAL_CAMERAS)
            raise ValueError(f"--to {to.value}: expected one calibration; several go to {names}")
        if several and child is not None:
            raise ValueError("--child: the frames of several cameras have the names of their files")
        if arm is not None and to is not ExportFormat.ROBOT_URDF:
            raise ValueError("--arm: only with --to robot_urdf")
        names = [f"{path.stem}_optical_frame" for path in calibrations]
        if len(set(names)) < len(calibrations):
            raise ValueError("expected files of different names, one for each camera")
        if not several:
            names = [child or "camera_optical_frame"]
        exported = [
            # Plain numbers suffice: JAX would take longer to import than everything here.
            Exported(path, schemas.read_calibration_file(path), parent, name)
            for path, name in zip(calibrations, names, strict=True)
        ]
        if to is not ExportFormat.ROBOT_URDF:
            _note_corrections(exported, to)
            joined = several or to is ExportFormat.KALIBR
            text = _joined_text(exported, to) if joined else exported[0].text(to)
        else:
            text = exported[0].robot_text(arm)
        typer.echo(text, nl=False)


def _camera_files(paths: list[Path]) -> list[Path]:
    """Return the calibration files; of the folder of a calibrated rig, the files of its cameras."""
    files: list[Path] = []
    for path in paths:
        rigs = sorted(path.glob(f"*{sv.joint.JOINT_SUFFIX}")) if path.is_dir() else []
        for rig in rigs:
            content = schemas.validate_content(read_yaml(rig), schemas.CALIBRATED_RIG_SCHEMA, rig)
            files += [path / name for name in content.cameras.values()]
        files += [] if rigs else [path]
    return files


SEVERAL_CAMERAS = (
    ExportFormat.ROS,
    ExportFormat.ROS_LAUNCH,
    ExportFormat.URDF,
    ExportFormat.KALIBR,
)
"""The formats that hold several cameras."""

WITHOUT_ROBOT = (ExportFormat.CAMERA_INFO, ExportFormat.KALIBR)
"""The formats in which a correction of the robot's error would not matter."""


class Exported(NamedTuple):
    """A calibration file that is exported.

    Attributes:
        parent: name of the mount's frame; None for ROS's usual file.
        child: name of the camera's frame.
    """

    path: Path
    content: dict[str, Any]
    parent: str | None
    child: str

    def text(self, to: ExportFormat) -> str:
        """Return the calibration in a format."""
        content, pose, frame = self.content, self.mount_from_camera, self.frame
        if to is ExportFormat.CAMERA_INFO:
            return camera_info_text(content["camera"], self.lens(), "camera")
        if to is ExportFormat.OPENCV:
            poses = {
                name: pose_matrix(_pose(content[name])) for name in content if "_from_" in name
            }
            return opencv_text(content["camera"], self.lens(), poses)
        if to is ExportFormat.URDF:
            return f"{origin_text(pose_matrix(pose))}\n"
        if to is ExportFormat.EASY_HANDEYE:
            return easy_handeye_text(pose, content["mount"], frame, self.child, "smartview")
        if to is ExportFormat.ROS_LAUNCH:
            return static_transform_launch_text(pose, frame, self.child)
        return static_transform_text(pose, frame, self.child)

    @property
    def frame(self) -> str:
        """The name of the mount's frame."""
        return self.parent or MOUNT_FRAMES[self.content["mount"]]

    @property
    def mount_from_camera(self) -> np.ndarray:
        """The pose of the camera in its mount's frame."""
        fixed = self.content["mount"] == "eye_to_hand"
        return inverse_pose(_pose(self.content[f"camera_from_{'base' if fixed else 'tool'}"]))

    def lens(self) -> OpenCVDistortion:
        """Return the lens as OpenCV's model, or as the nearest file."""
        with errors_at(self.path):
            lens = opencv_distortion(self.content["camera"]["lens"])
        # OpenCV's nearest lens is fitted.
        return lens or sv.io.opencv_coefficients(sv.Calibration.load(self.path).camera)

    def rig_camera(self) -> RigCamera:
        """Return the camera as one of several on a mount."""
        content = self.content
        return RigCamera(content["camera"], self.lens(), content["mount"], self.mount_from_camera)

    def robot_text(self, arm: str | None) -> str:
        """Return the arm as the calibration found it, with its camera, as URDF."""
        loaded = sv.Calibration.load(self.path)
        # A fixed camera is on the base link, whose name does not change.
        if self.parent is not None and loaded.mount == "eye_to_hand":
            raise ValueError("--parent: with robot_urdf a fixed camera is on base_link")
        known = None if arm is None else named_arm(arm)
        return sv.io.robot_urdf(loaded, known, self.parent or "tool0", self.child)


def _joined_text(exported: list[Exported], to: ExportFormat) -> str:
    """Return the calibrations in a format that holds several."""
    if to is ExportFormat.KALIBR:
        return kalibr_camchain_text({file.path.stem: file.rig_camera() for file in exported})
    if to is ExportFormat.ROS_LAUNCH:
        frames = {
            file.path.stem: StaticTransform(file.mount_from_camera, file.frame, file.child)
            for file in exported
        }
        return launch_text(frames)
    named = to is ExportFormat.URDF
    return "".join(
        (f"<!-- {file.path.stem} -->\n" if named else "") + file.text(to) for file in exported
    )


def _note_corrections(exported: list[Exported], to: ExportFormat) -> None:
    """Print a note if the exported calibrations lose the correction of the robot's error."""
    corrected = any(file.content.get("robot_error") is not None for file in exported)
    if not corrected or to in WITHOUT_ROBOT:
        return
    # The note goes to stderr, because stdout may be redirected to the exported file.
    advice = "export calibration_uncorrected.yaml, which was fitted without the correction"
    if not exported[0].path.with_name("calibration_uncorrected.yaml").is_file():
        advice = "its transforms are the true ones, but predict worse without the correction"
    typer.echo(
        f"note: this calibration corrects the robot's error, but the exported one cannot; {advice}",
        err=True,
    )


def _pose(entry: dict[str, Any]) -> np.ndarray:
    """Return a transform of a file as seven numbers: quaternion, real part first, and m."""
    return np.array([*entry["quaternion_wxyz"], *entry["translation"]], dtype=float)
