"""Read the robot's reported pose, joint readings, or both, for every view of a data-set folder."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..dataset import Dataset
from ..geometry import LENGTH_UNITS, PoseCodec, pose_codec
from ..robots import SerialArm
from .joints import read_joints
from .tables import duplicates, numbers, read_table, refuse_cut, refuse_far


class Commands(NamedTuple):
    """The robot's reported poses by view, with the joint readings where the folder has them.

    Attributes:
        views: view ids.
        poses: reported `base_from_tool`, `(views)`.
        masked: reason by view id, for the views whose row is not a valid pose.
        joints: joint readings, rad (m for a prismatic joint); None where the folder has none.
        arm: the arm that the readings belong to; None where there are no readings.
    """

    views: Sequence[str]
    poses: SE3
    masked: dict[str, str]
    joints: Float[np.ndarray, "views joints"] | None = None
    arm: SerialArm | None = None

    def with_joints(self, data: Dataset) -> Dataset:
        """Return the data set with the joint readings added, if there are any."""
        return data if self.arm is None else data.with_joints(self.joints, self.arm)


def read_commands(folder: Path, content: dict[str, Any], where: Path, bad_views: str) -> Commands:
    """Read the tables that the entries `poses` and `joints` of a description name.

    Raises:
        ValueError: naming the file and the entry or view that is wrong.
        FileNotFoundError: a table is missing.
    """
    views = poses = None
    masked: dict[str, str] = {}
    if "poses" in content:
        views, poses, masked = _read_poses(folder, content["poses"], bad_views)
        if "joints" not in content:
            return Commands(views, poses, masked)
    # Reported poses have precedence; without them the arm's forward kinematics gives them.
    views, joints, arm = read_joints(folder, content["joints"], where, views)
    return Commands(
        views, arm.base_from_tool(joints) if poses is None else poses, masked, joints, arm
    )


def _read_poses(
    folder: Path, content: dict[str, Any], bad_views: str
) -> tuple[list[str], SE3, dict[str, str]]:
    """Read the view ids, the poses, and the reason by view id for the poses to be masked."""
    path, codec = folder / content["file"], pose_codec(content["codec"])
    table = read_table(path, ("view", *codec.columns))
    refuse_cut(path, table, content.get("rows"))
    views = [row["view"] for row in table]
    if duplicates(views):
        raise ValueError(f"{path}: view {', '.join(duplicates(views))} has more than one row")
    if not views:
        raise ValueError(f"{path}: no poses")
    # NaN passes here: `bad_views` decides below whether it is an error or a masked view.
    rows = np.stack([numbers(path, row, codec.columns, row["view"], False) for row in table])
    positions = rows[:, list(codec.lengths)] * LENGTH_UNITS[content["length_unit"]]
    # Infinity becomes NaN, which passes: the message about units would be misleading for it.
    refuse_far(path, np.where(np.isfinite(positions), positions, np.nan), views)
    units = (content["length_unit"], content["angle_unit"])
    masked = _undecodable(codec, rows, units, views) if bad_views == "mask" else {}
    good = [view not in masked for view in views]
    # Decoding needs a valid row for every view. A masked view's pose is never used, so the first
    # valid row takes its place.
    rows = np.where(np.array(good)[:, None], rows, rows[good.index(True) if any(good) else 0])
    try:
        poses = codec.decode(rows, *units, labels=views)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return views, poses if content["direction"] == "base_from_tool" else poses.inverse(), masked


def _undecodable(
    codec: PoseCodec, rows: np.ndarray, units: tuple[str, str], views: list[str]
) -> dict[str, str]:
    """Return the decoding error of every view whose row is not a valid pose, by view id."""
    # Row by row, since decoding a whole table stops at the first invalid row.
    problems = {}
    for view, row in zip(views, rows, strict=True):
        try:
            codec.decode(row[None], *units, labels=[view])
        except ValueError as error:
            problems[view] = str(error)
    return problems
