"""From where a data set's views saw the target, as a calibration has it."""

import dataclasses

import numpy as np
from jaxtyping import Int

from ..calibration import Calibration
from ..dataset import Dataset
from ..geometry import ViewedRegion, host_matrices


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
    base_from_tool = host_matrices(data.base_from_tool)[used]
    camera_from_mount = host_matrices(calibration.camera_from_mount)
    holder_from_world = host_matrices(calibration.holder_from_world)
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
