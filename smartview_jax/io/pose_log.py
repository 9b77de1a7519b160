"""Read the poses that a robot logged in motion, and the times of the pictures.

    poses: {file: log.csv, codec: ur, length_unit: m, angle_unit: rad, direction: base_from_tool,
            picture_times: times.csv, time_offset: 0.035}

The log has a column `time`, s, and the columns of the codec; the other table has `view` and `time`.
The clocks of camera and robot may differ: `time_offset` (by default 0) is added to the times of the
pictures; `estimate_time_offset` estimates it.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..argument_checks import require_readable
from ..geometry import LENGTH_UNITS, as_se3, pose_codec
from ..robots import Trajectory, times_in_gaps
from .csv_tables import (
    Table,
    parse_numbers,
    read_table,
    refuse_out_of_range,
    refuse_truncated,
    write_table,
)
from .pose_format import decoded_poses, table_format
from .poses import RobotReadings, poses_entry

LOG_FILE, TIMES_FILE = "log.csv", "times.csv"
"""The names of the files that `write_pose_log` writes."""

_TIME_ZONE_STEP = 900.0
"""Time zones differ by multiples of this, s."""


class PoseLog(NamedTuple):
    """A robot's logged poses, and the times of the pictures by the camera's clock.

    Attributes:
        trajectory: the poses over the robot's time.
        picture_times: a time for each view, s.
        time_offset: stated difference of the clocks, robot's minus camera's, s.
        times_path: the table of the pictures' times, for messages.
        notes: sentences on what was recognised and repaired in the tables.
        table: the table of the pictures' times.
        pose_format: name of the format of the logged poses.
    """

    trajectory: Trajectory
    view_ids: tuple[str, ...]
    picture_times: Float[np.ndarray, "views"]
    time_offset: float
    times_path: Path
    notes: tuple[str, ...] = ()
    table: Table | None = None
    pose_format: str | None = None

    def read_poses(self) -> RobotReadings:
        """Return the poses at the pictures' times, without those in gaps of the log.

        Raises:
            ValueError: a picture was taken outside the logged times; the message names its view.
        """
        views, in_gaps = list(self.view_ids), self.views_in_gaps()
        return RobotReadings(views, self.poses(), in_gaps, self.table, self.pose_format, self.notes)

    def poses(self) -> SE3:
        """Return the robot's poses when the pictures were taken.

        Raises:
            ValueError: a picture was taken outside the logged times; the message names its view.
        """
        times = self.picture_times + self.time_offset
        outside = self.trajectory.outside(times)
        logged = self.trajectory.times
        if outside.all():
            raise ValueError(f"{self.times_path}: {_apart(times, logged)}")
        if outside.any():
            k = int(np.argmax(outside))
            raise ValueError(
                f"{self.times_path}: view {self.view_ids[k]}: taken "
                f"{times[k] - logged[0]:.6g} s after the robot's log began, which is outside the "
                f"log (0 to {logged[-1] - logged[0]:.6g} s)"
            )
        return as_se3(self.trajectory.at(times))

    def views_in_gaps(self) -> dict[str, str]:
        """Return the views taken while the robot's pose was not logged, with the reason."""
        times, logged = self.picture_times + self.time_offset, self.trajectory.times
        reasons = {}
        for k in np.flatnonzero(times_in_gaps(self.trajectory, times)):
            after = int(np.searchsorted(logged, times[k]))
            begin, end = logged[after - 1 : after + 1] - logged[0]
            reasons[self.view_ids[k]] = (
                f"taken {times[k] - logged[0]:.6g} s after the robot's log began, in a gap of the "
                f"log from {begin:.6g} to {end:.6g} s: too long to interpolate"
            )
        return reasons


def read_pose_log(folder: Path, content: Mapping[str, Any]) -> PoseLog:
    """Read the two tables of an entry `poses` with `picture_times`."""
    path, times_path = folder / content["file"], folder / content["picture_times"]
    table = read_table(path, ("time",))
    refuse_truncated(path, table.rows, content.get("rows"))
    if not table.rows:
        raise ValueError(f"{path}: no poses")
    form = table_format(path, table.rows, content)
    table = table.requiring(("time", *form.columns), ("s", *form.units))
    labels = [f"row {k}" for k in range(1, 1 + len(table.rows))]
    numbers = np.stack(
        [
            parse_numbers(path, row, ("time", *form.columns), label)
            for row, label in zip(table.rows, labels, strict=True)
        ]
    )
    numbers, notes = _in_order(path, numbers)
    labels = [f"at {time - numbers[0, 0]:.6g} s" for time in numbers[:, 0]]
    lengths = list(form.codec.length_columns)
    refuse_out_of_range(path, numbers[:, 1:][:, lengths] * LENGTH_UNITS[form.length_unit], labels)
    try:
        trajectory = Trajectory.of(numbers[:, 0], decoded_poses(path, form, numbers[:, 1:], labels))
    except ValueError as error:
        # Errors about a pose name the file already.
        raise ValueError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    times_table = read_table(times_path, ("view", "time"))
    rows = times_table.rows
    view_ids = tuple(times_table.view_ids("times of pictures"))
    times = [float(parse_numbers(times_path, row, ("time",), row["view"])[0]) for row in rows]
    offset = content.get("time_offset") or 0.0
    notes = (*table.notes, *times_table.notes, *notes)
    return PoseLog(
        trajectory,
        view_ids,
        np.array(times),
        offset,
        times_path,
        notes,
        times_table,
        content.get("codec"),
    )


