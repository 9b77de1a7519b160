"""Where the target stands, roughly, as a person writes it: in `dataset.yaml` and on a command line.

    base_from_world: {translation: [0.45, -0.1, 0.05], yaw_pitch_roll_deg: [90, 0, 180]}

or with a `quaternion_wxyz`, as `calibration.yaml` has it. On a command line it is six numbers
between commas: x, y, z in metres, yaw, pitch, roll in degrees.
"""

from typing import Any

import numpy as np
from jaxlie import SE3

from ..calibration import mount_frames
from ..geometry import pose_codec, transform_from_dict

_ANGLES = "yaw_pitch_roll_deg"


def read_rough_pose(content: dict[str, Any], mount: str) -> SE3 | None:
    """Read the rough `holder_from_world` of a description; None where it has none.

    Raises:
        ValueError: numbers that are no pose, or the entry of the other mount.
    """
    name, other = (f"{frame}_from_world" for frame in reversed(mount_frames(mount)))
    if other in content:
        raise ValueError(f"{other}: the target of an {mount} camera is in the other frame: {name}")
    entry = content.get(name)
    if entry is None:
        return None
    known = ({"translation", _ANGLES}, {"translation", "quaternion_wxyz"})
    if not isinstance(entry, dict) or set(entry) not in known:
        raise ValueError(
            f"{name}: expected translation (m) and {_ANGLES} or quaternion_wxyz, found {entry!r}"
        )
    try:
        if _ANGLES not in entry:
            return transform_from_dict(name, entry)
        return _decoded(name, [*entry["translation"], *entry[_ANGLES]])
    except TypeError as error:
        raise ValueError(f"{name}: expected lists of numbers, found {entry!r}") from error


def parse_rough_pose(option: str, words: str) -> SE3:
    """Read x, y, z (m), yaw, pitch and roll (degrees) between commas.

    Args:
        option: the option's name, for the message.
        words: what was given.

    Raises:
        ValueError: not six finite numbers.
    """
    try:
        return _decoded(option, [float(word) for word in words.split(",")])
    except ValueError as error:
        raise ValueError(
            f"{option}: expected six numbers between commas, x,y,z (m),yaw,pitch,roll (degrees), "
            f"found {words!r}"
        ) from error


def _decoded(name: str, numbers: list[float]) -> SE3:
    row = np.array(numbers, dtype=float)
    if row.shape != (6,) or not np.isfinite(row).all():
        raise ValueError(f"{name}: expected six finite numbers, found {numbers}")
    return pose_codec("yaw_pitch_roll").decode(row, angle_unit="deg", labels=[name])
