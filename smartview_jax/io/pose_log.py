"""Read the poses that a robot logged while it moved, and when pictures were taken meanwhile.

    poses: {file: log.csv, codec: ur, length_unit: m, angle_unit: rad, direction: base_from_tool,
            picture_times: times.csv, time_offset: 0.035}

The log has a column `time`, s, and the columns of the codec; the other table has `view` and `time`.
Each clock may have a zero of its own within the offset, which is added to the times of the
pictures; zero if it is not stated, and `estimate_time_offset` finds it.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..geometry import LENGTH_UNITS, as_se3
from ..robots import Trajectory
from .csv_tables import (
    duplicates,
    parse_numbers,
    read_table,
    refuse_out_of_range,
    refuse_truncated,
)
from .pose_format import decoded_poses, table_format


class PoseLog(NamedTuple):
    """A robot's logged poses, and when the pictures were taken by the camera's clock.

    Attributes:
        trajectory: the poses over the robot's time.
        view_ids: names of the views.
        picture_times: a time for each view, s.
        time_offset: stated difference of the clocks, robot's minus camera's, s.
    """

    trajectory: Trajectory
    view_ids: tuple[str, ...]
    picture_times: Float[np.ndarray, "views"]
    time_offset: float

    def poses(self) -> SE3:
        """Return where the robot was when the pictures were taken.

        Raises:
            ValueError: a picture outside the logged times, by its view.
        """
        times = self.picture_times + self.time_offset
        outside = self.trajectory.outside(times)
        if outside.any():
            k, logged = int(np.argmax(outside)), self.trajectory.times
            raise ValueError(
                f"view {self.view_ids[k]}: its time, {times[k]:.9g} s, is not within those of the "
                f"robot's log, {logged[0]:.9g} to {logged[-1]:.9g} s"
            )
        return as_se3(self.trajectory.at(times))


def read_pose_log(folder: Path, content: Mapping[str, Any]) -> PoseLog:
    """Read the two tables of an entry `poses` with `picture_times`.

    Raises:
        FileNotFoundError: a table is missing.
        ValueError: something is wrong in it; the message names the file and the row or view.
    """
    path, times_path = folder / content["file"], folder / content["picture_times"]
    table = read_table(path, ("time",))
    refuse_truncated(path, table, content.get("rows"))
    if not table:
        raise ValueError(f"{path}: no poses")
    form = table_format(path, table, content)
    table = read_table(path, ("time", *form.columns), ("s", *form.units))
    labels = [f"row {k}" for k in range(1, 1 + len(table))]
    numbers = np.stack(
        [
            parse_numbers(path, row, ("time", *form.columns), label)
            for row, label in zip(table, labels, strict=True)
        ]
    )
    lengths = list(form.codec.length_columns)
    refuse_out_of_range(path, numbers[:, 1:][:, lengths] * LENGTH_UNITS[form.length_unit], labels)
    try:
        trajectory = Trajectory.of(numbers[:, 0], decoded_poses(path, form, numbers[:, 1:], labels))
    except ValueError as error:
        # What is wrong with a pose names the file already.
        raise ValueError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    rows = read_table(times_path, ("view", "time"))
    view_ids = tuple(row["view"] for row in rows)
    if repeated := duplicates(view_ids):
        raise ValueError(f"{times_path}: view {', '.join(repeated)} has more than one row")
    if not rows:
        raise ValueError(f"{times_path}: no times of pictures")
    times = [float(parse_numbers(times_path, row, ("time",), row["view"])[0]) for row in rows]
    return PoseLog(trajectory, view_ids, np.array(times), content.get("time_offset") or 0.0)
