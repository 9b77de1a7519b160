"""Hold the data sets of several cameras that watched one robot move, or several robots."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import jax
import numpy as np
from jaxlie import SE3
from jaxtyping import Float, Int

from ..argument_checks import require_instance
from ..geometry import host_matrices, host_transforms
from ..robots import SAME_POSE_TOLERANCE, Command, SerialArm
from ..runtime.array_namespace import to_device
from .dataset import Dataset
from .pose_dataset import PoseDataset
from .rig_arms import (
    RIG_NAME,
    arms_of,
    checked_arms,
    is_pair,
    reported_poses,
    require_connected_arms,
    require_each_camera,
    with_equal_bases,
)

ONE_TARGET = "target"
"""Name of the target if all cameras of a rig see the same one."""

_TARGET_MOUNT = {
    "eye_in_hand": "eye_in_hand",
    "eye_to_hand": "eye_to_hand",
    "hand_to_hand": "eye_to_hand",
}
"""The mount of a camera of one arm whose target is where the target of each mount is."""

_PLACE = {"eye_in_hand": "on the table", "eye_to_hand": "on the hand"}
"""Where the target of each mount of a camera of one arm is, in words."""

SIZE_TOLERANCE = 1e-6
"""Relative difference of two stated sizes, and of the points so scaled, that is rounding."""


class Rig:
    """Data sets of several cameras that watched one robot move, or several robots.

    Every camera has a data set of its own, with its own pictures, mount, picture size and target.
    Views with the same id were taken in the same state of the robot: they must have the same pose.

    Several arms each have states, joints and errors of their own. What tells where their bases are
    to each other (`RigFit.base`) is a target that cameras on several hands see, or a camera on one
    hand that sees a target on another (`Dataset.between_hands`). Such a camera belongs to a pair of
    arms, whose views have an error of their own: of one hand's pose in the other's frame.

    Attributes:
        cameras: data set of each camera, by its name.
        targets: name of the target that each camera sees, by the camera's name.
        arms: name of the arm that moved each camera or its target, by the camera's name; of a
            camera on one hand and a target on another both, as in `left+right`.
        view_ids: names of the states of the robot in which any camera saw its target; with several
            arms, one after the other, the arm's name and the view's, such as `left/3`.
        base_from_tool: pose that the robot reported in each state.
        joints: joint readings of each state; None if they are not known, and with several arms.
        arm: the arm whose joints these are; None if it is not known, and with several arms.
        masked_views: id and reason of each state whose reported pose is not used.
        state_index: state of each view of a camera, by the camera's name.

    For example, with one camera in the place of two:

        >>> rig = sv.Rig({"left": data, "right": data.select([0, 1, 2, 4])})
        >>> print(len(rig.view_ids), rig.state_index["right"])
        8 [0 1 2 4]

    With a camera on each of two arms, which see one table:

        >>> rig = sv.Rig({"one": data, "two": data}, arms={"one": "left", "two": "right"})
        >>> print(rig.arm_names, rig.view_ids[0], rig.of_arm("right").view_ids[0])
        ('left', 'right') left/0 0

    With a camera on the left hand that sees a target on the right one:

        >>> between = data.between_hands(np.tile(np.eye(4), (8, 1, 1)))  # the right hand rests
        >>> rig = sv.Rig({"eye": between}, arms={"eye": ("left", "right")})
        >>> print(rig.arms["eye"], rig.robot_names)
        left+right ('left', 'right')
    """

    def __init__(
        self,
        cameras: Mapping[str, Dataset],
        targets: Mapping[str, str] | None = None,
        arms: Mapping[str, str | tuple[str, str]] | None = None,
    ):
        """Combine data sets.

        Args:
            targets: name of the target that each camera sees, by the camera's name. By default all
                cameras with the same mount see the same target; if they are next to several
                arms, one on the hand of each. A target is on the table for cameras on the hand, and
                on the hand for cameras next to the arm.
            arms: name of the arm that moved each camera or, if the camera stands next to the arm,
                its target; by the camera's name. By default there is one arm. Of a camera on one
                hand that sees a target on another it is two names: of the camera's arm and of the
                target's.

        Raises:
            TypeError: a data set of another type.
            ValueError: no camera; an unusable name; states whose poses differ; one arm with
                different joints; one target at two places or of two sizes; or arms that no target
                connects.
        """
        if not cameras:
            raise ValueError("Rig: expected at least one camera, found none")
        for name, data in cameras.items():
            require_instance(f"Rig: camera {name!r}", data, Dataset)
            if isinstance(data, PoseDataset):
                raise TypeError(f"Rig: camera {name!r}: tracked poses have no pixels")
            if not RIG_NAME.fullmatch(name):
                raise ValueError(
                    f"Rig: a camera's name has letters, digits, '_' and '-'; found {name!r}"
                )
        self.arms: Mapping[str, str] = MappingProxyType(checked_arms(cameras, arms))
        cameras = with_equal_bases(cameras, self.arms)
        self.cameras: Mapping[str, Dataset] = MappingProxyType(cameras)
        self.targets: Mapping[str, str] = MappingProxyType(
            _checked_targets(cameras, targets, self.arms)
        )
        _require_equal_sizes(cameras, self.targets)
        ids = {
            name: [self.state_name(name, view) for view in data.view_ids]
            for name, data in cameras.items()
        }
        self.view_ids: tuple[str, ...] = tuple(
            dict.fromkeys(
                state
                for arm in self.arm_names
                for name in cameras
                if self.arms[name] == arm
                for state in ids[name]
            )
        )
        place = {state: k for k, state in enumerate(self.view_ids)}
        self.state_index: Mapping[str, Int[np.ndarray, "views"]] = {
            name: np.array([place[state] for state in states]) for name, states in ids.items()
        }
        self._require_equal_reports()
        self.base_from_tool: SE3 = host_transforms(self._state_poses())
        one_arm = len(self.arm_names) == 1
        self.arm: SerialArm | None = _common_arm(cameras) if one_arm else None
        self.joints: Float[np.ndarray, "states joints"] | None = (
            self._state_joints() if one_arm else None
        )
        self.masked_views: tuple[tuple[str, str], ...] = tuple(
            {
                self.state_name(name, view): (self.state_name(name, view), reason)
                for name, data in cameras.items()
                for view, reason in data.masked_views
            }.values()
        )

    def __repr__(self) -> str:
        cameras = ", ".join(f"{name} ({d.view_count})" for name, d in self.cameras.items())
        arms = "" if len(self.arm_names) == 1 else f" of arms {', '.join(self.arm_names)}"
        return f"<Rig: {len(self.view_ids)} robot states{arms}; views of cameras {cameras}>"

    def __reduce__(self):
        # Read-only mappings cannot be pickled, and worker processes take rigs.
        return Rig, (dict(self.cameras), dict(self.targets), dict(self.arms))

    @property
    def arm_names(self) -> tuple[str, ...]:
        """The names of the arms and pairs of arms that moved cameras or targets.

        They are in the order of their first cameras, pairs after single arms.
        """
        return tuple(sorted(dict.fromkeys(self.arms.values()), key=is_pair))

    @property
    def robot_names(self) -> tuple[str, ...]:
        """The names of all arms, each once; the base of the first is the reference of a fit."""
        return tuple(dict.fromkeys(arm for name in self.arm_names for arm in arms_of(name)))

    @property
    def notes(self) -> tuple[str, ...]:
        """The notes of all data sets, each with its camera."""
        return tuple(
            f"{camera}: {note}" for camera, data in self.cameras.items() for note in data.notes
        )

    def require_one_arm(self, function: str) -> None:
        """Raise a ValueError if there are several arms, for a function that takes one."""
        if len(self.arm_names) > 1:
            raise ValueError(
                f"{function}: expected a rig with one arm, found {', '.join(self.arm_names)}: take "
                "one by rig.of_arm"
            )

    def of_arm(self, name: str) -> "Rig":
        """Return the rig of one arm, or of one pair of arms, with its cameras alone.

        Args:
            name: one of `arm_names`.

        Raises:
            ValueError: there is no such arm.
        """
        if name not in self.arm_names:
            raise ValueError(
                f"of_arm: expected an arm of {', '.join(self.arm_names)}, found {name!r}"
            )
        if len(self.arm_names) == 1:
            return self
        return self.with_cameras(
            {camera: data for camera, data in self.cameras.items() if self.arms[camera] == name}
        )

    def with_cameras(self, cameras: Mapping[str, Dataset]) -> "Rig":
        """Return a rig with other data of some of its cameras, whose targets and arms are kept."""
        return Rig(
            cameras,
            {name: self.targets[name] for name in cameras},
            {name: self.arms[name] for name in cameras},
        )

    def see_one_target(self, first: str, second: str) -> bool:
        """Return whether two cameras of one arm, given by their names, see the same target."""
        return self.targets[first] == self.targets[second] and self.arms[first] == self.arms[second]

    def state_name(self, camera: str, view_id: str) -> str:
        """Return the name of the robot's state in which a camera took a view."""
        return view_id if len(self.arm_names) == 1 else f"{self.arms[camera]}/{view_id}"

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
        return self.with_cameras(
            {
                name: data.mask_views(np.flatnonzero(masked[self.state_index[name]]))
                for name, data in self.cameras.items()
            }
        )

    def _state_poses(self) -> Float[np.ndarray, "states 4 4"]:
        """Return the reported pose of each state, by the first camera that has it."""
        poses = np.zeros((len(self.view_ids), 4, 4))
        for name in reversed(tuple(self.cameras)):
            poses[self.state_index[name]] = host_matrices(self.cameras[name].base_from_tool)
        return poses

    def _require_equal_reports(self) -> None:
        """Raise a ValueError if two data sets have different poses of an arm for one state."""
        first: dict[tuple[str, str], tuple[str, np.ndarray]] = {}
        for name, data in self.cameras.items():
            for arm, poses in zip(arms_of(self.arms[name]), reported_poses(data), strict=True):
                for view, pose in zip(data.view_ids, poses, strict=True):
                    other, known = first.setdefault((arm, view), (name, pose))
                    difference = float(np.abs(known - pose).max())
                    if difference > SAME_POSE_TOLERANCE:
                        robot = "robot" if len(self.robot_names) == 1 else f"arm {arm}"
                        raise ValueError(
                            f"Rig: view {view!r} is one state of the {robot}, but its pose in "
                            f"{name!r} differs from {other!r}'s by {difference:.2g}; give views of "
                            "different states different ids"
                        )

    def _state_joints(self) -> Float[np.ndarray, "states joints"] | None:
        """Return the joint readings of each state; None unless all cameras have them."""
        known = [data.joints for data in self.cameras.values() if data.joints is not None]
        if len(known) < len(self.cameras):
            return None
        joints = np.zeros((len(self.view_ids), np.shape(known[0])[1]))
        for name, angles in zip(self.cameras, known, strict=True):
            joints[self.state_index[name]] = np.asarray(angles)
        return joints


