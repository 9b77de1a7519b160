"""From where a data set's views saw the target, as a calibration has it."""

import dataclasses

import numpy as np
from jaxlie import SE3
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from ..calibration import Calibration
from ..dataset import Dataset
from ..geometry import ViewedRegion


def with_region(
    calibration: Calibration, data: Dataset, views: Int[np.ndarray, "used"] | None = None
) -> Calibration:
    """The calibration with the region from which these views saw the target.

    The bare chain says where the cameras stood: a robot's error does not matter here.

    Args:
        calibration: fitted to the data.
        data: what it was fitted to.
        views: indices of those that were used; by default of all that show points. Without any,
            and where the calibration is not finite, it comes back as it is.
    """
    used = data.usable_views(1) if views is None else views
    base_from_tool = _matrices(data.base_from_tool)[used]
    camera_from_mount = _matrices(calibration.camera_from_mount)
    holder_from_world = _matrices(calibration.holder_from_world)
    if not len(used) or not np.isfinite([camera_from_mount, holder_from_world]).all():
        return calibration
    in_hand = calibration.mount == "eye_in_hand"
    holder_from_mount = base_from_tool if in_hand else np.linalg.inv(base_from_tool)
    world_from_mount = np.linalg.inv(holder_from_world) @ holder_from_mount
    world_from_camera = world_from_mount @ np.linalg.inv(camera_from_mount)
    seen = np.asarray(data.visible)[used]
    points = float(calibration.target_scale) * np.asarray(data.points)[used][seen]
    tools = world_from_mount[:, :3, 3] if in_hand else None
    region = ViewedRegion.of(world_from_camera[:, :3, 3], points, tools)
    return dataclasses.replace(calibration, region=region)


def _matrices(poses: SE3) -> Float[np.ndarray, "*views 4 4"]:
    numbers = np.asarray(poses.wxyz_xyz)
    matrices = np.zeros((*numbers.shape[:-1], 4, 4))
    with np.errstate(invalid="ignore"):
        finite = np.isfinite(numbers).all(axis=-1, keepdims=True)
    # What is not finite stays so, where scipy would refuse it.
    quaternions = np.where(finite, numbers[..., :4], [1.0, 0.0, 0.0, 0.0])
    flat = Rotation.from_quat(quaternions.reshape(-1, 4)[:, [1, 2, 3, 0]]).as_matrix()
    matrices[..., :3, :3] = flat.reshape(*numbers.shape[:-1], 3, 3)
    matrices[..., :3, 3] = np.where(finite, numbers[..., 4:], np.nan)
    matrices[..., 3, 3] = 1.0
    return matrices
