"""Read and write easy_handeye2's files: samples, and the calibration that it publishes.

A sample is a pair of a robot pose and the tracked pose of a marker.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxlie import SE3

from .. import schemas
from ..argument_checks import errors_at
from ..calibration import Calibration, mount_frames, mount_from_holder
from ..export_text import easy_handeye_text
from ..files import dump_yaml, write_atomically
from ..geometry import pose_codec
from .export import mount_from_camera

_CODEC = pose_codec("quaternion_xyzw")
_TRANSFORM_COMPONENTS = tuple(("translation", k) for k in "xyz") + tuple(
    ("rotation", k) for k in "xyzw"
)


class PoseSamples(NamedTuple):
    """Pairs of a robot pose and a marker pose, taken at the same time, `(samples)` each.

    They contain no pixels; `fit_poses` fits the hand-eye transform to them.

    Attributes:
        base_from_tool: poses that the robot reported.
        camera_from_world: poses of the marker that the tracker measured.
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
    """

    base_from_tool: SE3
    camera_from_world: SE3
    mount: str

    @property
    def mount_from_holder(self) -> SE3:
        """The robot's part of the chain: `tool_from_base`, or `base_from_tool` for eye-to-hand."""
        return mount_from_holder(self.mount, self.base_from_tool)


def read_easy_handeye(path: str | Path, mount: str = "eye_in_hand") -> PoseSamples:
    """Read a `.samples` file of easy_handeye2.

    Args:
        mount: `"eye_in_hand"` or `"eye_to_hand"`, as the samples were taken (`calibration_type`);
            the file does not contain it. For a fixed camera easy_handeye stores the inverse of the
            robot's pose, which is undone here.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: no samples, or a sample without its transforms, named by its number from 0.
    """
    mount_frames(mount)
    samples = schemas.read_validated(path, schemas.SAMPLES_SCHEMA).samples
    robot = _decode_transforms(path, "robot", [sample.robot for sample in samples])
    tracking = _decode_transforms(path, "tracking", [sample.tracking for sample in samples])
    # The file has holder_from_mount: base_from_tool for eye-in-hand, tool_from_base otherwise.
    return PoseSamples(mount_from_holder(mount, robot.inverse()), tracking, mount)


def write_easy_handeye(path: str | Path, samples: PoseSamples) -> None:
    """Write samples in the format of easy_handeye2, which `read_easy_handeye` reads.

    Raises:
        ValueError: no samples, or a value with which the file could not be read back.
    """
    robot = samples.mount_from_holder.inverse()
    pairs = zip(_CODEC.encode(robot), _CODEC.encode(samples.camera_from_world), strict=True)
    content = [
        {"robot": _transform_message(r), "tracking": _transform_message(t)} for r, t in pairs
    ]
    schemas.refuse_unreadable({"samples": content}, schemas.SAMPLES_SCHEMA, path)
    # Always YAML, whatever the file's ending, as easy_handeye writes it.
    write_atomically(path, dump_yaml({"samples": content}))


def easy_handeye_calibration(
    calibration: Calibration,
    parent: str,
    child: str,
    name: str = "smartview",
    optical: bool = True,
) -> str:
    """Return a `.calib` file, whose transform easy_handeye2's publisher sends to ROS.

    Args:
        calibration: its hand-eye transform is published.
        parent: frame of the mount: the robot's tool, or its base for a fixed camera.
        child: frame of the camera.
        name: name of the calibration, which is the file's name in easy_handeye2's folder.
        optical: as in `mount_from_camera`.

    Raises:
        ValueError: a name that ROS does not accept.
    """
    pose = mount_from_camera(calibration, optical)
    return easy_handeye_text(pose, calibration.mount, parent, child, name)


def _decode_transforms(
    path: str | Path, entry: str, transforms: "list[schemas.TransformMessage]"
) -> SE3:
    """Return the messages as poses; an error names the file and the entry."""
    rows = [
        [getattr(getattr(transform, part), k) for part, k in _TRANSFORM_COMPONENTS]
        for transform in transforms
    ]
    with errors_at(f"{path}: {entry}"):
        return _CODEC.decode(np.array(rows))


def _transform_message(row: np.ndarray) -> dict[str, dict[str, float]]:
    """Return one row of translation and quaternion as a ROS transform message."""
    message: dict[str, dict[str, float]] = {"translation": {}, "rotation": {}}
    for (part, k), number in zip(_TRANSFORM_COMPONENTS, row, strict=True):
        message[part][k] = float(number)
    return message
