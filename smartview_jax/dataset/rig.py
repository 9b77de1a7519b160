"""Hold the data sets of several cameras that watched one robot move."""

import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import jax
import numpy as np
from jaxlie import SE3
from jaxtyping import Float, Int

from ..argument_checks import require_instance
from ..geometry import host_matrices, host_transforms
from ..robots import Command, SerialArm
from ..runtime.array_namespace import to_device
from .dataset import Dataset
from .pose_dataset import PoseDataset

ONE_TARGET = "target"
"""Name of the target if all cameras of a rig see the same one."""

NAME = re.compile(r"[\w-]+")
"""The names of cameras and targets, which are parts of parameters' names."""

SAME_POSE_TOLERANCE = 1e-9
"""Largest difference, m or no unit, between the poses that two data sets have for one state."""


class Rig:
    """Data sets of several cameras that watched one robot move.

    Every camera has a data set of its own, with its own pictures, mount, picture size and target.
    Views with the same id were taken in the same state of the robot: they must have the same pose.

    Attributes:
        cameras: data set of each camera, by its name.
        targets: name of the target that each camera sees, by the camera's name.
        view_ids: names of the states of the robot in which any camera saw its target.
        base_from_tool: pose that the robot reported in each state.
        joints: joint readings of each state; None if they are not known.
        arm: the arm whose joints these are; None if it is not known.
        masked_views: id and reason of each state whose reported pose is not used.
        state_index: state of each view of a camera, by the camera's name.

    For example, with one camera in the place of two:

        >>> rig = sv.Rig({"left": data, "right": data.select([0, 1, 2, 4])})
        >>> print(len(rig.view_ids), rig.state_index["right"])
        8 [0 1 2 4]
    """

    def __init__(self, cameras: Mapping[str, Dataset], targets: Mapping[str, str] | None = None):
        """Combine data sets.

        Args:
            cameras: data set of each camera, by a name.
            targets: name of the target that each camera sees, by the camera's name. By default all
                cameras with the same mount see the same target. A target is on the table for
                cameras on the hand, and on the hand for cameras next to the arm.

        Raises:
            TypeError: a data set of another type.
            ValueError: no camera; an unusable name; states whose poses differ; different arms; or
                one target at two places.
        """
        if not cameras:
            raise ValueError("Rig: expected at least one camera, found none")
        for name, data in cameras.items():
            require_instance(f"Rig: camera {name!r}", data, Dataset)
            if isinstance(data, PoseDataset):
                raise TypeError(f"Rig: camera {name!r}: tracked poses have no pixels")
            if not NAME.fullmatch(name):
                raise ValueError(
                    f"Rig: a camera's name has letters, digits, '_' and '-'; found {name!r}"
                )
        self.cameras: Mapping[str, Dataset] = MappingProxyType(dict(cameras))
        self.targets: Mapping[str, str] = MappingProxyType(_checked_targets(cameras, targets))
        ids = list(dict.fromkeys(view for data in cameras.values() for view in data.view_ids))
        self.view_ids: tuple[str, ...] = tuple(ids)
        place = {view: k for k, view in enumerate(ids)}
        self.state_index: Mapping[str, Int[np.ndarray, "views"]] = {
            name: np.array([place[view] for view in data.view_ids])
            for name, data in cameras.items()
        }
        self.base_from_tool: SE3 = host_transforms(self._state_poses())
        self.arm: SerialArm | None = _common_arm(cameras)
        self.joints: Float[np.ndarray, "states joints"] | None = self._state_joints()
        self.masked_views: tuple[tuple[str, str], ...] = tuple(
            {entry[0]: entry for data in cameras.values() for entry in data.masked_views}.values()
        )

    def __repr__(self) -> str:
        cameras = ", ".join(f"{name} ({d.view_count})" for name, d in self.cameras.items())
        return f"<Rig: {len(self.view_ids)} robot states; views of cameras {cameras}>"

    @property
    def command(self) -> Command:
        """The commands reported by the robot, one for each state."""
        return Command(self.base_from_tool, None if self.joints is None else to_device(self.joints))

    @property
    def seeing(self) -> list[tuple[str, ...]]:
        """The cameras that saw enough points to tell the pose of their target, for each state."""
        cameras: list[list[str]] = [[] for _ in self.view_ids]
        for name, data in self.cameras.items():
            for state in self.state_index[name][data.usable_views()]:
                cameras[state].append(name)
        return [tuple(names) for names in cameras]

    @property
    def view_count(self) -> int:
        """The number of the robot's states, masked ones included."""
        return len(self.view_ids)

    def usable_views(self) -> np.ndarray:
        """Return the indices of the states in which a camera saw enough points of its target."""
        return np.array([k for k, names in enumerate(self.seeing) if names], dtype=int)

    def mask_views(self, views: Sequence[int] | np.ndarray) -> "Rig":
        """Return the rig with some states of the robot masked for all cameras."""
        masked = np.zeros(self.view_count, dtype=bool)
        masked[np.asarray(views, dtype=int)] = True
        cameras = {
            name: data.mask_views(np.flatnonzero(masked[self.state_index[name]]))
            for name, data in self.cameras.items()
        }
        return Rig(cameras, self.targets)

    def _state_poses(self) -> Float[np.ndarray, "states 4 4"]:
        """Return the reported pose of each state.

        Raises:
            ValueError: two data sets have different poses for a state.
        """
        poses = np.full((len(self.view_ids), 4, 4), np.nan)
        first: dict[int, str] = {}
        for name, data in self.cameras.items():
            own = host_matrices(data.base_from_tool)
            for view, state in enumerate(self.state_index[name]):
                if state not in first:
                    first[state], poses[state] = name, own[view]
                difference = float(np.abs(poses[state] - own[view]).max())
                if difference > SAME_POSE_TOLERANCE:
                    raise ValueError(
                        f"Rig: view {self.view_ids[state]!r} is one state of the robot, but its "
                        f"pose in {name!r} differs from {first[state]!r}'s by {difference:.2g}; "
                        "give views of different states different ids"
                    )
        return poses

    def _state_joints(self) -> Float[np.ndarray, "states joints"] | None:
        """Return the joint readings of each state; None unless all cameras have them."""
        known = [data.joints for data in self.cameras.values() if data.joints is not None]
        if len(known) < len(self.cameras):
            return None
        joints = np.zeros((len(self.view_ids), np.shape(known[0])[1]))
        for (name, _), own in zip(self.cameras.items(), known, strict=True):
            joints[self.state_index[name]] = np.asarray(own)
        return joints


