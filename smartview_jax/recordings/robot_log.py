"""The robot's motion over a recording, from tf, a topic of poses, or joint readings."""

from array import array
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from ..geometry import host_matrices
from ..robots import SerialArm
from .transform_tree import Chain, stamp_of


class JointLog(NamedTuple):
    """Joint readings over time.

    Attributes:
        stamps: increasing, ns.
        readings: rad (m for a prismatic joint), in the arm's order.
        arm: the arm that has these readings.
    """

    stamps: Int64[np.ndarray, "samples"]
    readings: Float[np.ndarray, "samples joints"]
    arm: SerialArm

    def at(self, times: Int64[np.ndarray, "times"]) -> Float[np.ndarray, "times joints"]:
        """Return the readings at some times (ns), interpolated linearly, NaN outside the log."""
        # From the first stamp: as a float a time since 1970 has only some hundred nanoseconds.
        origin = self.stamps[0]
        seconds, wanted = (self.stamps - origin).astype(float), (times - origin).astype(float)
        columns = [
            np.interp(wanted, seconds, column, left=np.nan, right=np.nan)
            for column in self.readings.T
        ]
        return np.stack(columns, axis=1)


class RobotLog(NamedTuple):
    """The robot's motion by a chain from base to tool, by an arm's joint readings, or by both."""

    chain: Chain | None
    joints: JointLog | None

    @property
    def stamps(self) -> Int64[np.ndarray, "stamps"]:
        """The times at which the robot was logged, ns, increasing."""
        if self.chain is None:
            assert self.joints is not None
            return self.joints.stamps
        stamps = self.chain.stamps
        if self.joints is not None:
            first, last = self.joints.stamps[[0, -1]]
            stamps = stamps[(first <= stamps) & (stamps <= last)]
        return stamps

    def at(self, times: Int64[np.ndarray, "times"]) -> Float[np.ndarray, "times 4 4"]:
        """Return `base_from_tool` at some times (ns), NaN where it is not known."""
        readings = None if self.joints is None else self.joints.at(times)
        if self.chain is not None:
            poses = self.chain.at(times)
        else:
            assert self.joints is not None
            assert readings is not None
            poses = host_matrices(self.joints.arm.base_from_tool(readings))
        if readings is not None:
            poses[np.isnan(readings[:, 0])] = np.nan
        return poses


class JointRecord:
    """Collects the messages of a topic of joint readings."""

    def __init__(self, names: Sequence[str], arm: SerialArm):
        self._names, self._arm = tuple(names), arm
        self._stamps, self._readings = array("q"), array("d")
        self._seen: dict[str, None] = {}

    def add(self, message: Any, stamp: int | None = None) -> None:
        """Add a message that has all joints, with its stamp in ns; others are passed over."""
        names = list(message.name)
        self._seen |= dict.fromkeys(names)
        if len(message.position) != len(names) or not set(self._names) <= set(names):
            return
        self._stamps.append(stamp_of(message.header) if stamp is None else stamp)
        self._readings.extend(float(message.position[names.index(name)]) for name in self._names)

    def finished(self) -> JointLog:
        """Return the readings in the order of time."""
        if not self._stamps:
            raise ValueError(
                f"no message has positions of the joints {', '.join(self._names)}; there are "
                f"{', '.join(self._seen) or 'no messages'}"
            )
        stamps = np.frombuffer(self._stamps, dtype=np.int64)
        readings = np.frombuffer(self._readings, dtype=float).reshape(len(stamps), -1)
        stamps, order = np.unique(stamps, return_index=True)
        return JointLog(stamps, readings[order], self._arm)
