"""Samples of easy_handeye2: pairs of a robot pose and a camera pose, without pictures."""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxlie import SE3

from ..calibration import mount_frames, mount_from_holder
from ..files import dump_yaml, read_yaml, write_atomically
from ..geometry import pose_codec

if TYPE_CHECKING:
    from ..schemas.imported import TransformMessage

_CODEC = pose_codec("quaternion_xyzw")
_NUMBERS = tuple(("translation", k) for k in "xyz") + tuple(("rotation", k) for k in "xyzw")


class PoseSamples(NamedTuple):
    """Poses of robot and camera that belong together, `(samples)` each.

    There are no pixels in them, so they go to the hand-eye step alone:
    `solve_hand_eye(samples.mount_from_holder, samples.camera_from_world)`.

    Attributes:
        base_from_tool: what the robot reported.
        camera_from_world: what a tracker made of its marker.
        mount: where the camera is.
    """

    base_from_tool: SE3
    camera_from_world: SE3
    mount: str

    @property
    def mount_from_holder(self) -> SE3:
        """The robot's part of the chain, between the camera's mount and the target's holder."""
        return mount_from_holder(self.mount, self.base_from_tool)


def read_easy_handeye(path: str | Path, mount: str = "eye_in_hand") -> PoseSamples:
    """A `.samples` file of easy_handeye2.

    Args:
        path: of the file.
        mount: as the samples were taken (`calibration_type`); the file does not say. For a camera
            beside the arm easy_handeye stores the robot's pose inverted, which is undone here.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: no samples, or one without its transforms; named by its number from 0.
    """
    from ..schemas.imported import SAMPLES
    from ..schemas.reading import checked

    mount_frames(mount)
    samples = checked(read_yaml(path), SAMPLES, path).samples
    robot = _decoded(path, "robot", [sample.robot for sample in samples])
    tracking = _decoded(path, "tracking", [sample.tracking for sample in samples])
    # What is stored is holder_from_mount, whatever the mount.
    return PoseSamples(mount_from_holder(mount, robot.inverse()), tracking, mount)


def write_easy_handeye(path: str | Path, samples: PoseSamples) -> None:
    """The inverse of `read_easy_handeye`."""
    robot = samples.mount_from_holder.inverse()
    pairs = zip(_CODEC.encode(robot), _CODEC.encode(samples.camera_from_world), strict=True)
    content = [{"robot": _message(r), "tracking": _message(t)} for r, t in pairs]
    write_atomically(path, dump_yaml({"samples": content}))


def _decoded(path: str | Path, which: str, transforms: "list[TransformMessage]") -> SE3:
    rows = [[getattr(getattr(one, part), k) for part, k in _NUMBERS] for one in transforms]
    try:
        return _CODEC.decode(np.array(rows))
    except ValueError as error:
        raise ValueError(f"{path}: {which}: {error}") from error


def _message(row: np.ndarray) -> dict[str, dict[str, float]]:
    message: dict[str, dict[str, float]] = {"translation": {}, "rotation": {}}
    for (part, k), number in zip(_NUMBERS, row, strict=True):
        message[part][k] = float(number)
    return message