def _checked_targets(
    cameras: Mapping[str, Dataset], targets: Mapping[str, str] | None
) -> dict[str, str]:
    """Return the name of each camera's target.

    Raises:
        ValueError: a camera without a target or the reverse, or a target at two places.
    """
    mounts = {data.mount for data in cameras.values()}
    if targets is None:
        several = len(mounts) > 1
        return {
            name: f"{ONE_TARGET}_{data.mount}" if several else ONE_TARGET
            for name, data in cameras.items()
        }
    if set(targets) != set(cameras):
        raise ValueError(
            f"Rig: targets: expected the cameras {', '.join(cameras)}, found {', '.join(targets)}"
        )
    mount_of: dict[str, str] = {}
    for name, target in targets.items():
        if not NAME.fullmatch(target) or target in cameras:
            raise ValueError(
                f"Rig: a target's name has letters, digits, '_' and '-', and is no camera's name; "
                f"found {target!r}"
            )
        if mount_of.setdefault(target, cameras[name].mount) != cameras[name].mount:
            raise ValueError(
                f"Rig: target {target!r} is on the table for cameras on the hand, and on the hand "
                f"for cameras next to the arm; camera {name!r} says otherwise than the others"
            )
    return dict(targets)


def _common_arm(cameras: Mapping[str, Dataset]) -> SerialArm | None:
    """Return the arm of all data sets; None if one of them has none.

    Raises:
        ValueError: the arms differ.
    """
    arms = [data.arm for data in cameras.values()]
    known = [arm for arm in arms if arm is not None]
    if len(known) < len(arms):
        return None
    leaves = [jax.tree.leaves(arm) for arm in known]
    equal = all(
        len(own) == len(leaves[0]) and all(map(np.array_equal, own, leaves[0])) for own in leaves
    )
    if not equal:
        raise ValueError("Rig: the data sets have different arms; a rig has one robot")
    return known[0]
