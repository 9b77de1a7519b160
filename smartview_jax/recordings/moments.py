"""Choose the moments of a recording that become views: the robot stands still, or every N-th.

A camera is often some hundredths of a second late, by an amount that no stamp tells, so that a
picture taken in motion has a wrong pose. Where the robot stands, the clocks do not matter.
Therefore one picture of every stop is taken, as far from any motion as possible; further pictures
of a stop would show the same again.
"""

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int64

from ..argument_checks import errors_at
from ..geometry import host_rotation_angles
from ..robots import Trajectory, times_in_gaps

NANOSECONDS = 1e9
"""Nanoseconds in a second."""

_SAMPLES_PER_STOP = 20
"""Poses looked at within the shortest stop, so that a long log takes little time."""

_MOTION_STEP = 5e6
"""Shortest time between two poses of a log that is kept, ns; no arm changes its course within."""


@dataclasses.dataclass(frozen=True)
class MomentChoice:
    """Rules by which pictures, or measurements of a tracker, are chosen from a recording.

    Attributes:
        every: take every N-th, also in motion; None for one in every stop of the robot.
        still_for: shortest time that the robot has to stand, half of it before and half after the
            picture, s; longer than cameras are late and arms swing.
        position, angle: largest motion of a robot that stands, m and rad; industrial robots repeat
            a pose to about this accuracy, and the readings of cheaper ones jitter by more.

    For example:

        >>> rules = sv.MomentChoice(every=10)  # also in motion
        >>> print(rules.every, sv.MomentChoice().every, sv.MomentChoice().still_for)
        10 None 0.5
    """

    every: int | None = None
    still_for: float = 0.5
    position: float = 1e-4
    angle: float = 4e-4

    def __post_init__(self) -> None:
        """Refuse numbers with which nothing could be chosen."""
        if self.every is not None and self.every < 1:
            raise ValueError(f"every: expected 1 or more, found {self.every}")
        for name in ("still_for", "position", "angle"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name}: expected more than 0, found {getattr(self, name):g}")


class Chosen(NamedTuple):
    """The moments that become views.

    Attributes:
        indices: of the chosen moments, in the order of time.
        stops: number of the robot's stop in which each is; in motion, its own number.
        left_out: number of the others by reason.
        notes: sentences on what was found.
    """

    indices: Int[np.ndarray, "views"]
    stops: Int[np.ndarray, "views"]
    left_out: dict[str, int]
    notes: tuple[str, ...]


def choose_moments(
    moments: Int64[np.ndarray, "moments"],
    known: Bool[np.ndarray, "moments"],
    stamps: Int64[np.ndarray, "logged"],
    poses: Float[np.ndarray, "logged 4 4"],
    choice: MomentChoice,
) -> Chosen:
    """Choose among the times of pictures.

    Args:
        moments: times of the pictures, ns, increasing.
        known: whether the robot's pose is known at each.
        stamps: times of the robot's log, ns, increasing.
        poses: `base_from_tool` at these times.
    """
    outside = {"before or after the robot's poses": int((~known).sum())}
    if choice.every is not None:
        chosen = _every(moments, known, stamps, poses, choice.every)
    else:
        chosen = _one_in_every_stop(moments, known, stamps, poses, choice)
    reasons = {reason: n for reason, n in (outside | chosen.left_out).items() if n}
    if not chosen.indices.size:
        listed = "; ".join([*(f"{n} {reason}" for reason, n in reasons.items()), *chosen.notes])
        raise ValueError(f"no view is left of {len(moments)}: {listed}")
    return chosen._replace(left_out=reasons)


def _every(
    moments: Int64[np.ndarray, "moments"],
    known: Bool[np.ndarray, "moments"],
    stamps: Int64[np.ndarray, "logged"],
    poses: Float[np.ndarray, "logged 4 4"],
    every: int,
) -> Chosen:
    """Choose every N-th moment at which the robot's log has no gap."""
    counted = np.flatnonzero(known)
    indices = counted[::every]
    seconds = (stamps - stamps[0]) / NANOSECONDS
    with errors_at("the robot's poses"):
        trajectory = Trajectory.of(seconds, poses)
    in_gap = times_in_gaps(trajectory, (moments[indices] - stamps[0]) / NANOSECONDS)
    left_out = {
        f"because one in {every} is taken": len(counted) - len(indices),
        "in a gap of the robot's poses, too long to interpolate": int(in_gap.sum()),
    }
    return Chosen(indices[~in_gap], np.flatnonzero(~in_gap), left_out, ())


