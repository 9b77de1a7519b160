"""Read kinematic measurements of robot_cal_tools: a camera observes a target on a positioner.

'<time stamp>': {camera_joints: [], target_joints: [rad, ...], pose: {x, y, z, qx, qy, qz, qw}}
"""

from pathlib import Path

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..files import read_yaml
from ..geometry import pose_codec

_POSE_KEYS = ("x", "y", "z", "qw", "qx", "qy", "qz")


def read_robot_cal_kinematics(path: str | Path) -> tuple[Float[np.ndarray, "views joints"], SE3]:
    """Read the positioner's joint readings (rad) and `camera_from_target`, in the file's order.

    Raises:
        ValueError: an entry lacks a number, or the camera has joints.
        FileNotFoundError: the file is missing.
    """
    from ..schemas.external_formats import KINEMATIC_MEASUREMENTS_SCHEMA
    from ..schemas.validation import validate_content

    path = Path(path)
    measurements = validate_content(read_yaml(path), KINEMATIC_MEASUREMENTS_SCHEMA, path)
    for name, entry in measurements.items():
        if entry.camera_joints:
            raise ValueError(f"{path}: entry {name}: the camera has joints; only the target may")
    joints = [entry.target_joints for entry in measurements.values()]
    if len({len(row) for row in joints}) != 1:
        raise ValueError(f"{path}: target_joints: entries have different numbers of joints")
    rows = [[getattr(entry.pose, key) for key in _POSE_KEYS] for entry in measurements.values()]
    try:
        poses = pose_codec("quaternion_wxyz").decode(
            np.array(rows), labels=list(map(str, measurements))
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return np.array(joints), poses
