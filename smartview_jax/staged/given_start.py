"""Take what a person knows of a calibration into the start of the joint fit."""

import dataclasses
from collections.abc import Collection, Mapping

import numpy as np
from jaxlie import SE3

from ..calibration import BASES, Calibration, chain_transform_names, transform_names
from ..cameras import Camera
from ..dataset import Dataset, require_same_set_up
from ..geometry import PoseLike, as_se3, host_matrices, host_transforms


def check_start(start: Calibration | Mapping[str, PoseLike] | None, data: Dataset) -> None:
    """Raise a ValueError for a start that is not of these data, before anything is fitted."""
    names = chain_transform_names(data.mount)
    if isinstance(start, Calibration):
        require_same_set_up("the start", start, data)
    elif unknown := set(start or ()) - set(names):
        raise ValueError(f"start: expected {' or '.join(names)}, found {sorted(unknown)[0]!r}")


def merged_start(
    fitted: Calibration,
    start: Calibration | Mapping[str, PoseLike] | None,
    data: Dataset,
    camera: Camera | None,
) -> Calibration:
    """Return where a joint fit starts: as given, or what was found with some transforms as given.

    Args:
        fitted: the staged fit's calibration.
        start: a calibration, or transforms by name; None takes what was found. A transform that is
            not given follows from the pose of the first usable view before the camera.
        data: the data set, checked by `check_start`.
        camera: a known camera, which a given calibration takes over.
    """
    # A calibration stands for itself; it may have another lens, which the fit converts.
    if isinstance(start, Calibration):
        return start if camera is None else dataclasses.replace(start, camera=camera)
    if not start:
        return fitted
    mount_name, holder_name = transform_names(data.mount)
    # The staged fit has the bases of two arms where they are given.
    given = {name: host_matrices(as_se3(pose)) for name, pose in start.items() if name != BASES}
    if not given:
        return fitted
    if fitted.base_from_other_base is not None:
        data = data.with_bases(fitted.base_from_other_base)
    # One view is enough: both transforms of the staged fit agree with all views alike.
    view = int(data.usable_views()[0])
    # camera_from_world = camera_from_mount @ mount_from_holder @ holder_from_world, of that view
    reported = host_matrices(data.mount_from_holder)[view]
    seen = (
        host_matrices(fitted.camera_from_mount) @ reported @ host_matrices(fitted.holder_from_world)
    )
    if mount_name not in given:
        given[mount_name] = seen @ np.linalg.inv(reported @ given[holder_name])
    if holder_name not in given:
        given[holder_name] = np.linalg.inv(given[mount_name] @ reported) @ seen
    return dataclasses.replace(
        fitted,
        camera_from_mount=host_transforms(given[mount_name]),
        holder_from_world=host_transforms(given[holder_name]),
    )


def start_without(
    start: Calibration | Mapping[str, PoseLike], names: Collection[str], fitted: Calibration
) -> Calibration | Mapping[str, PoseLike]:
    """Return a start without some of its transforms; a calibration has those that were found.

    Args:
        start: a calibration, or transforms by name.
        names: names of the transforms to leave out.
        fitted: the staged fit's calibration.
    """
    if not isinstance(start, Calibration):
        return {name: pose for name, pose in start.items() if name not in names}
    mount_name, holder_name = start.transform_names
    return dataclasses.replace(
        start,
        camera_from_mount=(fitted if mount_name in names else start).camera_from_mount,
        holder_from_world=(fitted if holder_name in names else start).holder_from_world,
    )


def known_bases(start: Calibration | Mapping[str, PoseLike] | None) -> SE3 | None:
    """Return `base_from_other_base` of a start of two arms; None if it has none."""
    if isinstance(start, Calibration):
        return start.base_from_other_base
    return as_se3(start[BASES]) if start and BASES in start else None


def known_transforms(
    start: Calibration | Mapping[str, PoseLike] | None, mount: str
) -> tuple[SE3 | None, SE3 | None]:
    """Return `camera_from_mount` and `holder_from_world` of a start, as far as it has them."""
    if isinstance(start, Calibration):
        return start.camera_from_mount, start.holder_from_world
    mount_name, holder_name = (
        as_se3(start[name]) if start and name in start else None for name in transform_names(mount)
    )
    return mount_name, holder_name
