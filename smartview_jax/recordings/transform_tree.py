"""Collect the transforms of `/tf` and look poses up as tf2 does.

Between two stamps a transform is interpolated: the translation linearly, the rotation along the
shortest arc at constant speed. Before its first and after its last stamp it is not known. A static
transform holds at all times.
"""

from array import array
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int64
from scipy.spatial.transform import Rotation

from ..geometry import host_poses

_NUMBERS = 7
"""Numbers of a transform: x, y, z, and the quaternion x, y, z, w."""


class Samples(NamedTuple):
    """A transform over time.

    Attributes:
        stamps: increasing, ns.
        numbers: x, y, z (m) and the unit quaternion x, y, z, w, one row for each stamp.
    """

    stamps: Int64[np.ndarray, "samples"]
    numbers: Float[np.ndarray, "samples 7"]

    def at(self, times: Int64[np.ndarray, "times"]) -> Float[np.ndarray, "times 4 4"]:
        """Return the transform at some times (ns), NaN where it is not known."""
        stamps, numbers = self.stamps, self.numbers
        poses = np.full((len(times), 4, 4), np.nan)
        known = (stamps[0] <= times) & (times <= stamps[-1])
        if not known.any():
            return poses
        inside = times[known]
        after = np.clip(np.searchsorted(stamps, inside), 1, max(1, len(stamps) - 1))
        last = np.minimum(after, len(stamps) - 1)
        first = after - 1
        duration = np.maximum(stamps[last] - stamps[first], 1)
        fraction = ((inside - stamps[first]) / duration)[:, None]
        begin, end = numbers[first], numbers[last]
        positions = begin[:, :3] + fraction * (end[:, :3] - begin[:, :3])
        rotations = Rotation.from_quat(begin[:, 3:])
        turns = (rotations.inv() * Rotation.from_quat(end[:, 3:])).as_rotvec()
        rotations = rotations * Rotation.from_rotvec(fraction * turns)
        poses[known] = host_poses(rotations.as_matrix(), positions)
        return poses


class Link(NamedTuple):
    """A transform in a chain from one frame to another.

    Attributes:
        parent, child: the frames.
        samples: the pose of the child in the parent, over time.
        static: whether it holds at all times.
        inverted: whether the chain passes from the parent to the child.
    """

    parent: str
    child: str
    samples: Samples
    static: bool
    inverted: bool

    def at(self, times: Int64[np.ndarray, "times"]) -> Float[np.ndarray, "times 4 4"]:
        """Return the transform at some times (ns) in the direction of the chain."""
        if self.static:
            poses = np.repeat(self.samples.at(self.samples.stamps[-1:]), len(times), axis=0)
        else:
            poses = self.samples.at(times)
        return np.linalg.inv(poses) if self.inverted else poses


class Chain(NamedTuple):
    """The transforms between two frames, in order.

    Attributes:
        target, source: the frames; the chain gives `target_from_source`.
        links: the transforms from target to source.
    """

    target: str
    source: str
    links: tuple[Link, ...]

    @property
    def stamps(self) -> Int64[np.ndarray, "stamps"]:
        """The times at which any transform was published and all are known, ns, increasing."""
        moving = [link.samples.stamps for link in self.links if not link.static]
        if not moving:
            return np.zeros(0, dtype=np.int64)
        stamps = np.unique(np.concatenate(moving))
        first, last = max(part[0] for part in moving), min(part[-1] for part in moving)
        return stamps[(first <= stamps) & (stamps <= last)]

    def at(self, times: Int64[np.ndarray, "times"]) -> Float[np.ndarray, "times 4 4"]:
        """Return `target_from_source` at some times (ns), NaN where a transform is not known."""
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        for link in self.links:
            poses = poses @ link.at(times)
        return poses

    def words(self) -> str:
        """Return the frames from target to source as text."""
        names = [self.target]
        for link in self.links:
            names.append(link.parent if link.inverted else link.child)
        return " - ".join(names)


class _Record:
    """The samples of one transform while they are collected; 64 bytes each."""

    def __init__(self) -> None:
        self.stamps, self.numbers, self.static = array("q"), array("d"), False

    def finished(self) -> Samples:
        """Return the samples in the order of their stamps; of equal stamps the first, as in tf2."""
        stamps = np.frombuffer(self.stamps, dtype=np.int64)
        numbers = np.frombuffer(self.numbers, dtype=float).reshape(-1, _NUMBERS)
        if self.static:
            return Samples(stamps[-1:], numbers[-1:])
        stamps, order = np.unique(stamps, return_index=True)
        return Samples(stamps, numbers[order])


