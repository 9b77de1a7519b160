"""Joints and poses of robot_cal_tools' kinematic measurements: a positioner seen by a camera.

'<time stamp>': {camera_joints: [], target_joints: [rad, ...], pose: {x, y, z, qx, qy, qz, qw}}
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Float

from ..files import read_yaml

_FIELDS = ("qw", "qx", "qy", "qz", "x", "y", "z")


def read_robot_cal_kinematics(path: str | Path) -> tuple[Float[np.ndarray, "views joints"], SE3]:
    """Joints of the target's carrier, and `camera_from_target`, in the order of the file.

    Raises:
        ValueError: an entry that lacks a number, or a camera that moves.
        FileNotFoundError: the file is missing.
    """
    path = Path(path)
    joints, rows = [], []
    for name, entry in read_yaml(path).items():
        try:
            rows.append([float(entry["pose"][field]) for field in _FIELDS])
            joints.append([float(reading) for reading in entry["target_joints"]])
        except (KeyError, TypeError) as error:
            raise ValueError(f"{path}: entry {name}: {error} is missing") from error
        if entry.get("camera_joints"):
            raise ValueError(f"{path}: entry {name}: the camera has joints; only the target may")
    numbers = jnp.asarray(np.array(rows))
    rotation = SO3(numbers[:, :4]).normalize()
    return np.array(joints), SE3.from_rotation_and_translation(rotation, numbers[:, 4:])