def _checked_targets(
    cameras: Mapping[str, Dataset],
    targets: Mapping[str, str] | None,
    arms: Mapping[str, str],
) -> dict[str, str]:
    """Return the name of each camera's target."""
    if targets is None:
        targets = _default_targets(cameras, arms)
    require_each_camera("targets", cameras, targets)
    mount_of: dict[str, str] = {}
    hand_of: dict[str, str] = {}
    robots = {arm for moving in arms.values() for arm in arms_of(moving)}
    names = {*cameras, *(robots if len(robots) > 1 else ())}
    for name, target in targets.items():
        # Cameras next to an arm and cameras on another hand may see the same target on its hand.
        mount, hand = _TARGET_MOUNT[cameras[name].mount], arms_of(arms[name])[-1]
        if not RIG_NAME.fullmatch(target) or target in names:
            raise ValueError(
                f"Rig: a target's name has letters, digits, '_' and '-', and is no camera's name "
                f"and no arm's; found {target!r}"
            )
        if mount_of.setdefault(target, mount) != mount:
            other = next(camera for camera, seen in targets.items() if seen == target)
            raise ValueError(
                f"Rig: camera {other!r} ({cameras[other].mount}) sees target {target!r} "
                f"{_PLACE[mount_of[target]]}, camera {name!r} ({cameras[name].mount}) "
                f"{_PLACE[mount]}: correct the mount of one, or give each a target of its own"
            )
        if mount == "eye_to_hand" and hand_of.setdefault(target, hand) != hand:
            raise ValueError(
                f"Rig: target {target!r} is on the hand of {hand_of[target]!r} and, for camera "
                f"{name!r}, on the hand of {hand!r}"
            )
    require_connected_arms(targets, arms)
    return dict(targets)


