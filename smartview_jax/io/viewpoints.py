"""Write viewpoints for robot controllers as VAL II programs, CSV or JSON; read CSV and JSON.

VAL uses mm and degrees; CSV states its units in the header, JSON in an entry `units`. CSV and JSON
contain the poses in the format and the units of the robot's manufacturer (`POSE_CODECS`). A command
that no robot can execute is refused when it is written, before any robot moves.

A grasp is written in the same formats, with its `HandSteps`.
"""

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from .. import schemas
from ..argument_checks import errors_at, require_readable
from ..files import write_atomically
from ..geometry import PoseCodec, pose_codec
from ..robots import MAX_TOOL_COORDINATE
from .csv_tables import duplicates, parse_numbers, read_table, write_table
from .pose_format import FORMAT_COLUMN, codec_of_rows, pose_columns

FORMAT_VERSION = 1
"""Version of the JSON format."""

VAL_CODEC = "val_oat"
"""The name of the pose format of VAL II: x, y, z in mm, and the angles O, A, T in degrees."""

_JOINT_UNITS = {"joint_that_turns": "rad", "joint_that_slides": "m"}
_VAL_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.]{0,14}")


class HandSteps(NamedTuple):
    """The actions of the tool on its way to each pose of a grasp; one entry for each pose.

    In VAL, MOVES is a straight line and MOVE a joint-interpolated motion. OPENI and CLOSEI wait
    until the arm stands, then move the fingers; OPEN and CLOSE move them on the way to the next
    location. BREAK waits as well: without it the controller blends into the next motion, so that a
    straight line would not begin where it was checked.

    Attributes:
        straight: whether the tool moves in a straight line; otherwise by joint interpolation.
        opening: distance between the fingers, m, set before the motion; zero closes them on the
            object.
    """

    straight: tuple[bool, ...]
    opening: tuple[float, ...]

    @property
    def motions(self) -> tuple[str, ...]:
        """The column `motion` of CSV and JSON: "straight" or "free"."""
        return tuple("straight" if straight else "free" for straight in self.straight)


class Viewpoints(NamedTuple):
    """The commands of a viewpoint file.

    Attributes:
        base_from_tool: commanded poses, `(views)`.
        names: one name for each view.
        joints: joint readings, rad (m for a prismatic joint); None where the file has none.
        pose_format: name of the pose format, in its manufacturer's units.
        notes: sentences on what was recognised in a table.
    """

    base_from_tool: SE3
    names: tuple[str, ...]
    joints: Float[np.ndarray, "views joints"] | None = None
    pose_format: str = VAL_CODEC
    notes: tuple[str, ...] = ()


def write_viewpoints(
    path: str | Path,
    base_from_tool: SE3,
    names: Sequence[str] | None = None,
    joints: np.ndarray | None = None,
    pose_format: str = VAL_CODEC,
    hand: HandSteps | None = None,
) -> None:
    """Write commands in the format given by the file's ending, completely or not at all.

    Args:
        path: file name that ends in `.val` (or `.v2`), `.csv` or `.json`.
        base_from_tool: commanded poses, `(views)`, or a single pose.
        names: one name for each view; by default v1, v2, ...
        joints: `(views, joints)` rad (m for a prismatic joint); VAL's `TRANS` has no joints.
        pose_format: pose format of CSV and JSON, in the manufacturer's units: one of
            `POSE_CODECS`, such as `"kuka_abc"`, `"ur"`, `"fanuc_wpr"`, `"abb"`.
        hand: motions and openings of the tool, for a grasp; CSV and JSON then have `motion` and
            `opening_m` for each pose. None for a camera's viewpoints.

    Raises:
        ValueError: an unknown ending or format, or a command that no robot can execute; the
            message names the view and the value.
    """
    path, codec = Path(path), pose_codec(pose_format)
    if path.suffix not in (".val", ".v2", ".csv", ".json"):
        raise ValueError(f"{path}: expected a file ending in .val, .v2, .csv or .json")
    if path.suffix in (".val", ".v2"):
        if pose_format != VAL_CODEC:
            raise ValueError(
                f"{path}: a VAL program has {VAL_CODEC} poses, not {pose_format}: write .csv or "
                ".json"
            )
        write_atomically(path, val_program(base_from_tool, names, hand))
        return
    viewpoints = _validated_viewpoints(base_from_tool, names, joints)
    if path.suffix == ".json":
        content = _json_content(viewpoints, codec, hand)
        schemas.write_validated(path, content, schemas.VIEWPOINTS_SCHEMA)
        return
    count, readings = len(viewpoints.names), viewpoints.joints
    numbers = _encoded_poses(viewpoints, codec)
    header = ["view", FORMAT_COLUMN, *pose_columns(codec)]
    if readings is not None:
        numbers = np.concatenate([numbers, readings], axis=1)
        header += [f"joint_{1 + k}" for k in range(readings.shape[1])]
    header += [] if hand is None else ["motion", "opening_m"]
    rows = zip(viewpoints.names, numbers.tolist(), hand_columns(hand, count), strict=True)
    write_table(path, header, [[name, codec.name, *row, *step] for name, row, step in rows])


