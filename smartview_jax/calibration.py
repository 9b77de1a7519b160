"""The calibration of a camera on a robot arm: the differentiable forward model of the library.

    pixel = camera.project(camera_from_tool @ tool_from_base(command) @ base_from_world @ p_world)

is the chain for a camera on the hand (the paper's Eq. 10). A camera that stands beside the arm and
watches a target on the tool has `camera_from_base @ base_from_tool(command) @ tool_from_world`.
Both are one class here: the camera sits on its *mount* (the tool, or the base) and the target in
its *holder* (the base, or the tool). A fitted error of the robot is part of the chain: predictions
and commands go by where the tool is, not by where the robot says it is.
"""

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, ScalarLike

from .cameras import AbstractLens, Camera, camera_from_dict, camera_to_dict
from .files import dump_yaml, read_yaml, write_atomically
from .geometry import (
    PoseLike,
    ViewedRegion,
    as_se3,
    region_from_dict,
    region_to_dict,
    transform_from_dict,
    transform_points,
    transform_to_dict,
)
from .robot_errors import AbstractField, RobotError, robot_error_from_dict, robot_error_to_dict
from .robots import Command, CommandLike, JointsLike, as_command

FORMAT_VERSION = 2
"""Files of version 1 have no end mark; see `schemas.calibration` for which of them load."""

_END_MARK = "smartview_calibration"
"""Value of the last entry of a file: what was cut does not have it."""

_FRAMES: dict[str, tuple[str, str]] = {
    "eye_in_hand": ("tool", "base"),
    "eye_to_hand": ("base", "tool"),
}


def mount_frames(mount: str) -> tuple[str, str]:
    """The frame the camera is bolted to and the frame the target stands in."""
    if mount not in _FRAMES:
        raise ValueError(f"mount is one of {', '.join(_FRAMES)}; found {mount!r}")
    return _FRAMES[mount]


def mount_from_holder(mount: str, base_from_tool: SE3) -> SE3:
    """The robot's part of the chain, between the camera's mount and the target's holder.

    Its own inverse: from this transform it gives `base_from_tool` back.
    """
    return base_from_tool.inverse() if mount_frames(mount)[0] == "tool" else base_from_tool


