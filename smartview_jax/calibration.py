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
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Bool, Float, ScalarLike

from .cameras import AbstractLens, Camera, lens_by_name, lens_name
from .files import dump_yaml, read_yaml, write_atomically
from .geometry import PoseLike, as_se3, transform_points
from .robots import AbstractField, RobotError, field_by_name, field_name

FORMAT_VERSION = 1

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
    """

    camera: Camera
    camera_from_mount: SE3
    holder_from_world: SE3
    target_scale: Float[Array, ""]
    mount: str = eqx.field(static=True)
    robot_error: RobotError | None

    def __init__(
        self,
        camera: Camera,
        camera_from_mount: SE3,
        holder_from_world: SE3,
        mount: str,
        target_scale: ScalarLike = 1.0,
        robot_error: RobotError | None = None,
    ):
        mount_frames(mount)
        self.camera = camera
        self.camera_from_mount = camera_from_mount
        self.holder_from_world = holder_from_world
        self.target_scale = jnp.asarray(target_scale, dtype=float)
        self.mount = mount
        self.robot_error = robot_error

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
    def uncorrected(self) -> "Calibration":
        """The same without the robot's error: what programs have that take the transforms alone."""
        return dataclasses.replace(self, robot_error=None)

    def camera_from_world(self, base_from_tool: PoseLike, corrected: bool = True) -> SE3:
        """Extrinsics at the given robot poses, `(*views)` (Eq. 10).

        Args:
            base_from_tool: what the robot reports.
            corrected: for the robot's error, where one was fitted; if not, the bare chain.
        """
        reported, error = as_se3(base_from_tool), self.robot_error if corrected else None
        pose = reported if error is None else error.true_pose(reported)
        robot = mount_from_holder(self.mount, pose)
        return self.camera_from_mount @ robot @ self.holder_from_world

    def command_for(self, camera_from_world: PoseLike, corrected: bool = True) -> SE3:
        """The robot pose `base_from_tool` that puts the camera at a wanted pose (Eq. 19).

        Args:
            camera_from_world: wanted, `(*views)`.
            corrected: for the robot's error: what to tell the robot so that it gets there.
        """
        robot = (
            self.camera_from_mount.inverse()
            @ as_se3(camera_from_world)
            @ self.holder_from_world.inverse()
        )
        pose, error = mount_from_holder(self.mount, robot), self.robot_error if corrected else None
        return pose if error is None else error.reported_pose(pose)

    def points_in_camera(
        self,
        base_from_tool: PoseLike,
        points: Float[Array, "*points 3"] | np.ndarray,
        corrected: bool = True,
    ) -> Float[Array, "*moved 3"]:
        """Target points in the camera frame, m; arguments as in `project`."""
        points = self.target_scale * jnp.asarray(points, dtype=float)
        return transform_points(self.camera_from_world(base_from_tool, corrected), points)

    def project(
        self,
        base_from_tool: PoseLike,
        points: Float[Array, "*points 3"] | np.ndarray,
        corrected: bool = True,
    ) -> tuple[Float[Array, "*pixels 2"], Bool[Array, "*pixels"]]:
        """Pixels of target points seen from the given robot poses, and where they are valid.

        Args:
            base_from_tool: what the robot reports, `(*views)` transforms.
            points: `(N, 3)` for all views or `(*views, N, 3)`, in the target frame, m.
            corrected: for the robot's error, where one was fitted; if not, the bare chain.

        Returns:
            pixels `(*views, N, 2)`, NaN where `valid` `(*views, N)` is False.
        """
        return self.camera.project(self.points_in_camera(base_from_tool, points, corrected))

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers with their names and units, as written by `save`."""
        camera = self.camera
        lens = {name: float(value) for name, value in vars(camera.lens).items()}
        content: dict[str, Any] = {
            "smartview_calibration": FORMAT_VERSION,
            "units": {"length": "m", "angle": "rad", "image": "px"},
            "mount": self.mount,
            "camera": {
                "image_size": list(camera.image_size),
                **{key: float(getattr(camera, key)) for key in ("alpha_u", "alpha_v", "u0", "v0")},
                "lens": {"model": lens_name(camera.lens), **lens},
            },
        }
        transforms = (self.camera_from_mount, self.holder_from_world)
        for name, transform in zip(self.transform_names, transforms, strict=True):
            content[name] = {
                "translation": np.asarray(transform.translation()).tolist(),
                "quaternion_wxyz": np.asarray(transform.rotation().wxyz).tolist(),
            }
        content["target_scale"] = float(self.target_scale)
        if self.robot_error is not None:
            content["robot_error"] = _robot_error_to_dict(self.robot_error)
        return content

    @classmethod
    def from_dict(
        cls,
        content: dict[str, Any],
        lens: AbstractLens | None = None,
        field: AbstractField | None = None,
    ) -> "Calibration":
        """The inverse of `to_dict`; `lens` and `field` stand for models this library doesn't know.

        Raises:
            ValueError: naming the entry that is missing or wrong.
        """
        version = content.get("smartview_calibration")
        if version != FORMAT_VERSION:
            raise ValueError(f"smartview_calibration: expected {FORMAT_VERSION}, found {version!r}")
        try:
            mount = content["mount"]
            names = tuple(name.format(*mount_frames(mount)) for name in _TRANSFORM_PATTERNS)
            camera = _camera_from_dict(content["camera"], lens)
            mounted, held = (_transform_from_dict(name, content[name]) for name in names)
            error = content.get("robot_error")
            return cls(
                camera,
                mounted,
                held,
                mount,
                float(content["target_scale"]),
                None if error is None else _robot_error_from_dict(error, field),
            )
        except KeyError as error:
            raise ValueError(f"entry {error.args[0]!r} is missing") from error

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a YAML file a person can read, whole or not at all."""
        write_atomically(path, dump_yaml(self.to_dict()))

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


