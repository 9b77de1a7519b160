"""Let the simulated cell be camera and robot, to try everything without either."""

import threading
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from ..calibration import Calibration
from ..geometry import host_matrices, host_transforms
from ..io import DESCRIPTION_FILE, write_description
from ..simulation import CellError, SimulatedCell, drawn_calibration
from .motion import MotionLimits, refuse_if_stopped, straight_steps
from .sources import MoveRefusedError

WORKING_BOX = ((0.3, -0.6, 0.15), (1.3, 0.7, 1.1))
"""Opposite corners of the box in which the simulated arm moves by default, m."""

STEP_LENGTH, STEP_ANGLE = 0.05, float(np.deg2rad(15.0))
"""Largest step of the simulated arm, m and rad: each costs an inverse kinematics, and the box is
far from everything."""


class SimulatedSources:
    """The camera and the robot of one simulated cell."""

    def __init__(self, seed: int = 0, cell: SimulatedCell | None = None):
        """Set up the cell, with the board on the table.

        Raises:
            ImportError: a package of smartview-jax[cell] is not installed.
        """
        self.cell: SimulatedCell = cell or SimulatedCell(seed)
        # The renderer and the physics are used by one thread at a time.
        self.lock: threading.RLock = threading.RLock()
        self.lowest: float = float("inf")

    @property
    def drawing(self) -> Calibration:
        """The cell according to its drawing: rough transforms for the first views."""
        return drawn_calibration()

    @property
    def limits(self) -> MotionLimits:
        """Limits within which the arm touches nothing."""
        return MotionLimits(*WORKING_BOX)

    def write_description(self, folder: Path) -> None:
        """Begin the data set of this cell, unless the folder has a description already."""
        if not (folder / DESCRIPTION_FILE).exists():
            size = self.cell.truth.calibration.camera.image_size
            write_description(folder, self.cell.board, "eye_in_hand", size, "val_oat")

    def camera(self) -> "SimulatedCamera":
        """Return the camera."""
        return SimulatedCamera(self)

    def robot(self) -> "SimulatedRobot":
        """Return the robot."""
        return SimulatedRobot(self)


class SimulatedCamera:
    """The camera of a simulated cell; every picture has its own noise."""

    is_continuous: bool = True

    def __init__(self, sources: SimulatedSources):
        """Store the cell."""
        self._sources = sources

    def read(self) -> UInt8[np.ndarray, "..."]:
        """Return a picture."""
        with self._sources.lock:
            return self._sources.cell.picture()

    def close(self) -> None:
        """Do nothing; a simulation needs no closing."""


class SimulatedRobot:
    """The arm of a simulated cell."""

    def __init__(self, sources: SimulatedSources):
        """Store the cell."""
        self._sources = sources

    def pose(self) -> Float[np.ndarray, "4 4"]:
        """Return the reported pose."""
        with self._sources.lock:
            return host_matrices(self._sources.cell.where().base_from_tool)

    def move(
        self, base_from_tool: Float[np.ndarray, "4 4"], speed: float, stop: threading.Event
    ) -> None:
        """Move in small steps; the simulation takes no time for them."""
        with self._sources.lock:
            for pose in straight_steps(self.pose(), base_from_tool, STEP_LENGTH, STEP_ANGLE):
                refuse_if_stopped(stop)
                try:
                    self._sources.cell.move(host_transforms(pose))
                except CellError as error:
                    raise MoveRefusedError(str(error)) from error
                self._sources.lowest = min(self._sources.lowest, self._height())

    def _height(self) -> float:
        """Return the true height of the gripper's lowest point above the table, m."""
        cell = self._sources.cell
        vertices, _ = cell.gripper.mesh(cell.gripper.max_opening)
        pose = cell.judge().world_from_gripper
        return float((vertices @ pose[2, :3] + pose[2, 3]).min())

    def close(self) -> None:
        """Do nothing; a simulation needs no closing."""
