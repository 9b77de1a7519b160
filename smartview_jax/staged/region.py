"""Add to a calibration the region from which its data saw the target."""

import dataclasses

import numpy as np
from jaxtyping import Int

from ..calibration import Calibration
from ..dataset import Dataset
from ..geometry import ViewedRegion, host_matrices


def with_region(
    calibration: Calibration, data: Dataset, views: Int[np.ndarray, "used"] | None = None
) -> Calibration:
    """Return the calibration with the region from which these views saw the target.

    Camera positions are computed by the chain without robot error; its size does not matter here.

    Args:
        calibration: fitted to the data.
        data: the data it was fitted to.
        views: indices of the views used; by default all views with visible points. If there is
            none, or the calibration is not finite, it is returned unchanged.
    """
    used = data.usable_views(1) if views is None else views
    base_from_tool = host_matrices(data.base_from_tool)[used]
    camera_from_mount = host_matrices(calibration.camera_from_mount)
    holder_from_world = host_matrices(calibration.holder_from_world)
    if not len(used) or not np.isfinite([camera_from_mount, holder_from_world]).all():
        return calibration
    in_hand = calibration.mount == "eye_in_hand"
    holder_from_mount = base_from_tool if in_hand else np.linalg.inv(base_from_tool)
    # Eq. 10 inverted, without the camera: world <- holder <- mount <- camera.
    world_from_mount = np.linalg.inv(holder_from_world) @ holder_from_mount
    world_from_camera = world_from_mount @ np.linalg.inv(camera_from_mount)
    seen, points = np.asarray(data.visible)[used], np.asarray(data.points)
    # Points are copied only where some of them were not seen: there may be millions.
    points = points[used][seen] if len(used) < len(points) or not seen.all() else points
    scale = float(calibration.target_scale)
    points = (points if scale == 1.0 else scale * points).reshape(-1, 3)
    # How low the tool came over the target matters only if the tool carries the camera.
    tool_positions = world_from_mount[:, :3, 3] if in_hand else None
    region = ViewedRegion.from_positions(world_from_camera[:, :3, 3], points, tool_positions)
    return dataclasses.replace(calibration, region=region)
