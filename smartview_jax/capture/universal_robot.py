"""Talk to a Universal Robots arm by its real-time interface, with the package `ur-rtde`."""

import threading
import time
from typing import Any

import numpy as np
from jaxtyping import Float

from ..extras import import_extra
from ..geometry import host_matrices, host_transforms, pose_codec
from .motion import refuse_if_stopped
from .sources import MoveRefusedError, SourceLostError

ACCELERATION = 0.25
"""Acceleration of motions, m/s^2: gentle, a quarter of the controller's default."""

STOP_DECELERATION = 2.0
"""Deceleration of a stop, m/s^2: from 0.1 m/s within 3 mm."""

POLL_SECONDS = 0.02
"""Time between two looks at whether a motion has ended or is to be stopped, s."""

MOTION_PATIENCE = 60.0
"""Longest time for a motion, s."""

ARRIVAL_TOLERANCE = 1e-3
"""Largest distance between the commanded and the reported position after a motion, m."""


class UniversalRobot:
    """A Universal Robots arm; it needs no program on the controller."""

    def __init__(self, host: str):
        """Connect for reading; a connection for motions is made by the first motion.

        Raises:
            ImportError: `ur-rtde` is not installed (smartview-jax[ur]).
            SourceLostError: the controller does not answer.
        """
        self._host = host
        self._codec = pose_codec("ur")
        self._control: Any = None
        receive = import_extra("rtde_receive", "ur", "a Universal Robots arm")
        try:
            self._receive: Any = receive.RTDEReceiveInterface(host)
        # The package raises RuntimeError, and other errors in other versions.
        except Exception as error:
            raise SourceLostError(f"{host} does not answer: {error}") from error

    def pose(self) -> Float[np.ndarray, "4 4"]:
        """Return the reported pose of the tool centre point."""
        try:
            if not self._receive.isConnected():
                raise SourceLostError(f"{self._host} has closed the connection")
            numbers = self._receive.getActualTCPPose()
        except RuntimeError as error:
            raise SourceLostError(f"{self._host}: {error}") from error
        row = np.asarray(numbers, dtype=float).reshape(1, -1)
        if row.shape != (1, 6) or not np.isfinite(row).all():
            raise SourceLostError(f"{self._host}: expected six numbers, found {list(numbers)}")
        return host_matrices(self._codec.decode(row, *self._codec.units))[0]

    def move(
        self, base_from_tool: Float[np.ndarray, "4 4"], speed: float, stop: threading.Event
    ) -> None:
        """Move in a straight line; the controller's own stop ends it."""
        refuse_if_stopped(stop)
        pose = host_transforms(base_from_tool)
        row = [float(x) for x in self._codec.encode(pose, *self._codec.units)]
        deadline = time.monotonic() + MOTION_PATIENCE
        try:
            control = self._connected_control()
            # Asynchronous, so that it can be stopped.
            if not control.moveL(row, speed, ACCELERATION, True):
                raise MoveRefusedError(f"{self._host}: the controller refuses the motion")
            while control.getAsyncOperationProgress() >= 0:
                if stop.is_set() or time.monotonic() > deadline:
                    control.stopL(STOP_DECELERATION)
                    refuse_if_stopped(stop)
                    raise MoveRefusedError(f"{self._host}: no arrival in {MOTION_PATIENCE:g} s")
                time.sleep(POLL_SECONDS)
        except MoveRefusedError:
            raise
        except RuntimeError as error:
            raise SourceLostError(f"{self._host}: {error}") from error
        missing = float(np.linalg.norm(self.pose()[:3, 3] - base_from_tool[:3, 3]))
        if not missing < ARRIVAL_TOLERANCE:
            raise MoveRefusedError(
                f"{self._host}: stopped {1e3 * missing:.1f} mm from the pose: a protective stop?"
            )

    def _connected_control(self) -> Any:
        """Return the connection for motions."""
        # Made late, because it takes over the controller from the pendant's program.
        if self._control is None:
            control = import_extra("rtde_control", "ur", "a Universal Robots arm")
            self._control = control.RTDEControlInterface(self._host)
        return self._control

    def close(self) -> None:
        """Stop the program on the controller and disconnect."""
        control, self._control = self._control, None
        if control is not None:
            control.stopScript()
            control.disconnect()
        self._receive.disconnect()