def read_viewpoints(path: str | Path) -> Viewpoints:
    """Read commands that `write_viewpoints` wrote as CSV or JSON.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: an unknown format, or a wrong value; the message names the file and the view.
    """
    path = Path(path)
    if path.suffix == ".csv":
        return _read_csv(path)
    if path.suffix == ".json":
        return _read_json(path)
    raise ValueError(f"{path}: expected a file ending in .csv or .json")


def val_program(
    base_from_tool: SE3, names: Sequence[str] | None = None, hand: HandSteps | None = None
) -> str:
    """Return a VAL II program that moves to the viewpoints in order; mm and degrees.

    The number after OPENI, mm, is for a servo hand. V+ takes no number, and a pneumatic hand opens
    as far as it goes: its grasps must be checked for the full opening.

    Raises:
        ValueError: as in `write_viewpoints`; also a name that VAL does not accept.
    """
    viewpoints = _validated_viewpoints(base_from_tool, names, None)
    count = len(viewpoints.names)
    before, moves = [()] * count, ["MOVE"] * count
    if hand is not None:
        before = val_hand(hand, count)
        moves = ["MOVES" if straight else "MOVE" for straight in hand.straight]
    lines = []
    rows = _encoded_poses(viewpoints, pose_codec(VAL_CODEC))
    for name, row, actions, move in zip(viewpoints.names, rows, before, moves, strict=True):
        if not _VAL_NAME.fullmatch(name):
            raise ValueError(
                f"view {name!r}: VAL names a location by a letter and up to 14 letters, digits, "
                "points or underscores"
            )
        # Four decimals are 0.1 micrometre and 0.0001 degree, finer than a controller resolves.
        # Adding 0.0 turns a rounded -0.0 into 0.0.
        components = ", ".join(f"{value + 0.0:.4f}" for value in np.round(row, 4))
        lines += [*actions, f"SET {name} = TRANS({components})", f"{move} {name}"]
    return "\n".join(lines) + "\n"


def _validated_viewpoints(
    base_from_tool: SE3, names: Sequence[str] | None, joints: np.ndarray | None
) -> Viewpoints:
    """Return the commands as arrays; raise a ValueError for an impossible command."""
    poses = np.atleast_2d(np.asarray(base_from_tool.wxyz_xyz))
    joints = None if joints is None else np.atleast_2d(joints)
    if poses.ndim != 2:
        raise ValueError(f"viewpoints: expected one pose a view, found shape {poses.shape[:-1]}")
    view_names = (
        tuple(names) if names is not None else tuple(f"v{1 + k}" for k in range(len(poses)))
    )
    if len(view_names) != len(poses):
        raise ValueError(f"viewpoints: {len(poses)} poses, but {len(view_names)} names")
    repeated = duplicates(view_names)
    if repeated:
        raise ValueError(f"view {', '.join(repeated)}: named more than once")
    require_readable("view", view_names)
    # Components of a unit quaternion are at most 1, so the limit serves all seven numbers.
    for name, pose in zip(view_names, poses, strict=True):
        for component, value in zip(("qw", "qx", "qy", "qz", "x", "y", "z"), pose, strict=True):
            if not np.isfinite(value):
                raise ValueError(f"view {name}: {component} is {value}")
            if abs(value) > MAX_TOOL_COORDINATE:
                raise ValueError(
                    f"view {name}: {component} is {value:.6g} m, more than "
                    f"{MAX_TOOL_COORDINATE:.0f} m from the base: millimetres given as metres?"
                )
    if joints is None:
        return Viewpoints(SE3(jax.device_put(poses)), view_names)
    readings = np.asarray(joints, dtype=float)
    if readings.ndim != 2 or len(readings) != len(view_names):
        raise ValueError(
            f"joints: expected a row for each of {len(view_names)} views, "
            f"found shape {readings.shape}"
        )
    for name, row in zip(view_names, readings, strict=True):
        if not np.isfinite(row).all():
            k = int(np.flatnonzero(~np.isfinite(row))[0])
            raise ValueError(f"view {name}: joint {1 + k} is {row[k]}")
    return Viewpoints(SE3(jax.device_put(poses)), view_names, readings)


def _encoded_poses(viewpoints: Viewpoints, codec: PoseCodec) -> Float[np.ndarray, "views columns"]:
    """Return the poses as rows of a manufacturer's format, in its units."""
    return np.array(codec.encode(viewpoints.base_from_tool, *codec.units))


def _units(codec: PoseCodec) -> dict[str, str]:
    """Return the entry `units` of the JSON format."""
    return {"length": codec.units[0], "angle": codec.units[1], **_JOINT_UNITS}


def _pose_key(codec: PoseCodec) -> str:
    """Return the key of a pose in JSON: `xyzoat` for VAL's format, else `pose`."""
    return "xyzoat" if codec.name == VAL_CODEC else "pose"