def _camera_from_dict(content: dict[str, Any], lens: AbstractLens | None) -> Camera:
    numbers = dict(content["lens"])
    model = numbers.pop("model")
    template = lens_by_name(model) if lens is None else lens
    if set(numbers) != set(vars(template)):
        raise ValueError(
            f"camera.lens: expected the numbers {sorted(vars(template))}, found {sorted(numbers)}"
        )
    fitted = type(template)(**{name: float(value) for name, value in numbers.items()})
    width, height = content["image_size"]
    alpha_u, alpha_v, u0, v0 = (float(content[key]) for key in ("alpha_u", "alpha_v", "u0", "v0"))
    return Camera(alpha_u, alpha_v, u0, v0, fitted, (int(width), int(height)))


def _transform_from_dict(name: str, content: dict[str, Any]) -> SE3:
    translation = np.asarray(content["translation"], dtype=float)
    quaternion = np.asarray(content["quaternion_wxyz"], dtype=float)
    if translation.shape != (3,) or quaternion.shape != (4,):
        raise ValueError(f"{name}: expected 3 and 4 numbers")
    if not (np.isfinite(translation).all() and abs(np.linalg.norm(quaternion) - 1.0) < 1e-6):
        raise ValueError(f"{name}: not a finite translation and a unit quaternion")
    return SE3.from_rotation_and_translation(SO3(jnp.asarray(quaternion)), jnp.asarray(translation))


def _robot_error_to_dict(error: RobotError) -> dict[str, Any]:
    """Every coefficient by name, so that the file can be read without this library."""
    numbers = {name: np.asarray(value).tolist() for name, value in vars(error.field).items()}
    coefficients = np.asarray(error.coefficients).tolist()
    return {
        "field": {"model": field_name(error.field), **numbers},
        "coefficients": dict(zip(error.field.names, coefficients, strict=True)),
    }


def _robot_error_from_dict(content: dict[str, Any], field: AbstractField | None) -> RobotError:
    numbers = dict(content["field"])
    model = numbers.pop("model")
    kind = field_by_name(model) if field is None else type(field)
    known = {part.name for part in dataclasses.fields(kind)}
    if set(numbers) != known:
        raise ValueError(f"robot_error.field: expected {sorted(known)}, found {sorted(numbers)}")
    basis = kind(**{name: jnp.asarray(value, dtype=float) for name, value in numbers.items()})
    given = content["coefficients"]
    if set(given) != set(basis.names):
        raise ValueError(
            f"robot_error.coefficients: expected {', '.join(basis.names)}; found {', '.join(given)}"
        )
    return RobotError(basis, jnp.array([float(given[name]) for name in basis.names]))
