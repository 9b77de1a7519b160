"""Read the texts that name a camera and a robot, such as 0 and tcp:192.168.0.10:5000."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from ..capture import Camera, Reopened, Robot, SimulatedSources

SIMULATED = "simulated"
"""The name of the simulated cell's camera and robot."""


class Sources(NamedTuple):
    """The camera and the robot of a capture.

    Attributes:
        camera, robot: where pictures and poses are from.
        simulated: the simulated cell; None without one.
    """

    camera: "Reopened[Camera]"
    robot: "Reopened[Robot]"
    simulated: "SimulatedSources | None"


def open_sources(camera: str, robot: str, pose_format: str, folder: Path, seed: int) -> Sources:
    """Return the named camera and robot, which are opened when they are needed.

    Args:
        camera: text of `--camera`.
        robot: text of `--robot`.
        pose_format: format of the robot's poses; empty for the format of the folder's table.
        folder: the data set; the simulated cell begins it if it is new.
        seed: seed of the simulated cell.

    Raises:
        ImportError: an extra is not installed.
        ValueError: a text that names no source.
        OSError: the folder has no description.
    """
    from ..capture import Reopened, SimulatedSources

    simulated = None
    if SIMULATED in (camera, robot):
        if camera != robot:
            raise ValueError(f"--camera and --robot: expected both {SIMULATED}, or neither")
        simulated = SimulatedSources(seed)
        simulated.write_description(folder)
        return Sources(Reopened(simulated.camera), Reopened(simulated.robot), simulated)
    open_camera = _camera(camera, folder)
    return Sources(Reopened(open_camera), Reopened(_robot(robot, pose_format, folder)), simulated)


def _camera(text: str, folder: Path) -> "Callable[[], Camera]":
    """Return the function that opens a camera."""
    from ..capture import OpenCVCamera, PictureFolder, VideoFile

    if text.isdecimal():
        return lambda: OpenCVCamera(int(text))
    path = Path(text)
    if path.is_dir():
        # The folder's own pictures would be taken again.
        if path.resolve() == (folder / "images").resolve():
            raise ValueError(f"--camera: {path} is where the views are stored; name another folder")
        return lambda: PictureFolder(path)
    if path.is_file() or "://" in text:
        return lambda: VideoFile(text)
    raise ValueError(
        f"--camera: expected an index such as 0, a video file, the address of a stream, a folder "
        f"or {SIMULATED}, found {text!r}"
    )


def _robot(text: str, pose_format: str, folder: Path) -> "Callable[[], Robot]":
    """Return the function that connects to a robot."""
    from ..capture import TcpRobot, TypedRobot, UniversalRobot
    from ..extras import import_extra
    from ..geometry import pose_codec
    from ..io import GrowingDataset

    with GrowingDataset(folder) as data:
        named = pose_format or data.pose_format.codec.name
    pose_codec(named)
    kind, _, address = text.partition(":")
    if text == "typed":
        robot = TypedRobot(named)
        return lambda: robot
    if kind == "ur" and address:
        import_extra("rtde_receive", "ur", "a Universal Robots arm")
        return lambda: UniversalRobot(address)
    host, _, port = address.rpartition(":")
    kinds: dict[str, Any] = {"tcp": TcpRobot.connect, "listen": TcpRobot.accept}
    if kind not in kinds or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ValueError(
            f"--robot: expected tcp:HOST:PORT, listen:HOST:PORT, ur:HOST, {SIMULATED} or typed, "
            f"found {text!r}"
        )
    return lambda: kinds[kind](host, int(port), named)
