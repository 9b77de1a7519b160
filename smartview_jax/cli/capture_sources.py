"""Read the texts that name a camera and a robot, such as 0 and tcp:192.168.0.10:5000."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

import smartview_jax as sv

from ..extras import import_extra
from .options import PoseFormatOption

SIMULATED = "simulated"
"""The name of the simulated cell's camera and robot."""


class Program(StrEnum):
    """The programs for controllers that the command prints."""

    KRL = "krl"
    RAPID = "rapid"
    URSCRIPT = "urscript"
    VAL3 = "val3"
    ROS2 = "ros2"


@dataclass(frozen=True)
class SourceOptions:
    """The options that name the camera and the robot."""

    camera: Annotated[
        str,
        typer.Option(
            help="Source of pictures, such as 0: OpenCV's index of a camera, a video file or the "
            "address of a stream, a folder that fills up with pictures, or simulated."
        ),
    ] = "0"
    robot: Annotated[
        str,
        typer.Option(
            help="Source of poses, such as tcp:192.168.0.10:5000 (the controller listens), "
            "listen:192.168.0.100:5000 (it connects to this machine's address), ur:192.168.0.10 "
            "(Universal Robots), simulated, or typed (a person types or pastes each pose)."
        ),
    ] = "typed"
    pose_format: PoseFormatOption = ""
    seed: Annotated[
        int, typer.Option(help="Random seed of the simulated cell, a number such as 3.")
    ] = 0
    print_program: Annotated[
        Program | None,
        typer.Option(
            help="Only print a program for the controller that answers tcp: or listen:, or a node "
            "for ROS 2."
        ),
    ] = None


class Sources(NamedTuple):
    """The camera and the robot of a capture, and the simulated cell that they belong to, if any."""

    camera: "sv.capture.Reopened[sv.capture.Camera]"
    robot: "sv.capture.Reopened[sv.capture.Robot]"
    simulated: "sv.capture.SimulatedSources | None"


def open_sources(named: SourceOptions, folder: Path) -> Sources:
    """Return the named camera and robot, which are opened when they are needed.

    Without a pose format the folder's table states it; a simulated cell begins a new folder.
    """
    simulated = None
    if SIMULATED in (named.camera, named.robot):
        if named.camera != named.robot:
            raise ValueError(f"--camera and --robot: expected both {SIMULATED}, or neither")
        simulated = sv.capture.SimulatedSources(named.seed)
        simulated.write_description(folder)
        return Sources(
            sv.capture.Reopened(simulated.camera), sv.capture.Reopened(simulated.robot), simulated
        )
    open_camera = _camera(named.camera, folder)
    open_robot = _robot(named.robot, named.pose_format, folder)
    return Sources(sv.capture.Reopened(open_camera), sv.capture.Reopened(open_robot), simulated)


def _camera(text: str, folder: Path) -> "Callable[[], sv.capture.Camera]":
    """Return the function that opens a camera."""
    if text.isdecimal():
        return lambda: sv.capture.OpenCVCamera(int(text))
    path = Path(text)
    if path.is_dir():
        # The folder's own pictures would be taken again.
        if path.resolve() == (folder / "images").resolve():
            raise ValueError(f"--camera: {path} is where the views are stored; name another folder")
        return lambda: sv.capture.PictureFolder(path)
    if path.is_file() or "://" in text:
        return lambda: sv.capture.VideoFile(text)
    raise ValueError(
        f"--camera: expected an index such as 0, a video file, the address of a stream, a folder "
        f"or {SIMULATED}, found {text!r}"
    )


def _robot(text: str, pose_format: str, folder: Path) -> "Callable[[], sv.capture.Robot]":
    """Return the function that connects to a robot."""
    with sv.io.GrowingDataset(folder) as data:
        named = pose_format or data.pose_format.codec.name
    sv.geometry.pose_codec(named)
    kind, _, address = text.partition(":")
    if text == "typed":
        robot = sv.capture.TypedRobot(named)
        return lambda: robot
    if kind == "ur" and address:
        import_extra("rtde_receive", "ur", "a Universal Robots arm")
        return lambda: sv.capture.UniversalRobot(address)
    host, _, port = address.rpartition(":")
    kinds: dict[str, Any] = {
        "tcp": sv.capture.TcpRobot.connect,
        "listen": sv.capture.TcpRobot.accept,
    }
    if kind not in kinds or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ValueError(
            f"--robot: expected tcp:HOST:PORT, listen:HOST:PORT, ur:HOST, {SIMULATED} or typed, "
            f"found {text!r}"
        )
    return lambda: kinds[kind](host, int(port), named)
