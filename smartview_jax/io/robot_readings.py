"""Read the robot's reported pose, joint readings, or both, for every view of a data-set folder."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..dataset import Dataset
from ..geometry import LENGTH_UNITS, PoseCodec, as_se3, host_matrices, pose_codec
from ..robots import SerialArm
from .csv_tables import duplicates, parse_numbers, read_table, refuse_out_of_range, refuse_truncated
from .joints import read_joints


class RobotReadings(NamedTuple):
    """The robot's reported poses by view, with the joint readings where the folder has them.

    Attributes:
        view_ids: view ids.
        poses: reported `base_from_tool`, `(views)`.
        masked_views: reason by view id, for the views whose row is not a valid pose.
        joints: joint readings, rad (m for a prismatic joint); None where the folder has none.
        arm: the arm that the readings belong to; None where there are no readings.
    """

    view_ids: Sequence[str]
    poses: SE3
    masked_views: dict[str, str]
    joints: Float[np.ndarray, "views joints"] | None = None
    arm: SerialArm | None = None

    def with_joints(self, data: Dataset) -> Dataset:
        """Return the data set with the joint readings added, if there are any."""
        return data if self.arm is None else data.with_joints(self.joints, self.arm)


def read_robot_readings(
    folder: Path, content: dict[str, Any], description_path: Path, bad_views: str
) -> RobotReadings:
    """Read the tables that the entries `poses` and `joints` of a description name.

    Raises:
        ValueError: naming the file and the entry or view that is wrong.
        FileNotFoundError: a table is missing.
    """
    view_ids = poses = None
    masked_views: dict[str, str] = {}
    if "poses" in content:
        view_ids, poses, masked_views = _read_poses(folder, content["poses"], bad_views)
        if "joints" not in content:
            return RobotReadings(view_ids, poses, masked_views)
    # Reported poses have precedence; without them the arm's forward kinematics gives them.
    view_ids, joints, arm = read_joints(folder, content["joints"], description_path, view_ids)
    return RobotReadings(
        view_ids, arm.base_from_tool(joints) if poses is None else poses, masked_views, joints, arm
    )


def _read_poses(
    folder: Path, content: dict[str, Any], bad_views: str
) -> tuple[list[str], SE3, dict[str, str]]:
    """Read the view ids, the poses, and the reason by view id for the poses to be masked."""
    path, codec = folder / content["file"], pose_codec(content["codec"])
    table = read_table(path, ("view", *codec.columns))
    refuse_truncated(path, table, content.get("rows"))
    view_ids = [row["view"] for row in table]
    if duplicates(view_ids):
        raise ValueError(f"{path}: view {', '.join(duplicates(view_ids))} has more than one row")
    if not view_ids:
        raise ValueError(f"{path}: no poses")
    # NaN passes here: `bad_views` decides below whether it is an error or a masked view.
    rows = np.stack([parse_numbers(path, row, codec.columns, row["view"], False) for row in table])
    positions = rows[:, list(codec.length_columns)] * LENGTH_UNITS[content["length_unit"]]
    # Infinity becomes NaN, which passes: the message about units would be misleading for it.
    refuse_out_of_range(path, np.where(np.isfinite(positions), positions, np.nan), view_ids)
    units = (content["length_unit"], content["angle_unit"])
    masked_views = _decoding_errors(codec, rows, units, view_ids) if bad_views == "mask" else {}
    is_valid = [view not in masked_views for view in view_ids]
    # Decoding needs a valid row for every view. A masked view's pose is never used, so the first
    # valid row takes its place.
    rows = np.where(
        np.array(is_valid)[:, None], rows, rows[is_valid.index(True) if any(is_valid) else 0]
    )
    try:
        poses = codec.decode(rows, *units, labels=view_ids)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if content["direction"] != "base_from_tool":
        poses = as_se3(np.linalg.inv(host_matrices(poses)))
    return view_ids, poses, masked_views


def _decoding_errors(
    codec: PoseCodec, rows: np.ndarray, units: tuple[str, str], view_ids: list[str]
) -> dict[str, str]:
    """Return the decoding error of every view whose row is not a valid pose, by view id."""
    # Row by row, since decoding a whole table stops at the first invalid row.
    errors = {}
    for view, row in zip(view_ids, rows, strict=True):
        try:
            codec.decode(row[None], *units, labels=[view])
        except ValueError as error:
            errors[view] = str(error)
    return errors