def _json_content(
    viewpoints: Viewpoints, codec: PoseCodec, hand: HandSteps | None
) -> dict[str, Any]:
    """Return the commands as the content of a JSON file."""
    entries: list[dict[str, Any]] = [
        {"name": name, _pose_key(codec): row}
        for name, row in zip(
            viewpoints.names, _encoded_poses(viewpoints, codec).tolist(), strict=True
        )
    ]
    if viewpoints.joints is not None:
        for entry, readings in zip(entries, viewpoints.joints.tolist(), strict=True):
            entry["joints"] = readings
    for entry, step in zip(entries, hand_columns(hand, len(entries)), strict=True):
        entry |= dict(zip(("motion", "opening_m"), step, strict=False))
    return {
        "smartview_viewpoints": FORMAT_VERSION,
        "format": codec.name,
        "columns": list(codec.columns),
        "units": _units(codec),
        "viewpoints": entries,
    }


def _read_csv(path: Path) -> Viewpoints:
    """Read commands from a CSV file; without a column `format` the poses are VAL's."""
    table = read_table(path, ("view",))
    codec = codec_of_rows(path, table.rows) or pose_codec(VAL_CODEC)
    columns = pose_columns(codec)
    rows = table.requiring(("view", *columns)).rows
    names = [row["view"] for row in rows]
    poses = np.array([parse_numbers(path, row, columns, row["view"], False) for row in rows])
    joint_columns = [name for name in (rows[0] if rows else ()) if name.startswith("joint_")]
    joints = np.array([parse_numbers(path, row, joint_columns, row["view"], False) for row in rows])
    return _decode_viewpoints(
        path, codec, poses.reshape(-1, len(columns)), names, joints if joint_columns else None
    )._replace(notes=table.notes)


def _read_json(path: Path) -> Viewpoints:
    """Read commands from a JSON file of `write_viewpoints`."""
    content = schemas.read_validated(path, schemas.VIEWPOINTS_SCHEMA)
    codec, entries = pose_codec(content.format), content.viewpoints
    if content.units != _units(codec):
        raise ValueError(f"{path}: units: expected {_units(codec)}, found {content.units}")
    if content.columns not in (None, list(codec.columns)):
        raise ValueError(
            f"{path}: columns: expected {list(codec.columns)}, found {content.columns}"
        )
    key = _pose_key(codec)
    rows = [getattr(entry, key) for entry in entries]
    for entry, row in zip(entries, rows, strict=True):
        if row is None or len(row) != len(codec.columns):
            raise ValueError(
                f"{path}: view {entry.name}: {key}: expected {len(codec.columns)} numbers "
                f"({', '.join(codec.columns)}) in the format {codec.name}"
            )
    joints = [entry.joints for entry in entries if entry.joints is not None]
    if joints and {len(row) for row in joints} != {len(joints[0])}:
        raise ValueError(f"{path}: joints: views have different numbers of joint readings")
    names = [entry.name for entry in entries]
    poses = np.array(rows).reshape(-1, len(codec.columns))
    return _decode_viewpoints(path, codec, poses, names, np.array(joints) if joints else None)


def _decode_viewpoints(
    path: Path,
    codec: PoseCodec,
    rows: np.ndarray,
    names: Sequence[str],
    joints: np.ndarray | None,
) -> Viewpoints:
    """Decode rows of a pose format to commands; errors name the file."""
    if not names:
        raise ValueError(f"{path}: no viewpoints")
    with errors_at(path):
        poses = codec.decode(rows, *codec.units, labels=names)
        return _validated_viewpoints(poses, names, joints)._replace(pose_format=codec.name)


def hand_columns(hand: HandSteps | None, count: int) -> list[tuple[str, float] | tuple[()]]:
    """Return the columns `motion` and `opening_m` of each pose; no columns without a hand."""
    if hand is None:
        return [()] * count
    _check_hand(hand, count)
    return list(zip(hand.motions, map(float, hand.opening), strict=True))


def val_hand(hand: HandSteps, count: int) -> list[list[str]]:
    """Return the lines of VAL before the motion to each pose."""
    _check_hand(hand, count)
    lines = []
    openings, motions = (np.nan, *hand.opening), (True, *hand.straight)
    for (old, new), (was_straight, straight) in zip(
        pairwise(openings), pairwise(motions), strict=True
    ):
        actions = ["BREAK"] if straight and not was_straight else []
        if new != old:
            actions.append(f"OPENI {1e3 * new:.2f}" if new > 0.0 else "CLOSEI")
        lines.append(actions)
    return lines


def _check_hand(hand: HandSteps, count: int) -> None:
    """Raise a ValueError for a wrong number of steps or an impossible opening."""
    if not len(hand.straight) == len(hand.opening) == count:
        raise ValueError(
            f"hand: expected an entry for each of {count} poses, found {len(hand.straight)} in "
            f"straight and {len(hand.opening)} in opening"
        )
    for opening in hand.opening:
        if not 0.0 <= opening < np.inf:
            raise ValueError(f"hand: opening: expected metres, 0 or more, found {opening!r}")
