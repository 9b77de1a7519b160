"""Read and write the joint readings of a data-set folder, `joints.csv`, and their arm.

    joints: {file: joints.csv, angle_unit: deg, length_unit: m, arm: kuka_lwr4}

The file has a column `view` and one column for each joint: `q1`, `q2`, ... Instead of a name,
`arm` may hold the Denavit-Hartenberg parameters, rad and m: the rows `theta`, `d`, `a` and `alpha`,
the `convention`, which joints are `prismatic`, their `limits` (a pair for each joint, null where
there is no limit), `flange_from_tool` and `base_from_first`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..geometry import ANGLE_UNITS, LENGTH_UNITS
from ..robots import SerialArm, arm_by_name, arm_from_dict, arm_to_dict
from .tables import duplicates, numbers, read_table, refuse_cut, write_table

JOINTS = "joints.csv"
"""Name of the file that `write_joints` writes."""

LARGEST = 100.0
"""Largest magnitude of a joint reading, rad or m; no real joint reaches it."""


def read_joints(
    folder: Path, content: dict[str, Any], where: Path, views: Sequence[str] | None
) -> tuple[tuple[str, ...], Float[np.ndarray, "views joints"], SerialArm]:
    """Read view ids, joint readings (rad, m) and arm from the entry `joints` of a description.

    Args:
        folder: of the data set.
        content: the entry, as `schemas.dataset` defines it.
        where: path of the description, for error messages.
        views: view ids in the order wanted; None keeps the order of the file.

    Raises:
        ValueError: naming the file and the entry or view that is wrong.
        FileNotFoundError: the table is missing.
    """
    arm = _arm(content.get("arm"), where)
    path, columns = folder / content["file"], _columns(arm)
    rows = read_table(path, ("view", *columns))
    refuse_cut(path, rows, content.get("rows"))
    table = {row["view"]: row for row in rows}
    if repeated := duplicates([row["view"] for row in rows]):
        raise ValueError(f"{path}: view {', '.join(repeated)} has more than one row")
    wanted = tuple(table) if views is None else tuple(views)
    if set(wanted) != set(table) or not table:
        other = sorted(set(wanted) ^ set(table))
        raise ValueError(f"{path}: poses and joints are not of the same views: {', '.join(other)}")
    length, angle = LENGTH_UNITS[content["length_unit"]], ANGLE_UNITS[content["angle_unit"]]
    units = np.where(arm.prismatic, length, angle)
    readings = np.stack([units * numbers(path, table[view], columns, view) for view in wanted])
    for view, row in zip(wanted, readings, strict=True):
        if (np.abs(row) > LARGEST).any():
            k = int(np.argmax(np.abs(row) > LARGEST))
            raise ValueError(
                f"{path}: view {view}: {columns[k]} is {row[k]:.6g} rad or m, more than {LARGEST:g}"
            )
    return wanted, readings, arm


def write_joints(
    folder: Path,
    views: Sequence[str],
    joints: Float[np.ndarray, "views joints"],
    arm: SerialArm,
) -> dict[str, Any]:
    """Write `joints.csv`, and return the entry `joints` of the description."""
    rows = [(view, *map(float, row)) for view, row in zip(views, joints, strict=True)]
    write_table(folder / JOINTS, ("view", *_columns(arm)), rows)
    return {
        "file": JOINTS,
        "angle_unit": "rad",
        "length_unit": "m",
        "arm": arm_to_dict(arm),
        "rows": len(rows),
    }


def _columns(arm: SerialArm) -> tuple[str, ...]:
    """Return the names of the columns of readings: q1, q2, ..."""
    return tuple(f"q{1 + k}" for k in range(arm.size))


def _arm(content: Any, where: Path) -> SerialArm:
    """Return the arm of an entry `arm`: a name or a mapping of Denavit-Hartenberg parameters."""
    try:
        return arm_from_dict(content) if isinstance(content, dict) else arm_by_name(content)
    except ValueError as error:
        raise ValueError(f"{where}: joints.arm: {error}") from error
