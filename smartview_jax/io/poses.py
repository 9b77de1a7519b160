"""Read and write the robot's reported poses of a data-set folder, `poses.csv`.

    poses: {file: poses.csv, codec: matrix, length_unit: m, angle_unit: rad,
            direction: base_from_tool}

The file has a column `view` and the columns of the codec. A file that `write_viewpoints` wrote, CSV
or JSON, states its own format and units: `poses: {file: views.csv}` is then enough. Poses that the
robot logged while it moved are read by `pose_log.py`.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..argument_checks import require_readable
from ..dataset import Dataset
from ..geometry import LENGTH_UNITS, host_matrices, host_transforms, pose_codec
from ..robots import Command, SerialArm
from ..runtime.array_namespace import to_device
from .csv_tables import (
    Table,
    parse_numbers,
    read_table,
    refuse_out_of_range,
    refuse_truncated,
    write_view_table,
)
from .pose_format import PoseFormat, decoded_poses, stated_format, table_format
from .rounding import rounding_note
from .viewpoints import read_viewpoints

POSES_FILE = "poses.csv"
"""The name of the file that `write_poses` writes."""

OTHER_POSES_FILE = "other_poses.csv"
"""The name of the file with the poses of a second arm, which carries the target."""


class RobotReadings(NamedTuple):
    """The robot's reported poses by view, with joint readings if the folder has them.

    Attributes:
        poses: reported `base_from_tool`, `(views)`.
        masked_views: reason by view id, for the views whose row is not a valid pose.
        table: the table that has a row for each view; None if the poses are in a file in JSON.
        pose_format: name of the format of the reported poses; None if it is not known.
        notes: sentences on what was recognised or repaired in the tables.
        joints: joint readings, rad (m for a prismatic joint); None where the folder has none.
        arm: the arm that the readings belong to; None where there are no readings.
        name_suffix: suffix of the view names in the tables that `view_ids` do not have.
    """

    view_ids: Sequence[str]
    poses: SE3
    masked_views: dict[str, str]
    table: Table | None = None
    pose_format: str | None = None
    notes: tuple[str, ...] = ()
    joints: Float[np.ndarray, "views joints"] | None = None
    arm: SerialArm | None = None
    name_suffix: str = ""

    @property
    def command(self) -> Command:
        """The reported poses, with joint readings if they are known."""
        return Command(self.poses, None if self.joints is None else to_device(self.joints))

    def of_views(self, views: Sequence[str]) -> "RobotReadings":
        """Return the readings of some of the views, by id."""
        place = {view: k for k, view in enumerate(self.view_ids)}
        index = np.array([place[view] for view in views], dtype=int)
        return self._replace(
            view_ids=list(views),
            poses=host_transforms(host_matrices(self.poses)[index]),
            masked_views={v: text for v, text in self.masked_views.items() if v in set(views)},
            joints=None if self.joints is None else np.asarray(self.joints)[index],
        )

    def with_joints(self, data: Dataset) -> Dataset:
        """Return the data set with the joint readings added, if there are any."""
        return data if self.arm is None else data.with_joints(self.joints, self.arm)


def read_poses(
    folder: Path, content: dict[str, Any], bad_views: str, entry: str = "poses"
) -> RobotReadings:
    """Read view ids and poses, and the reasons of masked views by view id.

    A row that is no valid pose masks its view if `bad_views` is `"mask"`, else it is an error.
    """
    path = folder / content["file"]
    if path.suffix == ".json":
        return _read_commands(path, content)
    table = read_table(path, ("view",))
    refuse_truncated(path, table.rows, content.get("rows"))
    view_ids = table.view_ids("poses")
    form = table_format(path, table.rows, content, entry)
    table, codec = table.requiring(("view", *form.columns), form.units), form.codec
    # NaN passes here: `bad_views` decides below.
    rows = np.stack(
        [parse_numbers(path, row, form.columns, row["view"], False) for row in table.rows]
    )
    if note := rounding_note(path.name, rows, form):
        table = dataclasses.replace(table, notes=(*table.notes, note))
    positions = rows[:, list(codec.length_columns)] * LENGTH_UNITS[form.length_unit]
    # Infinity is replaced by NaN, which passes, because a message about units would mislead.
    refuse_out_of_range(path, np.where(np.isfinite(positions), positions, np.nan), view_ids)
    masked_views = _decoding_errors(form, rows, view_ids) if bad_views == "mask" else {}
    is_valid = [view not in masked_views for view in view_ids]
    # Decoding needs a valid row for every view: masked views, whose pose is never used, get the
    # first valid row.
    rows = np.where(
        np.array(is_valid)[:, None], rows, rows[is_valid.index(True) if any(is_valid) else 0]
    )
    poses = decoded_poses(path, form, rows, view_ids)
    return RobotReadings(view_ids, poses, masked_views, table, codec.name, table.notes)


def write_poses(
    folder: Path,
    view_ids: Sequence[str],
    poses: SE3,
    pose_format: str = "matrix",
    file: str = POSES_FILE,
) -> None:
    """Write a table of poses, which `poses_entry` describes.

    Args:
        view_ids: one id for each pose.
        poses: such as the robot's reported `base_from_tool`, `(views)`.
        pose_format: one of `POSE_CODECS`, written in its manufacturer's units.

    Raises:
        ValueError: an unknown format, or a name or position with which the file could not be read
            back.
    """
    codec, path = pose_codec(pose_format), folder / file
    require_readable(f"{path}: view", view_ids)
    refuse_out_of_range(path, np.asarray(poses.translation()), view_ids)
    write_view_table(path, view_ids, codec.columns, codec.encode(poses, *codec.units))


def poses_entry(
    count: int | None, pose_format: str = "matrix", file: str = POSES_FILE
) -> dict[str, Any]:
    """Return the entry `poses` of a description.

    Args:
        count: number of the table's rows; None for a table that will grow.
        pose_format: one of `POSE_CODECS`.

    Raises:
        ValueError: an unknown format.
    """
    codec = pose_codec(pose_format)
    return {
        "file": file,
        "codec": codec.name,
        "length_unit": codec.units[0],
        "angle_unit": codec.units[1],
        "direction": "base_from_tool",
        **({} if count is None else {"rows": count}),
    }


def _read_commands(path: Path, content: dict[str, Any]) -> RobotReadings:
    """Read view ids and poses from a JSON file of commands."""
    # `read_viewpoints` refuses invalid poses, so none is masked.
    commands = read_viewpoints(path)
    codec = pose_codec(commands.pose_format)
    stated_format(PoseFormat(codec, *codec.units, codec.columns), content, path)
    refuse_truncated(path, commands.names, content.get("rows"))
    return RobotReadings(
        list(commands.names), commands.base_from_tool, {}, pose_format=commands.pose_format
    )


def _decoding_errors(form: PoseFormat, rows: np.ndarray, view_ids: list[str]) -> dict[str, str]:
    """Return the decoding error of every view whose row is not a valid pose, by view id."""
    # Row by row, since decoding a whole table stops at the first invalid row.
    errors = {}
    for view, row in zip(view_ids, rows, strict=True):
        try:
            form.codec.decode(row[None], *form.units, labels=[view])
        except ValueError as error:
            errors[view] = str(error)
    return errors
