"""Compute how objects fall, rest and are grasped, with MuJoCo.

The optional package mujoco is needed: `pip install smartview-jax[cell]`.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ...extras import import_extra
from ...geometry import host_poses
from ...robots import Gripper
from .fixtures import FixedBox
from .interface import CellError
from .objects import CellObject
from .physics_model import TIME_STEP, physics_xml

REST_SPEED = 2e-3
"""Speed below which an object is at rest, m/s and rad/s, if it stays so for `REST_TIME`."""

REST_TIME = 0.15
"""Time for which all objects have to be slow to count as at rest, s."""

MAX_FALL_TIME = 12.0
"""Longest time in which objects have to come to rest, s."""

FALL_SPEED = 0.8
"""Terminal speed of falling objects, m/s, as if in oil, so that no object jumps out of the bin."""

LINEAR_SPEED, ANGULAR_SPEED = 0.12, 1.0
"""Speeds of the gripper near objects, m/s and rad/s."""

STEPS_BETWEEN_CHECKS = 20
"""Number of steps after which the stability of the physics is checked."""

GRIP_TIME = 1.5
"""Longest time that the fingers move, s."""

FINGER_REST_SPEED = 5e-4
"""Speed below which a finger has stopped, m/s."""


class Physics:
    """The bodies of a cell and their motion; the world is the cell's, z upwards."""

    def __init__(
        self,
        objects: Sequence[CellObject],
        fixtures: Sequence[FixedBox],
        gripper: Gripper,
        guide_centre: tuple[float, float],
        guide_size: tuple[float, float],
    ):
        """Build the model; raise an ImportError without mujoco."""
        self._mujoco = import_extra("mujoco", "cell", "the physics of a cell")
        self.objects: tuple[CellObject, ...] = tuple(objects)
        self.gripper: Gripper = gripper
        self._model: Any = self._mujoco.MjModel.from_xml_string(
            physics_xml(objects, fixtures, gripper, guide_centre, guide_size)
        )
        # The model holds the fixed properties, the data the state.
        self._data: Any = self._mujoco.MjData(self._model)
        self._moving = False

    # Poses and state.

    def world_from_object(self, number: int) -> Float[np.ndarray, "4 4"]:
        """Return the pose of an object, m."""
        return _matrix(self._data.joint(f"o{number}").qpos)

    @property
    def world_from_gripper(self) -> Float[np.ndarray, "4 4"]:
        """The pose of the gripper's frame, m."""
        return _matrix(self._data.joint("gripper").qpos)

    @property
    def opening(self) -> float:
        """The distance between the fingers, m."""
        return float(sum(self._data.joint(name).qpos[0] for name in ("left", "right")))

    @property
    def energy(self) -> float:
        """The potential and kinetic energy of all bodies, J."""
        self._mujoco.mj_forward(self._model, self._data)
        return float(np.sum(self._data.energy))

    @property
    def time(self) -> float:
        """The simulated time, s."""
        return float(self._data.time)

    # Motions.

    def place(self, number: int, world_from_object: Float[np.ndarray, "4 4"]) -> None:
        """Put an object at a pose, without motion."""
        joint = self._data.joint(f"o{number}")
        # MuJoCo's arrays are views: they are written in place.
        joint.qpos[:], joint.qvel[:] = _numbers(world_from_object), 0.0
        self._mujoco.mj_forward(self._model, self._data)

    def place_gripper(self, world_from_gripper: Float[np.ndarray, "4 4"]) -> None:
        """Put the gripper at a pose, without motion and without touching anything on the way."""
        numbers = _numbers(world_from_gripper)
        joint = self._data.joint("gripper")
        joint.qpos[:], joint.qvel[:] = numbers, 0.0
        self._data.mocap_pos[0], self._data.mocap_quat[0] = numbers[:3], numbers[3:]
        self._mujoco.mj_forward(self._model, self._data)

    def fall(self) -> None:
        """Let the objects fall between guiding walls; a CellError if they do not come to rest."""
        mass = np.array([self._model.body(f"o{k}").mass[0] for k in range(len(self.objects))])
        guides = [self._model.geom(f"guide{k}").id for k in range(4)]
        # Terminal speed: the damping force balances the weight.
        gravity = -float(self._model.opt.gravity[2])
        try:
            self._model.geom_contype[guides] = self._model.geom_conaffinity[guides] = 1
            for k, m in enumerate(mass):
                # m g = damping * FALL_SPEED; objects turn freely.
                self._model.joint(f"o{k}").damping[:3] = m * gravity / FALL_SPEED
            self.settle()
        finally:
            self._model.geom_contype[guides] = self._model.geom_conaffinity[guides] = 0
            for k in range(len(mass)):
                self._model.joint(f"o{k}").damping[:] = 0.0
        # Without the walls, objects that leaned on them may move again.
        self.settle()

    def settle(self) -> None:
        """Let the objects move until all rest; a CellError if they do not."""
        # Contacts make speeds flicker, so all have to stay slow for a while.
        slow_since = self.time
        start = self.time

        def at_rest() -> bool:
            nonlocal slow_since
            speeds = [np.abs(self._data.joint(f"o{k}").qvel).max() for k in range(self.count)]
            if max(speeds, default=0.0) > REST_SPEED:
                slow_since = self.time
            return self.time - slow_since > REST_TIME

        self._run(MAX_FALL_TIME, at_rest)
        if not at_rest():
            raise CellError(f"objects are still moving {self.time - start:.1f} s after they fell")
        for k in range(self.count):
            self._data.joint(f"o{k}").qvel[:] = 0.0

    @property
    def count(self) -> int:
        """The number of objects."""
        return len(self.objects)

    def lead_gripper(self, world_from_gripper: Float[np.ndarray, "4 4"]) -> None:
        """Lead the gripper straight to a pose; a CellError if the physics becomes unstable."""
        # From the pose of the target, not of the body, which lags behind.
        start = _matrix(np.concatenate([self._data.mocap_pos[0], self._data.mocap_quat[0]]))
        shift = world_from_gripper[:3, 3] - start[:3, 3]
        turn = Rotation.from_matrix(world_from_gripper[:3, :3] @ start[:3, :3].T).as_rotvec()
        duration = 1.5 * max(
            float(np.linalg.norm(shift)) / LINEAR_SPEED,
            float(np.linalg.norm(turn)) / ANGULAR_SPEED,
            0.02,
        )
        begin = self.time

        def follow() -> bool:
            # s = 3 u^2 - 2 u^3 starts and ends at zero speed.
            u = min((self.time - begin) / duration, 1.0)
            s = u * u * (3.0 - 2.0 * u)
            # Rotated about one fixed axis, while the origin moves straight.
            rotation = Rotation.from_rotvec(s * turn).as_matrix() @ start[:3, :3]
            numbers = _numbers(host_poses(rotation, start[:3, 3] + s * shift))
            self._data.mocap_pos[0], self._data.mocap_quat[0] = numbers[:3], numbers[3:]
            return False

        self._run(duration, follow)
        # The held object stops swinging.
        self._run(0.1, lambda: False)

    def move_fingers(self, width: float) -> float:
        """Move the fingers towards a distance, until they stop, and return their distance, m.

        Raises:
            CellError: the physics became unstable.
        """
        # Each finger moves half of the distance.
        self._data.ctrl[:] = 0.5 * width
        slow_since = self.time

        def stopped() -> bool:
            nonlocal slow_since
            if max(abs(self._data.joint(n).qvel[0]) for n in ("left", "right")) > FINGER_REST_SPEED:
                slow_since = self.time
            return self.time - slow_since > 0.1

        self._run(GRIP_TIME, stopped)
        return self.opening

    def touched_by_fingers(self) -> dict[str, set[int]]:
        """Return the numbers of the objects that each finger, "left" or "right", touches."""
        touched: dict[str, set[int]] = {"left": set(), "right": set()}
        for contact in self._data.contact[: self._data.ncon]:
            names = [self._model.body(self._model.geom_bodyid[geom]).name for geom in contact.geom]
            # A contact names its bodies in either order.
            for finger, other in (names, names[::-1]):
                if finger in touched and other.startswith("o"):
                    touched[finger].add(int(other[1:]))
        return touched

    def _run(self, duration: float, each_step: Callable[[], bool]) -> None:
        """Step the physics for a duration, or until `each_step` returns True."""
        with self._whole_motion():
            end, step = self.time + duration - 0.5 * TIME_STEP, 0
            while self.time < end and not each_step():
                self._mujoco.mj_step(self._model, self._data)
                step += 1
                # MuJoCo counts its warnings, so that nothing is missed between the checks.
                if step % STEPS_BETWEEN_CHECKS == 0:
                    self._refuse_instability()
            self._refuse_instability()

    def _refuse_instability(self) -> None:
        """Raise a CellError if MuJoCo found invalid numbers."""
        warnings = self._mujoco.mjtWarning
        kinds = (warnings.mjWARN_BADQPOS, warnings.mjWARN_BADQVEL, warnings.mjWARN_BADQACC)
        if any(self._data.warning[int(kind)].number for kind in kinds):
            raise CellError(
                f"the physics became unstable after {self.time:.2f} s: something was pushed with "
                "more than the contacts can bear; drop the objects again"
            )

    @contextmanager
    def _whole_motion(self) -> Iterator[None]:
        """Mark a motion as running; raise a CellError if the last one was interrupted."""
        # The flag is still set if the previous motion did not finish.
        if self._moving:
            raise CellError("the last motion was interrupted or failed; drop the objects again")
        self._moving = True
        mujoco = self._mujoco
        # Without a handler MuJoCo writes its warnings to a file in the working folder.
        previous = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(lambda text: None)
        try:
            yield
        finally:
            mujoco.set_mju_user_warning(previous)
        self._moving = False


def _matrix(numbers: Float[np.ndarray, "7"]) -> Float[np.ndarray, "4 4"]:
    """Return a MuJoCo pose (position, and quaternion with its real part first) as a matrix."""
    return host_poses(Rotation.from_quat(np.roll(numbers[3:], -1)).as_matrix(), numbers[:3])


def _numbers(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "7"]:
    """Return a pose in MuJoCo's format."""
    return np.concatenate([pose[:3, 3], np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)])