def _require_equal_sizes(cameras: Mapping[str, Dataset], targets: Mapping[str, str]) -> None:
    """Raise a ValueError if two cameras state the same target in different sizes."""
    first: dict[str, str] = {}
    for name, data in cameras.items():
        other = first.setdefault(targets[name], name)
        points, others = _stated_points(data), _stated_points(cameras[other])
        if points is None or others is None or points.shape != others.shape:
            continue
        ratio = np.vdot(others, points) / max(np.vdot(others, others), np.finfo(float).tiny)
        is_copy = np.allclose(
            points, ratio * others, rtol=0.0, atol=SIZE_TOLERANCE * abs(points).max()
        )
        if is_copy and abs(ratio - 1.0) > SIZE_TOLERANCE:
            raise ValueError(
                f"Rig: camera {name!r} states the target {targets[name]!r} {ratio:.6g} times as "
                f"large as camera {other!r} does: state one size, or name two targets (targets=)"
            )


def _stated_points(data: Dataset) -> Float[np.ndarray, "points 3"] | None:
    """Return the target's points if they are the same in all views, else None."""
    points = np.asarray(data.points)
    known = points[0]
    return known if (points == known).all() and np.isfinite(known).all() else None


def _default_targets(cameras: Mapping[str, Dataset], arms: Mapping[str, str]) -> dict[str, str]:
    """Return one target for all cameras on hands, and one on the hand of each arm."""
    mounts = {name: _TARGET_MOUNT[data.mount] for name, data in cameras.items()}
    several_mounts = len(set(mounts.values())) > 1
    several_arms = len({arm for moving in arms.values() for arm in arms_of(moving)}) > 1
    return {
        name: "_".join(
            [
                ONE_TARGET,
                *([mount] if several_mounts else []),
                *([arms_of(arms[name])[-1]] if several_arms and mount == "eye_to_hand" else []),
            ]
        )
        for name, mount in mounts.items()
    }


def _common_arm(cameras: Mapping[str, Dataset]) -> SerialArm | None:
    """Return the arm of all data sets; None if one of them has none."""
    arms = [data.arm for data in cameras.values()]
    known = [arm for arm in arms if arm is not None]
    if len(known) < len(arms):
        return None
    leaves = [jax.tree.leaves(arm) for arm in known]
    equal = all(
        len(arm_leaves) == len(leaves[0]) and all(map(np.array_equal, arm_leaves, leaves[0]))
        for arm_leaves in leaves
    )
    if not equal:
        raise ValueError(
            "Rig: the data sets of one arm have different joints: name the arms by arms= if there "
            "are several"
        )
    return known[0]