def write_pose_log(
    folder: Path,
    times: Float[np.ndarray, "logged"],
    base_from_tool: SE3,
    view_ids: Sequence[str],
    picture_times: Float[np.ndarray, "views"],
    pose_format: str = "quaternion_xyzw",
) -> dict[str, Any]:
    """Write the two tables of a log, and return the entry `poses` that describes them.

    Args:
        times: times of the poses by the robot's clock, s.
        base_from_tool: poses, `(logged)`.
        picture_times: a time for each view by the camera's clock, s.
        pose_format: one of `POSE_CODECS`, written in its manufacturer's units.

    Raises:
        ValueError: an unknown format, or a name or position with which the tables could not be
            read back.
    """
    codec = pose_codec(pose_format)
    # Before the first of the two tables is written.
    require_readable(f"{folder / TIMES_FILE}: view", view_ids)
    labels = [f"at {time:.6g} s" for time in times]
    refuse_out_of_range(folder / LOG_FILE, np.asarray(base_from_tool.translation()), labels)
    rows = np.column_stack([times, codec.encode(base_from_tool, *codec.units)]).tolist()
    write_table(folder / LOG_FILE, ("time", *codec.columns), rows)
    views = list(zip(view_ids, np.asarray(picture_times).tolist(), strict=True))
    write_table(folder / TIMES_FILE, ("view", "time"), views)
    return {**poses_entry(len(rows), pose_format, LOG_FILE), "picture_times": TIMES_FILE}


def _in_order(
    path: Path, numbers: Float[np.ndarray, "rows columns"]
) -> tuple[Float[np.ndarray, "times columns"], tuple[str, ...]]:
    """Return the rows sorted by time, without duplicates, and notes on what was changed.

    Recorders that merge several topics write rows late and repeat them. The time is the first
    column.
    """
    notes = []
    if (np.diff(numbers[:, 0]) < 0.0).any():
        notes.append(f"{path.name}: rows were not sorted by time; sorted them")
        numbers = numbers[np.argsort(numbers[:, 0], kind="stable")]
    repeated = np.concatenate([[False], (np.diff(numbers, axis=0) == 0.0).all(axis=1)])
    if repeated.any():
        notes.append(f"{path.name}: {int(repeated.sum())} repeated rows were dropped")
        numbers = numbers[~repeated]
    if (clash := np.diff(numbers[:, 0]) == 0.0).any():
        time = numbers[int(np.argmax(clash)), 0]
        raise ValueError(
            f"{path}: two different poses at time {time:.15g}, {time - numbers[0, 0]:.6g} s after "
            "the first: does the log mix two robots or tools, or are the times rounded?"
        )
    return numbers, tuple(notes)


def _apart(times: Float[np.ndarray, "views"], logged: Float[np.ndarray, "logged"]) -> str:
    """Return the error message for a log during which no picture was taken."""
    text = (
        f"no picture was taken within the robot's log: relative to the log's first time the "
        f"pictures are from {times.min() - logged[0]:.6g} to {times.max() - logged[0]:.6g} s, the "
        f"log from 0 to {logged[-1] - logged[0]:.6g} s"
    )
    # Any offset between these two puts all pictures within the log.
    low, high = logged[0] - times.min(), logged[-1] - times.max()
    if low > high:
        return f"{text}: the pictures span more time than the log; do they belong together?"
    hours = np.round(0.5 * (low + high) / _TIME_ZONE_STEP) * _TIME_ZONE_STEP
    if low <= hours <= high and hours:
        unit = "hour" if abs(hours) == 3600.0 else "hours"
        difference = f"{abs(hours) / 3600.0:g} {unit} apart, as by a time zone or summer time"
    else:
        difference = f"{0.5 * abs(low + high):.6g} s apart"
    return (
        f"{text}: are the clocks {difference}? Then add {low:.9g} to {high:.9g} s to the pictures' "
        "times"
    )
