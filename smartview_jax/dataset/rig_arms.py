"""Name the arms that move the cameras and targets of a rig, and the pairs of arms."""

import re
from collections.abc import Mapping

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..geometry import host_matrices
from .dataset import Dataset

ONE_ARM = "arm"
"""Name of the arm if a rig has only one."""

RIG_NAME = re.compile(r"[\w-]+")
"""The names of cameras, targets and arms, which are parts of parameters' names."""

PAIR_MARK = "+"
"""Stands between the names of two arms, the camera's and the target's."""


def is_pair(arm: str) -> bool:
    """Return whether a name among `Rig.arms` is of two arms: of a camera's and of its target's."""
    return PAIR_MARK in arm


def arms_of(arm: str) -> tuple[str, ...]:
    """Return the arms that a name among `Rig.arms` stands for: one, or camera's and target's."""
    return tuple(arm.split(PAIR_MARK))


def reported_poses(data: Dataset) -> list[Float[np.ndarray, "views 4 4"]]:
    """Return the poses that each arm of a data set reported: of one arm, or of a pair's two."""
    if data.hands is None:
        return [host_matrices(data.base_from_tool)]
    hands = data.hands
    both = hands.base_from_tool, hands.other_base_from_other_tool
    return [host_matrices(poses) for poses in both]


def with_equal_bases(cameras: Mapping[str, Dataset], arms: Mapping[str, str]) -> dict[str, Dataset]:
    """Return the data sets with the bases of each pair of arms where its first camera has them."""
    bases: dict[str, SE3] = {}
    for name, data in cameras.items():
        if (assumed := data.base_from_other_base) is not None:
            bases.setdefault(arms[name], assumed)
    return {
        name: data.with_bases(bases[arms[name]]) if arms[name] in bases else data
        for name, data in cameras.items()
    }


def checked_arms(
    cameras: Mapping[str, Dataset], arms: Mapping[str, str | tuple[str, str]] | None
) -> dict[str, str]:
    """Return the name of each camera's arm, or of its pair of arms."""
    if arms is None:
        pairs = [name for name, data in cameras.items() if data.hands is not None]
        if pairs:
            raise ValueError(
                f"Rig: camera {pairs[0]!r} is on one arm's hand and sees a target on another's: "
                f"name both by arms={{{pairs[0]!r}: (camera's arm, target's arm), ...}}"
            )
        return dict.fromkeys(cameras, ONE_ARM)
    require_each_camera("arms", cameras, arms)
    named = {
        name: arms_of(arm) if isinstance(arm, str) else tuple(arm) for name, arm in arms.items()
    }
    several = len({arm for names in named.values() for arm in names}) > 1
    for camera, names in named.items():
        expected = 1 if cameras[camera].hands is None else 2
        if len(names) != expected or len(set(names)) != expected:
            raise ValueError(
                f"Rig: arms: camera {camera!r} is {cameras[camera].mount}: expected "
                f"{'one arm' if expected == 1 else 'two arms, the camera and the target on each'}, "
                f"found {', '.join(names)}"
            )
        for arm in names:
            if not RIG_NAME.fullmatch(arm) or (several and arm in cameras):
                raise ValueError(
                    f"Rig: an arm's name has letters, digits, '_' and '-', and is no camera's "
                    f"name; found {arm!r}"
                )
    return {name: PAIR_MARK.join(named[name]) for name in cameras}


def require_each_camera(
    argument: str, cameras: Mapping[str, Dataset], given: Mapping[str, object]
) -> None:
    """Raise a ValueError unless a name is given for each camera and for nothing else."""
    if set(given) != set(cameras):
        raise ValueError(
            f"Rig: {argument}: expected the cameras {', '.join(cameras)}, found {', '.join(given)}"
        )


def require_connected_arms(targets: Mapping[str, str], arms: Mapping[str, str]) -> None:
    """Raise a ValueError that names the arms which nothing connects to the first.

    Arms are connected by a target that cameras of both see, and by a camera on one hand that sees
    a target on the other.
    """
    names = list(dict.fromkeys(arm for moving in arms.values() for arm in arms_of(moving)))
    connected = {names[0]}
    while True:
        reached = {name for name, moving in arms.items() if connected.intersection(arms_of(moving))}
        seen = {targets[camera] for camera in reached}
        reached |= {camera for camera in arms if targets[camera] in seen}
        more = connected | {arm for camera in reached for arm in arms_of(arms[camera])}
        if more == connected:
            break
        connected = more
    if apart := [name for name in names if name not in connected]:
        raise ValueError(
            f"Rig: no target tells where {', '.join(apart)} and {', '.join(sorted(connected))} are "
            "to each other: cameras on the hands of different arms must see the same target "
            "(targets=), or a camera on one hand a target on the other; or make a rig of each arm"
        )
