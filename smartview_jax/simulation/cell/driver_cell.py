"""Show how a real robot becomes a `Cell`: an example adapter for a controller, camera and gripper.

Whatever the controller's own library is called, a cell needs five functions of it. Write them in
the controller's own units and pose format, and `DriverCell` converts:

    cell = DriverCell(
        send_pose=lambda pose: robot.movel(pose, a=0.5, v=0.1),      # waits until it stands
        read_pose=robot.getl,
        grab=lambda: camera.read()[1],
        send_width=gripper.move_and_wait_mm,
        read_width=gripper.position_mm,
        pose_format="ur",
        width_unit=1e-3,
    )
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from ...geometry import as_se3, host_logarithms, host_matrices, host_transforms, pose_codec
from ...robots import Command, CommandLike, JointsLike
from ...runtime.array_namespace import to_device
from .interface import CellError

MAX_POSITION_ERROR = 5e-3
"""Largest distance between the commanded and the reported position after a motion, m."""

MAX_ORIENTATION_ERROR = float(np.deg2rad(0.5))
"""Largest rotation between the commanded and the reported orientation after a motion, rad."""


class DriverCell:
    """A real cell, driven by functions of its controller, camera and gripper."""

    def __init__(
        self,
        *,
        send_pose: Callable[[list[float]], object],
        read_pose: Callable[[], Sequence[float]],
        grab: Callable[[], np.ndarray],
        send_width: Callable[[float], object],
        read_width: Callable[[], float],
        pose_format: str = "val_oat",
        width_unit: float = 1e-3,
        send_joints: Callable[[list[float]], object] | None = None,
        read_joints: Callable[[], Sequence[float]] | None = None,
    ):
        """Store the functions.

        Args:
            send_pose: moves the tool in a straight line to a pose, and returns when it stands.
            read_pose: returns the pose that the controller reports.
            grab: returns a picture, grey or in OpenCV's colour order.
            send_width: moves the fingers to a distance, and returns when they stand.
            read_width: returns the distance of the fingers.
            pose_format: of the poses, one of `geometry.POSE_CODECS`, in the manufacturer's units.
            width_unit: unit of the widths, m; millimetres by default.
            send_joints: moves to joint readings, rad; None if only poses are commanded.
            read_joints: returns joint readings, rad; None if they are unknown.

        Raises:
            ValueError: no such pose format.
        """
        self._codec = pose_codec(pose_format)
        self._send_pose, self._read_pose, self._grab = send_pose, read_pose, grab
        self._send_width, self._read_width, self._unit = send_width, read_width, width_unit
        self._send_joints, self._read_joints = send_joints, read_joints

    def move(self, target: CommandLike | JointsLike | Sequence[float]) -> Command:
        """Move the tool as `Cell.move` does.

        A `Command` is sent as joint readings if the robot takes them, otherwise as a pose.

        Raises:
            CellError: joint readings or a pose that are not finite; joint readings alone, which the
                robot does not take; or another pose is reported than the commanded one.
        """
        if isinstance(target, Command):
            # A robot that takes only poses is sent the pose of the same command.
            by_joints = target.joints is not None and self._send_joints is not None
            target = target.joints if by_joints else target.base_from_tool  # pyright: ignore
        if not hasattr(target, "wxyz_xyz") and np.ndim(target) == 1:  # pyright: ignore
            return self._move_joints(np.asarray(target, dtype=float))
        pose = as_se3(target)  # pyright: ignore[reportArgumentType]
        row = np.asarray(self._codec.encode(pose, *self._codec.units)).ravel()
        if not np.isfinite(row).all():
            raise CellError(f"a pose that is not finite: {row.tolist()}")
        self._send_pose([float(x) for x in row])
        reached = self.where()
        _check_arrival(host_matrices(pose), host_matrices(reached.base_from_tool))
        return reached

    def _move_joints(self, joints: Float[np.ndarray, "joints"]) -> Command:
        """Move to joint readings, and return where the robot is."""
        if self._send_joints is None:
            raise CellError("this robot takes poses, not joint readings")
        # A controller may accept NaN as a number.
        if not np.isfinite(joints).all():
            raise CellError(f"joint readings that are not finite: {joints.tolist()}")
        # Joint readings are not compared with the arrival: only the controller's own pose counts.
        self._send_joints([float(x) for x in joints])
        return self.where()

    def picture(self) -> UInt8[np.ndarray, "rows columns"]:
        """Return a grey picture; raise a CellError if the camera returned none."""
        picture = self._grab()
        if not isinstance(picture, np.ndarray) or picture.ndim not in (2, 3) or not picture.size:
            raise CellError(f"the camera returned no picture, but {type(picture).__name__}")
        # OpenCV's cameras give blue, green and red.
        if picture.ndim == 3:
            picture = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
        if picture.dtype != np.uint8:
            raise CellError(f"the camera returned {picture.dtype}; expected 8 bits")
        return picture

    def set_gripper(self, width: float) -> float:
        """Move the fingers as `Cell.set_gripper`; a negative or infinite width is a ValueError."""
        # The gripper's own controller knows the largest opening.
        if not 0.0 <= width < np.inf:
            raise ValueError(f"width {width!r} m; expected a finite number of metres, 0 or more")
        self._send_width(float(width) / self._unit)
        return float(self._read_width()) * self._unit

    def where(self) -> Command:
        """Return the pose that the controller reports."""
        # One row of numbers, in the pose format.
        row = np.asarray(self._read_pose(), dtype=float).reshape(1, -1)
        if row.shape[1] != len(self._codec.columns):
            raise CellError(
                f"the robot reports {row.shape[1]} numbers; {self._codec.name} has "
                f"{len(self._codec.columns)} ({', '.join(self._codec.columns)})"
            )
        pose = host_matrices(self._codec.decode(row, *self._codec.units))[0]
        if self._read_joints is None:
            return Command(host_transforms(pose))
        return Command(host_transforms(pose), to_device(np.array(self._read_joints(), dtype=float)))


def _check_arrival(commanded: Float[np.ndarray, "4 4"], reached: Float[np.ndarray, "4 4"]) -> None:
    """Raise a CellError if a robot reports another pose than the commanded one.

    This detects a controller that stopped on the way, or that uses other units.
    """
    tangent = host_logarithms(np.linalg.inv(commanded) @ reached)
    distance = float(np.linalg.norm(reached[:3, 3] - commanded[:3, 3]))
    turn = float(np.linalg.norm(tangent[3:]))
    # NaN, for a report that is not finite, compares as False.
    if not distance < MAX_POSITION_ERROR:
        raise CellError(
            f"the robot reports a position {1e3 * distance:.3g} mm from the commanded one"
        )
    if not turn < MAX_ORIENTATION_ERROR:
        raise CellError(
            f"the robot reports an orientation {np.rad2deg(turn):.3g} degrees from the commanded "
            "one"
        )
