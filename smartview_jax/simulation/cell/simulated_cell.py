"""Simulate a whole cell: commands in, pictures out; only the judge sees the true state."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from ...argument_checks import require_distinct
from ...calibration import Calibration
from ...cameras import Camera
from ...geometry import as_se3, check_rigid, host_poses, host_transformed, host_transforms
from ...robots import Command, CommandLike, Gripper, JointsLike, SerialArm, joints_for_pose
from ...targets import AbstractTarget
from ..arm_scenes import HOME_JOINTS
from ..polyhedra import Polyhedron
from ..solid_scenes import SolidScene, Surface, render_solids
from ..textures import Texture, speckled
from .fixtures import Bin, FixedBox, board_on_table, table_texture
from .interface import CellError
from .objects import CellObject
from .physics import Physics
from .truth import BOARD, CellTruth, random_truth

MAX_DROPS = 6
"""Largest number of drops until all objects lie in the bin."""

CLEAR_HEIGHT = 0.03
"""Height of the gripper above everything else at which its path need not be simulated, m."""

HELD_HEIGHT = 2e-3
"""Height of an object's lowest point above the bin or the table to count as lifted, m."""

TABLE_HALF_WIDTH = 0.6
"""Half of the width of the table in the pictures, m."""

CENTRE = (float(BOARD.points[:, 0].mean()), float(BOARD.points[:, 1].mean()))
"""Middle of the board, and of the bin, m."""

STANDARD_BIN = Bin(CENTRE)
"""The default bin of a cell, at the place of the board."""

SAMPLES, STRIDE = 8, 3
"""Number of rays in a pixel at an edge, and step between the pixels that are sampled first."""

EXPOSURE = 1.3
"""Exposure of the pictures."""


class Judgement(NamedTuple):
    """The true state of a cell, to judge the outcome of an action.

    Attributes:
        held: names of the objects between both fingers and above the bin.
        world_from_object: true pose of each object by its name, m.
        world_from_gripper: true pose of the gripper's frame, m.
        opening: true distance between the fingers, m.
    """

    held: tuple[str, ...]
    world_from_object: dict[str, Float[np.ndarray, "4 4"]]
    world_from_gripper: Float[np.ndarray, "4 4"]
    opening: float