class Calibration(eqx.Module):
    """Camera, hand-eye and world transforms, and where they put a point in the picture.

    Made by `eye_in_hand` or `eye_to_hand`, or by a fit. Every method works under `jit`, `grad` and
    `vmap`.

    Attributes:
        camera: intrinsics and lens.
        camera_from_mount: `camera_from_tool`, or `camera_from_base` for eye-to-hand.
        holder_from_world: `base_from_world`, or `tool_from_world` for eye-to-hand.
        target_scale: true size of the target over its stated size.
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        robot_error: what the reported poses are wrong by; None where they are taken as they are.
        region: from where the target was seen when this was fitted; None where it was not fitted.
    """

    camera: Camera
    camera_from_mount: SE3
    holder_from_world: SE3
    target_scale: Float[Array, ""]
    mount: str = eqx.field(static=True)
    robot_error: RobotError | None
    region: ViewedRegion | None

    def __init__(
        self,
        camera: Camera,
        camera_from_mount: SE3,
        holder_from_world: SE3,
        mount: str,
        target_scale: ScalarLike = 1.0,
        robot_error: RobotError | None = None,
        region: ViewedRegion | None = None,
    ):
        mount_frames(mount)
        self.camera = camera
        self.camera_from_mount = camera_from_mount
        self.holder_from_world = holder_from_world
        self.target_scale = jnp.asarray(target_scale, dtype=float)
        self.mount = mount
        self.robot_error = robot_error
        self.region = region

    @classmethod
    def eye_in_hand(
        cls,
        camera: Camera,
        camera_from_tool: PoseLike,
        base_from_world: PoseLike,
        target_scale: ScalarLike = 1.0,
    ) -> "Calibration":
        """A camera on the hand, a target that stands in the base frame."""
        return cls(
            camera,
            as_se3(camera_from_tool),
            as_se3(base_from_world),
            "eye_in_hand",
            target_scale,
        )

    @classmethod
    def eye_to_hand(
        cls,
        camera: Camera,
        camera_from_base: PoseLike,
        tool_from_world: PoseLike,
        target_scale: ScalarLike = 1.0,
    ) -> "Calibration":
        """A camera that stands in the base frame, a target on the tool."""
        return cls(
            camera,
            as_se3(camera_from_base),
            as_se3(tool_from_world),
            "eye_to_hand",
            target_scale,
        )

    @property
    def camera_from_tool(self) -> SE3:
        """The hand-eye transform (eye-in-hand)."""
        return self._transform("camera_from_mount", "camera_from_tool")

    @property
    def camera_from_base(self) -> SE3:
        """Where the camera stands (eye-to-hand)."""
        return self._transform("camera_from_mount", "camera_from_base")

    @property
    def base_from_world(self) -> SE3:
        """Where the target stands (eye-in-hand)."""
        return self._transform("holder_from_world", "base_from_world")

    @property
    def tool_from_world(self) -> SE3:
        """How the target sits on the tool (eye-to-hand)."""
        return self._transform("holder_from_world", "tool_from_world")

    def _transform(self, field: str, name: str) -> SE3:
        if name not in self.transform_names:
            raise AttributeError(
                f"an {self.mount} calibration has {' and '.join(self.transform_names)}, not {name}"
            )
        return getattr(self, field)

    @property
    def transform_names(self) -> tuple[str, str]:
        """What `camera_from_mount` and `holder_from_world` are called for this mount."""
        mount_frame, holder_frame = mount_frames(self.mount)
        return f"camera_from_{mount_frame}", f"{holder_frame}_from_world"

    @property
    def field(self) -> AbstractField | None:
        """Of the robot's error; None where it is not corrected."""
        return None if self.robot_error is None else self.robot_error.field

    @property
    def uncorrected(self) -> "Calibration":
        """The same without the robot's error: what programs have that take the transforms alone."""
        return dataclasses.replace(self, robot_error=None)

    def camera_from_world(self, base_from_tool: CommandLike, corrected: bool = True) -> SE3:
        """Extrinsics at the given robot poses, `(*views)` (Eq. 10).

        Args:
            base_from_tool: what the robot reports: poses, or `arm.command(joints)`.
            corrected: for the robot's error, where one was fitted; if not, the bare chain.
        """
        reported, error = as_command(base_from_tool), self.robot_error if corrected else None
        pose = reported.base_from_tool if error is None else error.true_pose(reported)
        robot = mount_from_holder(self.mount, pose)
        return self.camera_from_mount @ robot @ self.holder_from_world

    def command_for(
        self,
        camera_from_world: PoseLike,
        corrected: bool = True,
        near: JointsLike | None = None,
    ) -> SE3:
        """The robot pose `base_from_tool` that puts the camera at a wanted pose (Eq. 19).

        Args:
            camera_from_world: wanted, `(*views)`.
            corrected: for the robot's error: what to tell the robot so that it gets there.
            near: joint angles in whose neighbourhood to look, where an arm's own errors were
                fitted; NaN comes back where they find no way to reach the pose.

        Raises:
            ValueError: the errors of an arm were fitted, and `near` is not given.
        """
        return self.reported_for(camera_from_world, corrected, near).base_from_tool

    def reported_for(
        self,
        camera_from_world: PoseLike,
        corrected: bool = True,
        near: JointsLike | None = None,
    ) -> Command:
        """As `command_for`, with the joints where an arm's own errors were fitted."""
        true_pose = self._pose_for(camera_from_world)
        if self.robot_error is None or not corrected:
            return Command(true_pose)
        return self.robot_error.command(true_pose, near)

    def joints_for(
        self,
        camera_from_world: PoseLike,
        near: JointsLike,
    ) -> Float[Array, "*views joints"]:
        """As `command_for`, in joint angles, where an arm's own errors were fitted."""
        joints = self.reported_for(camera_from_world, near=near).joints
        if joints is None:
            raise ValueError("this calibration knows no arm; robots.joints_near finds joint angles")
        return joints

    def _pose_for(self, camera_from_world: PoseLike) -> SE3:
        """Where the tool has to be."""
        robot = (
            self.camera_from_mount.inverse()
            @ as_se3(camera_from_world)
            @ self.holder_from_world.inverse()
        )
        return mount_from_holder(self.mount, robot)

    def points_in_camera(
        self,
        base_from_tool: CommandLike,
        points: Float[Array, "*points 3"] | np.ndarray,
        corrected: bool = True,
    ) -> Float[Array, "*moved 3"]:
        """Target points in the camera frame, m; arguments as in `project`."""
        points = self.target_scale * jnp.asarray(points, dtype=float)
        return transform_points(self.camera_from_world(base_from_tool, corrected), points)

    def project(
        self,
        base_from_tool: CommandLike,
        points: Float[Array, "*points 3"] | np.ndarray,
        corrected: bool = True,
    ) -> tuple[Float[Array, "*pixels 2"], Bool[Array, "*pixels"]]:
        """Pixels of target points seen from the given robot poses, and where they are valid.

        Args:
            base_from_tool: what the robot reports, `(*views)` poses, or `arm.command(joints)`.
            points: `(N, 3)` for all views or `(*views, N, 3)`, in the target frame, m.
            corrected: for the robot's error, where one was fitted; if not, the bare chain.

        Returns:
            pixels `(*views, N, 2)`, NaN where `valid` `(*views, N)` is False.
        """
        return self.camera.project(self.points_in_camera(base_from_tool, points, corrected))

    def to_dict(self, run: str | None = None, warnings: Sequence[str] = ()) -> dict[str, Any]:
        """Return plain numbers with their names and units, as written by `save`."""
        content: dict[str, Any] = {
            "smartview_calibration": FORMAT_VERSION,
            **({} if run is None else {"run": run}),
            **({"warnings": list(warnings)} if warnings else {}),
            "units": {"length": "m", "angle": "rad", "image": "px"},
            "mount": self.mount,
            "camera": camera_to_dict(self.camera),
        }
        transforms = (self.camera_from_mount, self.holder_from_world)
        for name, transform in zip(self.transform_names, transforms, strict=True):
            content[name] = transform_to_dict(transform)
        content["target_scale"] = float(self.target_scale)
        error = self.robot_error
        content["robot_error"] = None if error is None else robot_error_to_dict(error)
        if self.region is not None:
            content["region"] = region_to_dict(self.region)
        content["end"] = _END_MARK
        return content

    @classmethod
    def from_dict(
        cls,
        content: dict[Any, Any],
        lens: AbstractLens | None = None,
        field: AbstractField | None = None,
    ) -> "Calibration":
        """The inverse of `to_dict`; `lens` and `field` stand for models this library doesn't know.

        Raises:
            ValueError: naming the entry that is missing or wrong.
        """
        # The validation library is imported where files are read, not where arrays are fitted.
        from .schemas.calibration import CALIBRATION
        from .schemas.reading import checked

        checked(content, CALIBRATION)
        mount = content["mount"]
        names = tuple(name.format(*mount_frames(mount)) for name in _TRANSFORM_PATTERNS)
        mounted, held = (transform_from_dict(name, content[name]) for name in names)
        error, region = content.get("robot_error"), content.get("region")
        return cls(
            camera_from_dict(content["camera"], lens),
            mounted,
            held,
            mount,
            float(content["target_scale"]),
            None if error is None else robot_error_from_dict(error, field),
            None if region is None else region_from_dict(region),
        )

    def save(
        self,
        path: str | os.PathLike[str],
        run: str | None = None,
        warnings: Sequence[str] = (),
    ) -> None:
        """Write a YAML file a person can read, whole or not at all.

        Args:
            path: of the file.
            run: name of the run that this is a result of, which all its files carry.
            warnings: what speaks against it, such as a fit's `warnings`; read by people alone.
        """
        write_atomically(path, dump_yaml(self.to_dict(run, warnings)))

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        lens: AbstractLens | None = None,
        field: AbstractField | None = None,
    ) -> "Calibration":
        """Read what `save` wrote; a lens or field of your own is passed, its numbers are read.

        Raises:
            FileNotFoundError: the file is missing.
            ValueError: naming the file and the entry that is wrong.
        """
        try:
            return cls.from_dict(read_yaml(path), lens, field)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


_TRANSFORM_PATTERNS = ("camera_from_{0}", "{1}_from_world")