def _one_in_every_stop(
    moments: Int64[np.ndarray, "moments"],
    known: Bool[np.ndarray, "moments"],
    stamps: Int64[np.ndarray, "logged"],
    poses: Float[np.ndarray, "logged 4 4"],
    choice: MomentChoice,
) -> Chosen:
    """Choose the moment next to the middle of every stop."""
    margin = 0.5 * choice.still_for * NANOSECONDS
    indices, stops_of, others, empty = [], [], 0, 0
    for number, (begin, end) in enumerate(stops(stamps, poses, choice)):
        first, last = np.searchsorted(moments, [begin + margin, end - margin])
        # `searchsorted` leaves out a moment that is exactly at the end.
        last += last < len(moments) and moments[last] == end - margin
        if first == last:
            empty += 1
            continue
        middle = 0.5 * (begin + end)
        stops_of.append(number)
        indices.append(first + int(np.argmin(np.abs(moments[first:last] - middle))))
        others += last - first - 1
    moving = int(known.sum()) - len(indices) - int(others)
    half = f"{0.5 * choice.still_for:g} s"
    left_out = {
        f"within {half} of a motion of the robot": moving,
        "of a stop that is a view already": int(others),
    }
    notes = []
    if empty:
        notes.append(f"{empty} stops of the robot have no picture further than {half} from motion")
    if not indices and not empty:
        notes.append(_least_motion(stamps, poses, choice))
    return Chosen(
        np.array(indices, dtype=int), np.array(stops_of, dtype=int), left_out, tuple(notes)
    )


def stops(
    stamps: Int64[np.ndarray, "logged"],
    poses: Float[np.ndarray, "logged 4 4"],
    choice: MomentChoice,
) -> Iterator[tuple[int, int]]:
    """Yield begin and end (ns) of every time that the robot stands for long enough.

    It stands while its pose is within the limits of the first pose, and the log has no gap longer
    than the shortest stop.
    """
    shortest = choice.still_for * NANOSECONDS
    # The last pose before each gap, and before the end of the log.
    gap_begins = np.flatnonzero(np.append(np.diff(stamps) > shortest, True))
    first = 0
    while first < len(stamps) - 1:
        gap_begin = int(gap_begins[np.searchsorted(gap_begins, first)])
        end = _first_moved(poses, first, gap_begin + 1, choice)
        if stamps[end - 1] - stamps[first] >= shortest:
            yield int(stamps[first]), int(stamps[end - 1])
            first = end
        else:
            first += 1


def _first_moved(
    poses: Float[np.ndarray, "logged 4 4"], first: int, stop: int, choice: MomentChoice
) -> int:
    """Return the first index after `first`, and up to `stop`, whose pose is outside the limits."""
    begin, size = first + 1, _SAMPLES_PER_STOP
    while begin < stop:
        block = poses[begin : min(begin + size, stop)]
        position, angle = _distances(poses[first], block)
        # NaN, an unknown pose, counts as moved.
        moved = ~((position <= choice.position) & (angle <= choice.angle))
        if moved.any():
            return begin + int(np.argmax(moved))
        begin += size
        size *= 2
    return stop


def _distances(
    pose: Float[np.ndarray, "4 4"], others: Float[np.ndarray, "others 4 4"]
) -> tuple[Float[np.ndarray, "others"], Float[np.ndarray, "others"]]:
    """Return distance (m) and angle (rad) from a pose to others."""
    position = np.linalg.norm(others[:, :3, 3] - pose[:3, 3], axis=1)
    return position, host_rotation_angles(pose, others)


def _least_motion(
    stamps: Int64[np.ndarray, "logged"],
    poses: Float[np.ndarray, "logged 4 4"],
    choice: MomentChoice,
) -> str:
    """Return a sentence on the least that the robot moved while it had to stand still."""
    duration = choice.still_for * NANOSECONDS
    ends = np.searchsorted(stamps, stamps + duration)
    begins = np.flatnonzero(ends < len(stamps))
    text = f"the robot never stands for {choice.still_for:g} s"
    if not begins.size:
        return f"{text}: its poses are of {(stamps[-1] - stamps[0]) / NANOSECONDS:g} s only"
    spans = np.array([_span(poses[k : ends[k] + 1]) for k in begins])
    position, angle = spans[int(np.nanargmin((spans / [choice.position, choice.angle]).max(1)))]
    return (
        f"{text} within {1e3 * choice.position:g} mm and {np.rad2deg(choice.angle):.3g} degrees; "
        f"at least it moves by {1e3 * position:.3g} mm and {np.rad2deg(angle):.3g} degrees: allow "
        "more motion, or take every N-th picture in motion"
    )


def _span(poses: Float[np.ndarray, "part 4 4"]) -> tuple[float, float]:
    """Return the largest distance (m) and angle (rad) from the first pose."""
    position, angle = _distances(poses[0], poses)
    return float(position.max()), float(angle.max())


def thinned(stamps: Int64[np.ndarray, "logged"], step: float) -> Int64[np.ndarray, "kept"]:
    """Return the first stamp in every interval of a step (ns), and the last stamp of all."""
    kept = np.flatnonzero(np.diff((stamps - stamps[0]) // max(1, int(step)), prepend=-1))
    return stamps[np.unique(np.append(kept, len(stamps) - 1))]


def log_step(choice: MomentChoice) -> float:
    """Return the longest time between poses with which stops, or a motion, are seen well, ns."""
    return _MOTION_STEP if choice.every else choice.still_for * NANOSECONDS / _SAMPLES_PER_STOP
