"""Read and write the joint readings of a data-set folder, `joints.csv`, and their arm.

    joints: {file: joints.csv, angle_unit: deg, length_unit: m, arm: kuka_lwr4}

The file has a column `view` and one column for each joint: `q1`, `q2`, ... Instead of a name,
`arm` may hold the Denavit-Hartenberg parameters, rad and m: the rows `theta`, `d`, `a` and `alpha`,
the `convention`, which joints are `prismatic`, their `limits` (a pair for each joint, null where
there is no limit), `flange_from_tool` and `base_from_first`.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..argument_checks import errors_at
from ..geometry import ANGLE_UNITS, LENGTH_UNITS
from ..robots import SerialArm, arm_by_name, arm_from_dict, arm_to_dict
from .csv_tables import (
    Table,
    duplicates,
    parse_numbers,
    read_table,
    refuse_truncated,
    write_view_table,
)
from .folder_description import DescribedFolder
from .view_names import with_names_of

JOINTS_FILE = "joints.csv"
"""The name of the file that `write_joints` writes."""

MAX_JOINT_READING = 100.0
"""Largest magnitude of a joint reading, rad or m; no real joint reaches it."""


class ReadJoints(NamedTuple):
    """The joint readings of a table, by view.

    Attributes:
        readings: rad (m for a prismatic joint).
        arm: the arm that has these readings.
        notes: sentences on what was recognised in the table.
    """

    view_ids: tuple[str, ...]
    readings: Float[np.ndarray, "views joints"]
    arm: SerialArm
    table: Table
    notes: tuple[str, ...]


def read_joints(described: DescribedFolder, view_ids: Sequence[str] | None) -> ReadJoints:
    """Read view ids (in the wanted order), readings (rad, m) and arm from the entry `joints`."""
    content = described.content["joints"]
    arm = _arm_from_entry(content.get("arm"), described.path)
    path, columns = described.folder / content["file"], _joint_columns(arm)
    stated_units = (content["angle_unit"], content["length_unit"])
    joints_table = read_table(path, ("view", *columns), stated_units)
    rows, notes = (
        (joints_table.rows, ()) if view_ids is None else with_names_of(joints_table, view_ids)
    )
    refuse_truncated(path, rows, content.get("rows"))
    table = {row["view"]: row for row in rows}
    if repeated := duplicates([row["view"] for row in rows]):
        raise ValueError(f"{path}: view {', '.join(repeated)} has more than one row")
    ordered_views = tuple(table) if view_ids is None else tuple(view_ids)
    if set(ordered_views) != set(table) or not table:
        unmatched = sorted(set(ordered_views) ^ set(table))
        raise ValueError(f"{path}: poses and joints have different views: {', '.join(unmatched)}")
    # A prismatic joint reads a length, a revolute one an angle.
    length, angle = LENGTH_UNITS[content["length_unit"]], ANGLE_UNITS[content["angle_unit"]]
    unit_factors = np.where(arm.prismatic, length, angle)
    readings = np.stack(
        [unit_factors * parse_numbers(path, table[view], columns, view) for view in ordered_views]
    )
    _refuse_impossible(path, ordered_views, readings, columns)
    notes = (*joints_table.notes, *notes, *_further_joints(joints_table, columns))
    return ReadJoints(ordered_views, readings, arm, joints_table, notes)


def write_joints(
    folder: Path,
    view_ids: Sequence[str],
    joints: Float[np.ndarray, "views joints"],
    arm: SerialArm,
) -> None:
    """Write `joints.csv`, which `joints_entry` describes.

    Raises:
        ValueError: a name or a reading with which the file could not be read back.
    """
    columns = _joint_columns(arm)
    _refuse_impossible(folder / JOINTS_FILE, view_ids, joints, columns)
    write_view_table(folder / JOINTS_FILE, view_ids, columns, joints)


def joints_entry(count: int, arm: SerialArm) -> dict[str, Any]:
    """Return the entry `joints` of a description, for a table with a number of rows."""
    return {
        "file": JOINTS_FILE,
        "angle_unit": "rad",
        "length_unit": "m",
        "arm": arm_to_dict(arm),
        "rows": count,
    }


def _refuse_impossible(
    path: Path,
    view_ids: Sequence[str],
    readings: Float[np.ndarray, "views joints"],
    columns: Sequence[str],
) -> None:
    """Raise a ValueError that names the first impossible reading, rad or m."""
    for view, row in zip(view_ids, readings, strict=True):
        # NaN fails this comparison as well.
        wrong = ~(np.abs(row) <= MAX_JOINT_READING)
        if wrong.any():
            k = int(np.argmax(wrong))
            raise ValueError(
                f"{path}: view {view}: {columns[k]} is {row[k]:.6g} rad or m, "
                f"more than {MAX_JOINT_READING:g}: degrees (state angle_unit: deg), or counts of "
                "an encoder?"
            )


def _further_joints(table: Table, columns: Sequence[str]) -> tuple[str, ...]:
    """Return a sentence about joints in the table that the arm does not have; empty if none."""
    further = [
        name for name in table.written_header if re.fullmatch(r"q\d+", name) and name not in columns
    ]
    if not further:
        return ()
    return (
        f"{table.path.name} has {', '.join(further)} too, which the stated arm of {len(columns)} "
        "joints has not: is it the right arm? They are not used",
    )


def _joint_columns(arm: SerialArm) -> tuple[str, ...]:
    """Return the names of the columns of readings: q1, q2, ..."""
    return tuple(f"q{1 + k}" for k in range(arm.joint_count))


def _arm_from_entry(content: Any, description_path: Path) -> SerialArm:
    """Return the arm of an entry `arm`: a name or a mapping of Denavit-Hartenberg parameters."""
    with errors_at(f"{description_path}: joints.arm"):
        return arm_from_dict(content) if isinstance(content, dict) else arm_by_name(content)