class TransformTree:
    """Transforms between frames, as they were published."""

    def __init__(self) -> None:
        self._records: dict[tuple[str, str], _Record] = {}
        self.dropped: dict[tuple[str, str], int] = {}
        """Number of transforms in messages that are no poses, by parent and child."""

    def add(
        self,
        parent: str,
        child: str,
        stamp: int,
        numbers: Sequence[float],
        static: bool = False,
    ) -> None:
        """Add a pose of one frame in another.

        Args:
            parent, child: the frames; a leading slash, which ROS 1 allows, is ignored.
            stamp: ns.
            numbers: x, y, z, m, and the quaternion x, y, z, w.
            static: whether it holds at all times.

        Raises:
            ValueError: not a pose; the message names the frames.
        """
        parent, child = (name.lstrip("/") for name in (parent, child))
        length = sum(part * part for part in numbers[3:])
        # NaN fails this comparison as well. Drivers round quaternions, some to three digits.
        if not 0.9 < length < 1.1 or not np.isfinite(numbers[:3]).all():
            raise ValueError(
                f"transform of {child} in {parent}: expected a position and a unit quaternion, "
                f"found {', '.join(f'{part:.6g}' for part in numbers)}"
            )
        record = self._records.setdefault((parent, child), _Record())
        record.static = static
        record.stamps.append(stamp)
        record.numbers.extend(numbers)

    def add_message(self, message: Any, static: bool, received: int | None = None) -> None:
        """Add the transforms of a message of `/tf` or `/tf_static`.

        One that is no pose is dropped, as by tf2: some drivers publish zeros before they are ready.

        Args:
            message: a `tf2_msgs/TFMessage`.
            static: whether they hold at all times.
            received: time to be used instead of the stamps, ns.
        """
        for transform in message.transforms:
            parent, child = transform.header.frame_id, transform.child_frame_id
            stamp = stamp_of(transform.header) if received is None else received
            try:
                self.add(parent, child, stamp, transform_numbers(transform.transform), static)
            except ValueError:
                pair = (parent.lstrip("/"), child.lstrip("/"))
                self.dropped[pair] = self.dropped.get(pair, 0) + 1

    @property
    def frames(self) -> list[str]:
        """Names of all frames, sorted."""
        return sorted({name for pair in self._records for name in pair})

    def parent_of(self, frame: str) -> str | None:
        """Return the frame in which a frame's pose is published; None for a root.

        Raises:
            ValueError: it is published in two frames.
        """
        parents = sorted({parent for parent, child in self._records if child == frame})
        if len(parents) > 1:
            raise ValueError(
                f"frame {frame} has two parents in tf, {' and '.join(parents)}: expected one"
            )
        return parents[0] if parents else None

    def chain(self, target: str, source: str) -> Chain:
        """Return the transforms that lead from one frame to another.

        Raises:
            ValueError: a frame is missing, or the frames are not connected; the message lists the
                frames there are.
        """
        target, source = target.lstrip("/"), source.lstrip("/")
        for frame in (target, source):
            if frame not in self.frames:
                # Of a frame whose transforms are no poses no other trace is left.
                known = any(frame in pair for pair in self.dropped)
                hint = ", all of its transforms are no poses" if known else ""
                raise ValueError(f"no frame {frame} in tf{hint}; there are {self._listed()}")
        up, down = self._ancestors(target), self._ancestors(source)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            raise ValueError(
                f"frames {target} and {source} are not connected in tf: {target} leads to "
                f"{up[-1]}, {source} to {down[-1]}"
            )
        rising, falling = up[: up.index(common) + 1], down[: down.index(common) + 1]
        links = [self._link(parent, child, True) for child, parent in pairwise(rising)]
        pairs = reversed(list(pairwise(falling)))
        links += [self._link(parent, child, False) for child, parent in pairs]
        return Chain(target, source, tuple(links))

    def _link(self, parent: str, child: str, inverted: bool) -> Link:
        record = self._records[parent, child]
        return Link(parent, child, record.finished(), record.static, inverted)

    def _ancestors(self, frame: str) -> list[str]:
        """Return a frame, its parent, the parent of this, and so on to the root."""
        names = [frame]
        while (parent := self.parent_of(names[-1])) is not None:
            if parent in names:
                raise ValueError(f"frames {', '.join(names)} are in a circle in tf")
            names.append(parent)
        return names

    def _listed(self) -> str:
        return ", ".join(self.frames) or "none"


def stamp_of(header: Any) -> int:
    """Return the stamp of a message's header, ns."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def transform_numbers(transform: Any) -> tuple[float, ...]:
    """Return a message of a transform as x, y, z and the quaternion x, y, z, w."""
    position, turn = transform.translation, transform.rotation
    return position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w


def pose_numbers(pose: Any) -> tuple[float, ...]:
    """Return a message of a pose as x, y, z and the quaternion x, y, z, w."""
    position, turn = pose.position, pose.orientation
    return position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w
