"""Read the target's approximate pose as written by hand in `dataset.yaml` or a command line.

    base_from_world: {translation: [0.45, -0.1, 0.05], yaw_pitch_roll_deg: [90, 0, 180]}

or with a `quaternion_wxyz` as in `calibration.yaml`. On a command line it is six numbers separated
by commas: x, y, z in metres, yaw, pitch, roll in degrees.
"""

from typing import TYPE_CHECKING

import numpy as np
from jaxlie import SE3

from ..geometry import pose_codec, transform_from_dict

if TYPE_CHECKING:
    from ..schemas.dataset import DatasetFile, RoughPose


def rough_pose(description: "DatasetFile") -> SE3 | None:
    """Return the approximate `holder_from_world` of a description, or None."""
    return rough_pose_of(description.base_from_world or description.tool_from_world)


def rough_pose_of(entry: "RoughPose | None") -> SE3 | None:
    """Return the pose that an entry describes, or None without one."""
    if entry is None:
        return None
    content = entry.model_dump()
    if "quaternion_wxyz" in content:
        return transform_from_dict("the target's rough pose", content)
    return _decode_pose(
        "the target's rough pose", [*content["translation"], *content["yaw_pitch_roll_deg"]]
    )


def parse_rough_pose(option: str, text: str) -> SE3:
    """Read an approximate pose from six numbers separated by commas.

    Args:
        option: name of the command-line option, for the error message.
        text: the text given: x, y, z (m), yaw, pitch, roll (degrees).

    Raises:
        ValueError: not six finite numbers.
    """
    try:
        return _decode_pose(option, [float(word) for word in text.split(",")])
    except ValueError as error:
        raise ValueError(
            f"{option}: expected six numbers between commas, x,y,z (m),yaw,pitch,roll (degrees), "
            f"found {text!r}"
        ) from error


def _decode_pose(name: str, numbers: list[float]) -> SE3:
    """Return the pose of x, y, z (m), yaw, pitch, roll (degrees); an error begins with the name."""
    row = np.array(numbers, dtype=float)
    if row.shape != (6,) or not np.isfinite(row).all():
        raise ValueError(f"{name}: expected six finite numbers, found {numbers}")
    return pose_codec("yaw_pitch_roll").decode(row, angle_unit="deg", labels=[name])
