"""What the robot said of every view of a data-set folder: poses, joint angles, or both."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..dataset import Dataset
from ..geometry import PoseCodec, pose_codec
from ..robots import SerialArm
from .joints import read_joints
from .tables import duplicates, numbers, read_table

_DIRECTIONS = ("base_from_tool", "tool_from_base")


class Commands(NamedTuple):
    """Poses by view, and the joints behind them where the folder has them.

    Attributes:
        views: ids.
        poses: `base_from_tool`, `(views)`.
        masked: reason by view, of those whose pose is none.
        joints: readings, rad or m.
        arm: whose.
    """

    views: Sequence[str]
    poses: SE3
    masked: dict[str, str]
    joints: Float[np.ndarray, "views joints"] | None = None
    arm: SerialArm | None = None

    def with_joints(self, data: Dataset) -> Dataset:
        """A data set of these views, with the joints if there are any."""
        return data if self.arm is None else data.with_joints(self.joints, self.arm)


def read_commands(folder: Path, content: dict[str, Any], where: Path, bad_views: str) -> Commands:
    """The entries `poses` and `joints` of a description.

    Raises:
        ValueError: naming the file and the entry or view that is wrong.
        FileNotFoundError: a table is missing.
    """
    views = poses = None
    masked: dict[str, str] = {}
    if "poses" in content:
        views, poses, masked = _read_poses(folder, content["poses"], where, bad_views)
        if "joints" not in content:
            return Commands(views, poses, masked)
    views, joints, arm = read_joints(folder, content["joints"], where, views)
    return Commands(
        views, arm.base_from_tool(joints) if poses is None else poses, masked, joints, arm
    )


def _read_poses(
    folder: Path, content: dict[str, Any], where: Path, bad_views: str
) -> tuple[list[str], SE3, dict[str, str]]:
    """View ids, poses, and the views whose pose is masked, with reasons."""
    for key in ("file", "codec", "length_unit", "angle_unit", "direction"):
        if key not in content:
            raise ValueError(f"{where}: entry 'poses.{key}' is missing: units are never guessed")
    if content["direction"] not in _DIRECTIONS:
        raise ValueError(
            f"{where}: poses.direction is one of {', '.join(_DIRECTIONS)}; "
            f"found {content['direction']!r}"
        )
    path = folder / content["file"]
    try:
        codec = pose_codec(content["codec"])
    except ValueError as error:
        raise ValueError(f"{where}: poses.codec: {error}") from error
    table = read_table(path, ("view", *codec.columns))
    views = [row["view"] for row in table]
    if duplicates(views):
        raise ValueError(f"{path}: view {', '.join(duplicates(views))} has more than one row")
    if not views:
        raise ValueError(f"{path}: no poses")
    rows = np.stack([numbers(path, row, codec.columns, row["view"]) for row in table])
    units = (content["length_unit"], content["angle_unit"])
    masked = _undecodable(codec, rows, units, views) if bad_views == "mask" else {}
    good = [view not in masked for view in views]
    # The pose of a masked view is never used; any other stands in for it.
    rows = np.where(np.array(good)[:, None], rows, rows[good.index(True) if any(good) else 0])
    try:
        poses = codec.decode(rows, *units, labels=views)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return views, poses if content["direction"] == "base_from_tool" else poses.inverse(), masked


def _undecodable(
    codec: PoseCodec, rows: np.ndarray, units: tuple[str, str], views: list[str]
) -> dict[str, str]:
    problems = {}
    for view, row in zip(views, rows, strict=True):
        try:
            codec.decode(row[None], *units, labels=[view])
        except ValueError as error:
            problems[view] = str(error)
    return problems
