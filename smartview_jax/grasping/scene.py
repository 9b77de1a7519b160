"""Describe the surroundings of a grasp: the calibrated robot, and the obstacles."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..argument_checks import MAX_COORDINATE, require_instance
from ..calibration import Calibration
from ..evaluation import CalibrationEstimate
from ..geometry import check_rigid, host_poses, host_transformed
from ..io import to_trimesh
from ..robots import BOX_CORNERS, BOX_TRIANGLES, JointsLike, SerialArm
from .localized import LocalizedObject, checked_object

if TYPE_CHECKING:
    from ..joint import RigEstimate, RigFit


MAX_CLEARANCE = 0.5
"""Largest margin and largest radius of a link, m; a larger one is in another unit."""


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
        """Return a box about the origin of its own frame; size along x, y and z, m.

        Raises:
            ValueError: a size that is not positive, or a pose that is not rigid.
        """
        lengths = np.asarray(size, dtype=float)
        if lengths.shape != (3,) or not (lengths > 0.0).all():
            raise ValueError(
                f"obstacle {name}: size: expected three positive lengths, found {size}"
            )
        for text in check_rigid(world_from_box[None], (name,)).values():
            raise ValueError(f"obstacle {name}: world_from_box: {text}")
        return cls(name, host_transformed(world_from_box, BOX_CORNERS * lengths), BOX_TRIANGLES)

    @classmethod
    def table(cls, half_width: float = 0.5, z: float = 0.0, thickness: float = 0.05) -> "Obstacle":
        """Return a square table about the world's z axis, with its top at height z, m.

        Raises:
            ValueError: as for `box`.
        """
        pose = host_poses(np.eye(3), np.array([0.0, 0.0, z - 0.5 * thickness]))
        return cls.box("table", (2.0 * half_width, 2.0 * half_width, thickness), pose)

    @classmethod
    def of_object(cls, localized: LocalizedObject) -> "Obstacle":
        """Return an object at its pose; its model needs faces."""
        pose, _ = checked_object(localized)
        mesh = to_trimesh(localized.model)
        vertices = host_transformed(pose, np.asarray(mesh.vertices))
        return cls(localized.model.name or "another object", vertices, np.asarray(mesh.faces))

    def check(self) -> None:
        """Raise a ValueError for a mesh with which collisions would not be found."""
        vertices, triangles = np.asarray(self.vertices), np.asarray(self.triangles)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or triangles.shape[1:] != (3,):
            raise ValueError(
                f"obstacle {self.name}: expected vertices (V, 3) and triangles (T, 3), found "
                f"{vertices.shape} and {triangles.shape}"
            )
        if not len(vertices) or not len(triangles):
            raise ValueError(f"obstacle {self.name}: it has no triangles")
        if not ((triangles >= 0) & (triangles < len(vertices))).all():
            raise ValueError(
                f"obstacle {self.name}: triangles: expected indices of {len(vertices)} vertices, "
                f"found {triangles.min()} to {triangles.max()}"
            )
        # NaN compares as False.
        if not (np.abs(vertices) <= MAX_COORDINATE).all():
            raise ValueError(
                f"obstacle {self.name}: vertices: expected metres, up to {MAX_COORDINATE:g} m from "
                f"the origin; found {np.abs(vertices).max():.4g}"
            )


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
            ValueError: the camera is not on the hand, an arm has no initial joints, an obstacle or
                a distance is not finite or not in metres, or the direction upwards is zero; the
                message says which.
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
        for obstacle in self.obstacles:
            obstacle.check()
        # A comparison with NaN would find every distance large enough.
        distances = {"margin": self.margin, "link_radius": self.link_radius or 0.0}
        for name, value in distances.items():
            if not 0.0 <= value <= MAX_CLEARANCE:
                raise ValueError(
                    f"{name}: expected metres, from 0 to {MAX_CLEARANCE:g}; found {value!r}"
                )
        if not 0.0 < float(np.linalg.norm(self.up)) < np.inf:
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
