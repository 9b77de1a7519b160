"""Predict pixels from robot poses, and robot poses from camera poses: the calibrated forward model.

    pixel = camera.project(camera_from_tool @ tool_from_base(command) @ base_from_world @ p_world)

is the chain for a camera on the hand (Eq. 10). For a camera that is fixed next to the arm and sees
a target on the tool, the chain is `camera_from_base @ base_from_tool(command) @ tool_from_world`.
One class serves both: the camera is on its *mount* (the tool, or the base) and the target in its
*holder* (the base, or the tool). A fitted robot error is part of the chain: predictions and
commands use the true tool pose, not the reported one.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, ScalarLike

from ..argument_checks import errors_at
from ..cameras import AbstractLens, Camera
from ..geometry import (
    PoseLike,
    ViewedRegion,
    as_se3,
    host_matrices,
    transform_text,
)
from ..robot_errors import AbstractField, RobotError
from ..robots import Command, CommandLike, JointsLike, as_command
from ..runtime.array_namespace import AnyArray, as_float_array
from ..runtime.compilation import is_traced
from ..runtime.modules import with_fields
from ..runtime.padding import over_padded_views
from ..schemas.calibration_content import calibration_content
from .chain import (
    BASES,
    ONE_ARM_MOUNTS,
    chain_matrices,
    chain_of_transforms,
    host_mount_from_holder,
    mount_frames,
    transform_names,
)
from .depth_bias import DepthBias
from .file_content import content_of, parts_of
from .projection import base_from_tool_for, points_in_camera, projected_points
from .target_shape import TargetShape


class Calibration(eqx.Module):
    """A calibrated camera on a robot arm or next to it, which predicts pixels from robot poses.

    Instances are made by `eye_in_hand` or `eye_to_hand`, or by a fit. Every numerical method works
    under `jit`, `grad` and `vmap`.

    Attributes:
        camera: intrinsics and lens.
        camera_from_mount: `camera_from_tool`, or `camera_from_base` for eye-to-hand.
        holder_from_world: `base_from_world`, or `tool_from_world` for eye-to-hand.
        target_scale: true size of the target over its stated size.
        mount: `"eye_in_hand"`, `"eye_to_hand"`, or `"hand_to_hand"` for a camera on the hand of one
            arm and the target on the hand of another.
        robot_error: model of the error of reported poses; None if they are assumed to be exact.
        region: region from which the target was seen in the fitted data; None if not fitted.
        target_shape: deviation of the target's points from their stated places; None if there is
            none.
        depth_bias: bias of the depths that the camera measures; None if it measures none.
        base_from_other_base: base of the arm that carries the target in the base of the camera's
            arm, of a hand-to-hand calibration; None for others.

    For example:

        >>> camera = sv.Camera(800.0, 800.0, 320.0, 240.0, sv.cameras.Pinhole(), (640, 480))
        >>> camera_at_flange = sv.Calibration.eye_in_hand(camera, np.eye(4), np.eye(4))
        >>> base_from_tool = np.diag([1.0, -1.0, -1.0, 1.0])  # looking down ...
        >>> base_from_tool[2, 3] = 0.5  # ... from 0.5 m above the base
        >>> pixels, valid = camera_at_flange.project(base_from_tool, np.array([[0.1, 0.0, 0.0]]))
        >>> print(np.round(pixels), valid)
        [[480. 240.]] [ True]
    """

    camera: Camera
    camera_from_mount: SE3
    holder_from_world: SE3
    target_scale: Float[Array, ""]
    mount: str = eqx.field(static=True)
    robot_error: RobotError | None
    region: ViewedRegion | None
    target_shape: TargetShape | None
    depth_bias: DepthBias | None
    base_from_other_base: SE3 | None

    def __init__(
        self,
        camera: Camera,
        camera_from_mount: SE3,
        holder_from_world: SE3,
        mount: str,
        target_scale: ScalarLike = 1.0,
        robot_error: RobotError | None = None,
        region: ViewedRegion | None = None,
        target_shape: TargetShape | None = None,
        depth_bias: DepthBias | None = None,
        base_from_other_base: SE3 | None = None,
    ):
        """Store the parts of the chain; arguments as the class's attributes.

        Raises:
            ValueError: an unknown mount.
        """
        # Refuse an unknown mount before any fit starts.
        mount_frames(mount)
        self.camera = camera
        self.camera_from_mount = camera_from_mount
        self.holder_from_world = holder_from_world
        # An array, not a float: a fit may estimate it, and a new value must not compile again.
        self.target_scale = as_float_array(target_scale)
        self.mount = mount
        self.robot_error = robot_error
        self.region = region
        self.target_shape = target_shape
        self.depth_bias = depth_bias
        self.base_from_other_base = base_from_other_base

    def __repr__(self) -> str:
        # A traced calibration, inside `jit`, has no figures to show.
        if is_traced(self):
            return super().__repr__()
        parts = [
            f"{name}: {transform_text(host_matrices(transform))}"
            for name, transform in self.transforms.items()
        ]
        if self.robot_error is not None:
            parts.append(f"robot error: {type(self.robot_error.field).__name__}")
        if float(self.target_scale) != 1.0:
            parts.append(f"target: {float(self.target_scale):.5g} of its stated size")
        return "\n  ".join([f"<{self.mount} calibration", repr(self.camera), *parts]) + ">"

    @classmethod
    def eye_in_hand(
        cls,
        camera: Camera,
        camera_from_tool: PoseLike,
        base_from_world: PoseLike,
        target_scale: ScalarLike = 1.0,
    ) -> "Calibration":
        """Return the calibration of a camera on the hand, with a target fixed in the base frame."""
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
        """Return the calibration of a camera fixed in the base frame, with a target on the tool."""
        return cls(
            camera,
            as_se3(camera_from_base),
            as_se3(tool_from_world),
            "eye_to_hand",
            target_scale,
        )

    @classmethod
    def hand_to_hand(
        cls,
        camera: Camera,
        camera_from_tool: PoseLike,
        other_tool_from_world: PoseLike,
        base_from_other_base: PoseLike,
        target_scale: ScalarLike = 1.0,
    ) -> "Calibration":
        """Return the calibration of a camera on one arm's hand, with a target on another's.

        The chain is `camera_from_tool @ tool_from_base @ base_from_other_base @
        other_base_from_other_tool @ other_tool_from_world`.

        Args:
            camera: intrinsics and lens.
            camera_from_tool: camera on the hand of its arm.
            other_tool_from_world: target on the hand of the other arm.
            base_from_other_base: base of the other arm in the base of the camera's arm.
            target_scale: true size of the target over its stated size.
        """
        return cls(
            camera,
            as_se3(camera_from_tool),
            as_se3(other_tool_from_world),
            "hand_to_hand",
            target_scale,
            base_from_other_base=as_se3(base_from_other_base),
        )

    def true_points(self, points: Float[AnyArray, "*points 3"]) -> Float[Array, "*points 3"]:
        """Return the true positions of target points in its frame, with its true shape and size.

        Args:
            points: points as stated, m.
        """
        if self.target_shape is not None:
            points = self.target_shape.displaced(points)
        return self.target_scale * points

    @property
    def transforms(self) -> dict[str, SE3]:
        """All transforms by their public names."""
        mount_name, holder_name = self.transform_names
        ends = {mount_name: self.camera_from_mount, holder_name: self.holder_from_world}
        return (
            ends if self.base_from_other_base is None else ends | {BASES: self.base_from_other_base}
        )

    @property
    def camera_from_tool(self) -> SE3:
        """The hand-eye transform (eye-in-hand and hand-to-hand)."""
        return self._transform("camera_from_mount", "camera_from_tool")

    @property
    def camera_from_base(self) -> SE3:
        """The pose of the base in the camera frame (eye-to-hand)."""
        return self._transform("camera_from_mount", "camera_from_base")

    @property
    def base_from_world(self) -> SE3:
        """The pose of the target in the base frame (eye-in-hand)."""
        return self._transform("holder_from_world", "base_from_world")

    @property
    def tool_from_world(self) -> SE3:
        """The pose of the target in the tool frame (eye-to-hand)."""
        return self._transform("holder_from_world", "tool_from_world")

    @property
    def other_tool_from_world(self) -> SE3:
        """The pose of the target in the frame of the hand that carries it (hand-to-hand)."""
        return self._transform("holder_from_world", "other_tool_from_world")

    def _transform(self, attribute: str, name: str) -> SE3:
        """Return a transform by its public name, if this mount has it.

        Raises:
            AttributeError: the name belongs to the other mount.
        """
        if name not in self.transform_names:
            raise AttributeError(
                f"an {self.mount} calibration has {' and '.join(self.transform_names)}, not {name}"
            )
        return getattr(self, attribute)

    @property
    def transform_names(self) -> tuple[str, str]:
        """The public names of `camera_from_mount` and `holder_from_world` for this mount."""
        return transform_names(self.mount)

    @property
    def field(self) -> AbstractField | None:
        """The robot error field; None if robot error is not modelled."""
        return None if self.robot_error is None else self.robot_error.field

    @property
    def uncorrected(self) -> "Calibration":
        """The calibration without robot error, for programs that use the transforms only."""
        return self if self.robot_error is None else with_fields(self, robot_error=None)

    def camera_from_world(self, base_from_tool: CommandLike, *, corrected: bool = True) -> SE3:
        """Return the extrinsics at the given robot poses, `(*views)`, by the chain of Eq. 10.

        Args:
            base_from_tool: what the robot reports: poses, or `arm.command(joints)`. Hand-to-hand:
                the `command` of a data set, or poses of the camera's hand in the other hand.
            corrected: apply the robot error, if one was fitted; False uses the reported poses.
        """
        reported = self.with_bases(as_command(base_from_tool))
        error = self.robot_error if corrected else None
        return chain_of_transforms(
            self.camera_from_mount, self.holder_from_world, self.mount, error, reported
        )

    def camera_from_world_matrices(self, reported: Command) -> Float[AnyArray, "views 4 4"]:
        """Return the extrinsics `(views)` of `camera_from_world` as matrices."""
        reported = self.with_bases(reported)
        camera_from_mount, holder_from_world = self.camera_from_mount, self.holder_from_world
        chain = camera_from_mount, holder_from_world, self.mount, self.robot_error
        if is_traced(self, reported):
            return chain_matrices(*chain, reported)
        if self.robot_error is not None:
            return over_padded_views(lambda padded: chain_matrices(*chain, padded), reported)
        # The chain of Eq. 10 without a robot error is a product of matrices: nothing to compile.
        mount_from_holder = host_mount_from_holder(self.mount, reported.base_from_tool)
        return (
            host_matrices(camera_from_mount)
            @ host_matrices(mount_from_holder)
            @ host_matrices(holder_from_world)
        )

    def with_bases(self, reported: Command) -> Command:
        """Return what two arms report with the pose of one hand in the other's frame.

        What one arm reports is returned as it is.
        """
        base, hands = self.base_from_other_base, reported.hands
        if base is None or hands is None:
            return reported
        if is_traced(base, hands):
            return Command(hands.other_tool_from_tool(base), reported.joints, hands)
        return Command(hands.host_other_tool_from_tool(base), reported.joints, hands)

    def require_one_arm(self, function: str) -> None:
        """Raise a ValueError if two arms move camera and target, for a function that takes one."""
        if self.mount not in ONE_ARM_MOUNTS:
            raise ValueError(
                f"{function}: expected a calibration of one arm, found {self.mount}: with a camera "
                "on one hand and the target on another there is no fixed world"
            )

    def command_for(
        self,
        camera_from_world: PoseLike,
        *,
        corrected: bool = True,
        near: JointsLike | None = None,
    ) -> SE3:
        """Return the robot pose `base_from_tool` that puts the camera at a wanted pose (Eq. 19).

        Args:
            camera_from_world: the wanted camera poses, `(*views)`.
            corrected: compensate the robot error, so that the actual pose is the wanted one.
            near: joint angles near which inverse kinematics search, if the errors of an arm were
                fitted. The result is NaN if no solution is found there.

        Raises:
            ValueError: the errors of an arm were fitted, and `near` is not given; or two arms.
        """
        return self.robot_command_for(
            camera_from_world, corrected=corrected, near=near
        ).base_from_tool

    def robot_command_for(
        self,
        camera_from_world: PoseLike,
        *,
        corrected: bool = True,
        near: JointsLike | None = None,
    ) -> Command:
        """Return the command of `command_for`, with joint angles if an arm's errors were fitted."""
        self.require_one_arm("command_for")
        actual_pose = base_from_tool_for(self, camera_from_world)
        # Without robot error the reported pose is the true one. With it, the error depends on the
        # pose that is asked for, so the robot error model has to be inverted.
        if self.robot_error is None or not corrected:
            return Command(actual_pose)
        return self.robot_error.command(actual_pose, near)

    def joints_for(
        self,
        camera_from_world: PoseLike,
        near: JointsLike,
    ) -> Float[Array, "*views joints"]:
        """Return the command of `command_for` in joint angles, for a calibration with a fitted arm.

        Raises:
            ValueError: no errors of an arm were fitted.
        """
        # With the robot error applied; without it a command has no joint angles.
        joints = self.robot_command_for(camera_from_world, near=near).joints
        if joints is None:
            raise ValueError(
                "this calibration knows no arm; robots.joints_for_pose finds joint angles"
            )
        return joints

    def points_in_camera(
        self,
        base_from_tool: CommandLike,
        points: Float[Array, "*points 3"] | np.ndarray,
        *,
        corrected: bool = True,
    ) -> Float[Array, "*transformed 3"]:
        """Return target points in the camera frame (Eq. 1), m; arguments as in `project`."""
        reported = as_command(base_from_tool)
        return points_in_camera(self, reported, as_float_array(points), corrected)

    def project(
        self,
        base_from_tool: CommandLike,
        points: Float[Array, "*points 3"] | np.ndarray,
        *,
        corrected: bool = True,
    ) -> tuple[Float[Array, "*pixels 2"], Bool[Array, "*pixels"]]:
        """Return the pixels of target points seen from the given robot poses, and their validity.

        Args:
            base_from_tool: what the robot reports, `(*views)` poses, or `arm.command(joints)`.
            points: `(N, 3)` for all views or `(*views, N, 3)`, in the target frame, m.
            corrected: apply the robot error, if one was fitted; False uses the reported poses.

        Returns:
            pixels `(*views, N, 2)`, NaN where `valid` `(*views, N)` is False.
        """
        return projected_points(self, as_command(base_from_tool), as_float_array(points), corrected)

    def to_dict(
        self,
        run: str | None = None,
        warnings: Sequence[str] = (),
        *,
        source: str | None = None,
        uncertainty: Mapping[str, Any] | None = None,
        pictures: Sequence[str] = (),
    ) -> dict[str, Any]:
        """Return a dictionary of plain numbers with names and units, as written by `save`."""
        return content_of(
            self, run, warnings, source=source, uncertainty=uncertainty, pictures=pictures
        )

    @classmethod
    def from_dict(
        cls,
        content: dict[Any, Any],
        lens: AbstractLens | None = None,
        field: AbstractField | None = None,
    ) -> "Calibration":
        """Build a calibration from the dictionary that `to_dict` returns.

        Args:
            content: the dictionary.
            lens: a lens of a class of your own; its numbers are read from `content`.
            field: a robot error field of a class of your own; its numbers are read from `content`.

        Raises:
            ValueError: naming the entry that is missing or wrong.
        """
        return cls(**parts_of(content, lens, field))

    def save(
        self,
        path: str | os.PathLike[str],
        run: str | None = None,
        warnings: Sequence[str] = (),
        *,
        source: str | None = None,
        uncertainty: Mapping[str, Any] | None = None,
        pictures: Sequence[str] = (),
    ) -> None:
        """Write a human-readable file atomically: YAML, or JSON where the name ends in `.json`.

        Args:
            path: of the file.
            run: name of the run that produced this, written to all its files.
            warnings: sentences such as a fit's `warnings`; for human readers, not read back.
            source: where the calibration is from, such as the data set's name; for human readers.
            uncertainty: how well it is known, as `JointFit.save` writes it.
            pictures: digests of the pictures that it was fitted to, by `dataset.picture_digests`.

        Raises:
            ValueError: a value that no calibration has, so that the file could not be read back.
        """
        # The validation library is imported only where files are read or written.
        from ..schemas.calibration import CALIBRATION_SCHEMA
        from ..schemas.validation import write_validated

        content = self.to_dict(
            run, warnings, source=source, uncertainty=uncertainty, pictures=pictures
        )
        write_validated(path, content, CALIBRATION_SCHEMA)

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        lens: AbstractLens | None = None,
        field: AbstractField | None = None,
    ) -> "Calibration":
        """Read a calibration file that `save` wrote.

        Args:
            path: of the file.
            lens: a lens of a class of your own; its numbers are read from the file.
            field: a robot error field of a class of your own; its numbers are read from the file.

        Raises:
            FileNotFoundError: the file is missing.
            ValueError: naming the file and the entry that is wrong.
        """
        content = calibration_content(path)
        with errors_at(path):
            return cls.from_dict(content, lens, field)