class SimulatedCell:
    """A cell whose arm, camera and objects are simulated; it has the methods of `Cell`.

    The arm's true kinematics, hand-eye transform and lens are drawn at random and known only to
    `judge`. The dynamics of the arm are ignored: the gripper moves as the true kinematics say, and
    its fingers act on objects with forces. It throws no shadow and is invisible to its own camera,
    which looks past it.
    """

    def __init__(
        self,
        seed: int = 0,
        *,
        truth: CellTruth | None = None,
        gripper: Gripper | None = None,
        bin: Bin | None = STANDARD_BIN,
        clutter: bool = True,
        blur: float = 0.7,
        noise: float = 1.0,
    ):
        """Set up the cell, with the board on the table and no objects.

        Args:
            seed: seed of everything random.
            truth: the true state; by default `random_truth` of the seed.
            bin: the bin for dropped objects; None for the bare table.
            clutter: whether the table is printed with labels and scraps.
            blur, noise: of the pictures, px and grey levels.

        Raises:
            ImportError: mujoco, trimesh or embreex is not installed (smartview-jax[cell]).
        """
        self._truth = truth or random_truth(seed)
        self.gripper: Gripper = gripper or Gripper()
        # A separate generator for the arm, independent of the pictures' noise.
        self._rng = np.random.default_rng((seed, 11))
        self._seed, self._pictures, self._bin = seed, 0, bin
        self._blur, self._noise = blur, noise
        self._table = table_texture(seed, clutter)
        self._table_with_board = board_on_table(self._truth.board, self._table)
        self._objects: tuple[CellObject, ...] = ()
        self.board_shown: bool = True
        self._joints = np.array(HOME_JOINTS, dtype=float)
        self._base_from_tool = self._truth.base_from_tool(self._joints, self._rng)
        self._physics = self._new_physics(())

    # Known to everyone.

    @property
    def arm(self) -> SerialArm:
        """The nominal arm."""
        return self._truth.arm

    @property
    def board(self) -> AbstractTarget:
        """The board for the calibration; its frame is the world."""
        return self._truth.board

    @property
    def centre(self) -> Float[np.ndarray, "3"]:
        """The middle of the working area on the table, in the world's frame, m."""
        if self._bin is not None:
            return np.array([*self._bin.centre, 0.0])
        return np.array([*self._truth.board.points.mean(axis=0)[:2], 0.0])

    @property
    def fixtures(self) -> tuple[FixedBox, ...]:
        """The walls of the bin, in the world's frame."""
        return () if self._bin is None or self.board_shown else self._bin.boxes

    # Actions of a person in the cell.

    def drop(self, objects: Sequence[CellObject], seed: int = 0) -> None:
        """Remove the board and let objects fall into the bin, or on the table.

        Args:
            objects: with different names.
            seed: seed of the fall; the same seed gives the same poses.

        Raises:
            ValueError: two objects have one name.
            CellError: they do not come to rest inside the bin.
        """
        self._set_objects(objects)
        for attempt in range(MAX_DROPS):
            # Each attempt is a new throw, reproducible by the seed.
            rng = np.random.default_rng((seed, 12, attempt))
            self._physics = self._new_physics(objects)
            z = 0.02
            for k, obj in enumerate(objects):
                middle = obj.solid.vertices.mean(axis=0)
                room = np.maximum(np.array(self._area) - 2.0 * obj.radius, 0.0)
                # A normal vector in four dimensions has a uniform direction, as a quaternion.
                rotation = Rotation.from_quat(rng.standard_normal(4)).as_matrix()
                z += obj.radius
                # One above the other, so that none is inside another at the start.
                position = [*(self.centre[:2] + (rng.random(2) - 0.5) * room), z]
                z += obj.radius + 0.005
                self._physics.place(k, host_poses(rotation, position - rotation @ middle))
            self._physics.fall()
            if all(self._lies_inside(k) for k in range(len(objects))):
                return
        raise CellError(f"after {MAX_DROPS} drops some objects still lie outside the bin")

    def place(
        self,
        objects: Sequence[CellObject],
        world_from_object: Sequence[Float[np.ndarray, "4 4"]],
    ) -> None:
        """Remove the board, put objects at poses and let them come to rest.

        Raises:
            ValueError: two objects have one name, the numbers of poses and objects differ, or a
                pose is not rigid; the cell is then unchanged.
            CellError: they do not come to rest.
        """
        # Everything is checked first, so that the visible objects always match the physics.
        poses = _checked_poses(world_from_object, [obj.name for obj in objects])
        self._set_objects(objects)
        self._physics = self._new_physics(objects)
        for k, pose in enumerate(poses):
            self._physics.place(k, pose)
        self._physics.settle()

    def show_board(self) -> None:
        """Put the board back on the table, without objects and bin."""
        self._objects, self.board_shown = (), True
        self._physics = self._new_physics(())

    def _set_objects(self, objects: Sequence[CellObject]) -> None:
        """Set the visible objects, and remove the board."""
        require_distinct("objects", [obj.name for obj in objects])
        self._objects, self.board_shown = tuple(objects), False

    @property
    def _area(self) -> tuple[float, float]:
        """The width and depth within which objects fall, m."""
        return (0.24, 0.18) if self._bin is None else self._bin.size[:2]

    def _new_physics(self, objects: Sequence[CellObject]) -> Physics:
        """Return new physics with the gripper at its current pose."""
        x, y, _ = self.centre
        physics = Physics(objects, self.fixtures, self.gripper, (float(x), float(y)), self._area)
        physics.place_gripper(self._true_gripper())
        physics.move_fingers(self.gripper.max_opening)
        return physics

    def _lies_inside(self, number: int) -> bool:
        """Return whether an object lies between the walls and has not sunk into the table."""
        solid = self._objects[number].solid.moved(self._physics.world_from_object(number))
        outside = (
            np.abs(solid.vertices[:, :2] - self.centre[:2]) > 0.5 * np.array(self._area) + 0.02
        )
        return bool(solid.vertices[:, 2].min() > -1e-3 and not outside.any())

    # The methods of `Cell`.

    def move(self, target: CommandLike | JointsLike | Sequence[float]) -> Command:
        """Move the tool as `Cell.move` does; the nominal arm solves for the joints."""
        joints = self._joints_of(target)
        # Joint readings are checked here; poses are checked when they are solved.
        exceeded = np.asarray(self.arm.violated_limits(joints))
        if exceeded.any():
            raise CellError(f"joint {1 + int(np.flatnonzero(exceeded)[0])} is beyond its limit")
        before = self._lowest_of_gripper()
        base_from_tool = self._truth.base_from_tool(joints, self._rng)
        # Reports follow the nominal arm, motions the true one.
        self._joints, self._base_from_tool = joints, base_from_tool
        clear = min(before, self._lowest_of_gripper()) > self._top + CLEAR_HEIGHT
        # High above everything there is nothing to touch: the motion takes no time.
        if clear and not any(self._physics.touched_by_fingers().values()):
            self._physics.place_gripper(self._true_gripper())
        else:
            self._physics.lead_gripper(self._true_gripper())
        return self.where()

    def picture(self) -> UInt8[np.ndarray, "rows columns"]:
        """Return the camera's picture; each has its own noise."""
        self._pictures += 1
        return render_solids(
            self._truth.calibration.uncorrected,
            host_transforms(self._base_from_tool),
            SolidScene(self._surfaces()),
            blur=self._blur,
            noise=self._noise,
            exposure=EXPOSURE,
            seed=self._seed * 100_003 + self._pictures,
            samples=SAMPLES,
            stride=STRIDE,
        )

    def set_gripper(self, width: float) -> float:
        """Move the fingers as `Cell.set_gripper` does."""
        if not 0.0 <= width <= self.gripper.max_opening:
            raise ValueError(
                f"width {width!r} m; expected 0 to {self.gripper.max_opening:g} m, metres"
            )
        return self._physics.move_fingers(width)

    def where(self) -> Command:
        """Return the robot's report: the nominal arm's pose at its joints."""
        return self.arm.command(self._joints)

    def _joints_of(self, target: CommandLike | JointsLike | Sequence[float]) -> np.ndarray:
        if isinstance(target, Command):
            target = target.base_from_tool if target.joints is None else target.joints
        array = None if hasattr(target, "wxyz_xyz") else np.asarray(target, dtype=float)
        if array is not None and array.shape == (self.arm.joint_count,):
            if not np.isfinite(array).all():
                raise CellError(f"joint readings that are not finite: {array.tolist()}")
            return array
        pose = as_se3(target)  # pyright: ignore[reportArgumentType]
        # The controller knows only the nominal arm, so that the true one misses the pose.
        solution = joints_for_pose(self.arm, pose, self._joints)
        if pose.wxyz_xyz.shape != (7,) or not bool(solution.is_solved):
            raise CellError(f"the arm does not get there: {solution.status_text()}")
        return np.asarray(solution.joints)

    def _true_gripper(self) -> Float[np.ndarray, "4 4"]:
        """Return the true pose of the gripper in the world."""
        world_from_tool = self._truth.world_from_base @ self._base_from_tool
        return world_from_tool @ self.gripper.tool_from_gripper

    def _lowest_of_gripper(self) -> float:
        """Return the height of the gripper's lowest point, m."""
        vertices, _ = self.gripper.mesh(self.gripper.max_opening)
        return float(host_transformed(self._true_gripper(), vertices)[:, 2].min())

    @property
    def _top(self) -> float:
        """The height of the highest point of objects and fixtures, m."""
        tops = [float(box.centre[2] + 0.5 * box.size[2]) for box in self.fixtures]
        tops += [float(solid.vertices[:, 2].max()) for solid in self._solids()]
        return max(tops, default=0.0)

    # Visible only to the judge and a bystander.

    def judge(self) -> Judgement:
        """Return the true state; code that drives the cell must not use it."""
        poses = {
            obj.name: self._physics.world_from_object(k) for k, obj in enumerate(self._objects)
        }
        touched = self._physics.touched_by_fingers()
        # Without a bin an object counts as lifted as soon as it is off the table.
        floor = 0.0 if self._bin is None or self.board_shown else self._bin.rim
        lifted = [solid.vertices[:, 2].min() > floor + HELD_HEIGHT for solid in self._solids()]
        held = tuple(
            self._objects[k].name for k in sorted(touched["left"] & touched["right"]) if lifted[k]
        )
        return Judgement(held, poses, self._physics.world_from_gripper, self._physics.opening)

    def judge_tool(self) -> Float[np.ndarray, "4 4"]:
        """Return the true `base_from_tool`, m; code that drives the cell must not use it."""
        return self._base_from_tool.copy()

    @property
    def truth(self) -> CellTruth:
        """The true kinematics, hand-eye transform and lens, for the judge."""
        return self._truth

    def watch(
        self, camera_from_world: Float[np.ndarray, "4 4"], camera: Camera
    ) -> UInt8[np.ndarray, "rows columns"]:
        """Return the picture of a bystander's camera, with the gripper.

        Args:
            camera_from_world: pose of the bystander's camera.
            camera: its intrinsics and lens.
        """
        identity = host_transforms(np.eye(4))
        bystander = Calibration.eye_in_hand(camera, identity, identity)
        vertices, triangles = self.gripper.mesh(
            min(max(self._physics.opening, 0.0), self.gripper.max_opening)
        )
        vertices = host_transformed(self._physics.world_from_gripper, vertices)
        hand = Surface(vertices, triangles, speckled(0.15, 0.02, 0.01))
        scene = SolidScene((*self._surfaces(), hand))
        base_from_tool = host_transforms(np.linalg.inv(camera_from_world))
        return render_solids(
            bystander, base_from_tool, scene, exposure=EXPOSURE, samples=8, stride=STRIDE
        )

    def _solids(self) -> list[Polyhedron]:
        return [
            obj.solid.moved(self._physics.world_from_object(k))
            for k, obj in enumerate(self._objects)
        ]

    def _surfaces(self) -> tuple[Surface, ...]:
        """Return all visible surfaces: table, bin and objects."""
        table = self._table_with_board if self.board_shown else self._table
        surfaces = [Surface.of_plane(TABLE_HALF_WIDTH, table)]
        surfaces += [box.surface for box in self.fixtures]
        for k, obj in enumerate(self._objects):
            pose = self._physics.world_from_object(k)
            surfaces.append(
                Surface.of_polyhedron(obj.solid.moved(pose), _moved_texture(obj.texture, pose))
            )
        return tuple(surfaces)


def _checked_poses(
    world_from_object: Sequence[Float[np.ndarray, "4 4"]], names: Sequence[str]
) -> Float[np.ndarray, "objects 4 4"]:
    """Return a pose for each named object; raise a ValueError if the numbers differ.

    A pose that is not rigid is an error too; the message names the object.
    """
    if len(world_from_object) != len(names):
        raise ValueError(
            f"world_from_object: expected a pose for each of {len(names)} objects, "
            f"found {len(world_from_object)}"
        )
    poses = np.array(world_from_object, dtype=float).reshape(-1, 4, 4)
    problems = check_rigid(poses, tuple(names))
    if problems:
        raise ValueError("; ".join(f"object {name}: {text}" for name, text in problems.items()))
    return poses


def _moved_texture(texture: Texture, world_from_object: Float[np.ndarray, "4 4"]) -> Texture:
    """Return an object's texture as a function of points in the world."""
    R, t = world_from_object[:3, :3], world_from_object[:3, 3]
    return lambda points: texture((points - t) @ R)
