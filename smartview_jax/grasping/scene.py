"""Describe the surroundings of a grasp: the calibrated robot, and the obstacles."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..argument_checks import require_instance
from ..calibration import Calibration
from ..evaluation import CalibrationEstimate
from ..geometry import host_poses, host_transformed
from ..io import to_trimesh
from ..robots import BOX_CORNERS, BOX_TRIANGLES, JointsLike, SerialArm
from .localized import LocalizedObject, checked_object

if TYPE_CHECKING:
    from ..joint import RigEstimate, RigFit


class Obstacle(NamedTuple):
    """A mesh in the world that neither gripper nor arm may touch.

    Attributes:
        name: for messages, such as "bin wall +x".
        vertices: in the world's frame, m.
        triangles: indices of the vertices.
    """

    name: str
    vertices: Float[np.ndarray, "vertices 3"]
    triangles: Int[np.ndarray, "triangles 3"]

    @classmethod
    def box(
        cls,
        name: str,
        size: Sequence[float] | Float[np.ndarray, "3"],
        world_from_box: Float[np.ndarray, "4 4"],
    ) -> "Obstacle":
        """Return a box about the origin of its own frame; size along x, y and z, m."""
        vertices = BOX_CORNERS * np.asarray(size, dtype=float)
        return cls(name, host_transformed(world_from_box, vertices), BOX_TRIANGLES)

    @classmethod
    def table(cls, half_width: float = 0.5, z: float = 0.0, thickness: float = 0.05) -> "Obstacle":
        """Return a square table about the world's z axis, with its top at height z, m."""
        pose = host_poses(np.eye(3), np.array([0.0, 0.0, z - 0.5 * thickness]))
        return cls.box("table", (2.0 * half_width, 2.0 * half_width, thickness), pose)

    @classmethod
    def of_object(cls, localized: LocalizedObject) -> "Obstacle":
        """Return an object at its pose; its model needs faces."""
        pose, _ = checked_object(localized)
        mesh = to_trimesh(localized.model)
        vertices = host_transformed(pose, np.asarray(mesh.vertices))
        return cls(localized.model.name or "another object", vertices, np.asarray(mesh.faces))


@dataclasses.dataclass(frozen=True, eq=False)
class GraspScene:
    """The robot that grasps, and the obstacles around the object.

    Attributes:
        calibration: its world is the frame of all poses and obstacles; the camera is on the hand.
            Of a rig, any camera on the hand, such as `rig_fit.calibrations["left"]`.
        obstacles: bin, table, other objects.
        arm: the nominal arm; None if it is commanded by poses and its reach is unknown.
        near: joint readings at which the arm starts; required with an arm.
        estimate: fit with the calibration's covariance, of a rig the fit of all cameras; None
            takes the calibration as exact.
        margin: distance that gripper and arm keep from obstacles, m.
        link_radius: radius of the cylinders about the arm's links, which must not touch obstacles
            between pre-grasp and retreat, m; None leaves the links unchecked.
        up: direction against gravity, in the world's frame.

    For example:

        >>> table = sv.grasping.Obstacle.table()
        >>> cell = sv.GraspScene(fit.calibration, (table,), margin=0.002, estimate=fit.joint)
        >>> print(len(cell.obstacles), cell.arm)  # without an arm, commands are poses
        1 None
    """

    calibration: Calibration
    obstacles: tuple[Obstacle, ...] = ()
    arm: SerialArm | None = None
    near: JointsLike | None = None
    estimate: "CalibrationEstimate | RigFit | RigEstimate | None" = None
    margin: float = 1e-3
    link_radius: float | None = None
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Check the combination of fields.

        Raises:
            TypeError: a calibration of another type, such as the views of a rig.
            ValueError: the camera is not on the hand, an arm has no initial joints, or the
                direction upwards is zero; the message says which.
        """
        hint = "of a rig, give a camera on the hand, such as fit.calibrations['left']"
        require_instance("calibration", self.calibration, Calibration, hint)
        # With a fixed camera the target, and so the world, is on the tool.
        if self.calibration.mount != "eye_in_hand":
            raise ValueError(
                f"an {self.calibration.mount} calibration has its world on the tool, where the "
                "target is: commands that bring a tool to a place need a camera on the hand"
            )
        # Without a start the nearest solution is undefined.
        if self.arm is not None and self.near is None:
            raise ValueError(
                "an arm reaches a pose in several ways: give near=joints to begin from"
            )
        if self.link_radius is not None and self.arm is None:
            raise ValueError("link_radius: the links are known only with an arm")
        if not float(np.linalg.norm(self.up)) > 0.0:
            raise ValueError(f"up: expected a direction, found {self.up}")

    def with_obstacles(self, obstacles: Sequence[Obstacle]) -> "GraspScene":
        """Return the scene with more obstacles."""
        return dataclasses.replace(self, obstacles=(*self.obstacles, *obstacles))

    @property
    def triangles(self) -> Float[np.ndarray, "triangles 3 3"]:
        """The triangles of all obstacles in the world, m."""
        meshes = [obstacle.vertices[obstacle.triangles] for obstacle in self.obstacles]
        return np.concatenate([np.zeros((0, 3, 3)), *meshes])

    def with_objects(self, found: Sequence[LocalizedObject]) -> "GraspScene":
        """Return the scene with other found objects as obstacles, each at its pose."""
        return self.with_obstacles([Obstacle.of_object(obj) for obj in found])

    @property
    def up_direction(self) -> Float[np.ndarray, "3"]:
        """The unit vector against gravity, in the world's frame."""
        return np.array(self.up) / np.linalg.norm(self.up)
