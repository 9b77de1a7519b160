"""Viewpoints for the robot's controller: VAL II programs, and CSV and JSON, also read back.

VAL has mm and degrees, CSV names its units in the header, JSON in an entry of its own. CSV and JSON
hold the poses as the robot's maker writes them (`POSE_CODECS`), in the maker's units. What no robot
can do is refused when it is written, not when it moves.
"""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..files import read_yaml, write_atomically
from ..geometry import PoseCodec, pose_codec
from ..robots import FARTHEST
from .tables import duplicates, numbers, read_table, write_table

FORMAT_VERSION = 1

VAL = "val_oat"

_JOINT_UNITS = {"joint_that_turns": "rad", "joint_that_slides": "m"}
_VAL_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.]{0,14}")


class Viewpoints(NamedTuple):
    """Commands as a file has them.

    Attributes:
        base_from_tool: `(views)`.
        names: one a view.
        joints: rad, m for a joint that slides; None where the file has none.
    """

    base_from_tool: SE3
    names: tuple[str, ...]
    joints: Float[np.ndarray, "views joints"] | None = None


def write_viewpoints(
    path: str | Path,
    base_from_tool: SE3,
    names: Sequence[str] | None = None,
    joints: np.ndarray | None = None,
    pose_format: str = VAL,
) -> None:
    """Write commands in the format that the file's ending names, whole or not at all.

    Args:
        path: ends in `.val` (or `.v2`), `.csv` or `.json`.
        base_from_tool: `(views)`, or one.
        names: one a view; by default v1, v2, ...
        joints: `(views, joints)` rad, m for a joint that slides; VAL's `TRANS` has none.
        pose_format: how poses are written in CSV and JSON, in the maker's units: one of
            `POSE_CODECS`, such as `"kuka_abc"`, `"ur"`, `"fanuc_wpr"`, `"abb"`.

    Raises:
        ValueError: an unknown ending or format, or a command that no robot can do; it names view
            and value.
    """
    path, codec = Path(path), pose_codec(pose_format)
    if path.suffix not in (".val", ".v2", ".csv", ".json"):
        raise ValueError(f"{path}: expected a file ending in .val, .v2, .csv or .json")
    if path.suffix == ".csv":
        views = _checked(base_from_tool, names, joints)
        readings = np.zeros((len(views.names), 0)) if views.joints is None else views.joints
        joint_columns = (f"joint_{1 + k}" for k in range(readings.shape[1]))
        # VAL's own columns are the default, and always were without a column for the format.
        form = [] if pose_format == VAL else [codec.name]
        header = ["view", *(["format"] if form else []), *pose_columns(codec), *joint_columns]
        rows = np.concatenate([_rows(views, codec), readings], axis=1).tolist()
        write_table(
            path, header, [[n, *form, *row] for n, row in zip(views.names, rows, strict=True)]
        )
    elif path.suffix == ".json":
        write_atomically(path, _as_json(_checked(base_from_tool, names, joints), codec))
    elif pose_format != VAL:
        raise ValueError(f"{path}: a VAL program has {VAL} poses, not {pose_format}: .csv or .json")
    else:
        write_atomically(path, val_program(base_from_tool, names))


def pose_columns(codec: PoseCodec) -> tuple[str, ...]:
    """Names of a format's columns with their units, the maker's own."""
    length, angle = codec.units
    return tuple(
        f"{name}_{length}".lower()
        if k in codec.lengths
        else f"{name}_{angle}".lower()
        if k in codec.angles
        else name
        for k, name in enumerate(codec.columns)
    )


def read_viewpoints(path: str | Path) -> Viewpoints:
    """What `write_viewpoints` wrote as CSV or JSON.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: another format, or a value that is wrong; file and view are named.
    """
    path = Path(path)
    if path.suffix == ".csv":
        return _from_csv(path)
    if path.suffix == ".json":
        return _from_json(path)
    raise ValueError(f"{path}: expected a file ending in .csv or .json")


def val_program(base_from_tool: SE3, names: Sequence[str] | None = None) -> str:
    """Lines of a VAL II program that moves to one viewpoint after the other; mm and degrees.

    Raises:
        ValueError: as `write_viewpoints`; also a name that VAL does not take.
    """
    views = _checked(base_from_tool, names, None)
    lines = []
    for name, row in zip(views.names, _rows(views, pose_codec(VAL)), strict=True):
        if not _VAL_NAME.fullmatch(name):
            raise ValueError(
                f"view {name!r}: VAL names a location by a letter and up to 14 letters, digits, "
                "points or underscores"
            )
        # A tenth of a micrometre, and as little of a turn: beyond what a controller resolves.
        written = ", ".join(f"{value + 0.0:.4f}" for value in np.round(row, 4))
        lines += [f"SET {name} = TRANS({written})", f"MOVE {name}"]
    return "\n".join(lines) + "\n"


def _checked(
    base_from_tool: SE3, names: Sequence[str] | None, joints: np.ndarray | None
) -> Viewpoints:
    poses = np.atleast_2d(np.asarray(base_from_tool.wxyz_xyz))
    joints = None if joints is None else np.atleast_2d(joints)
    if poses.ndim != 2:
        raise ValueError(f"viewpoints: expected one pose a view, found shape {poses.shape[:-1]}")
    known = tuple(names) if names is not None else tuple(f"v{1 + k}" for k in range(len(poses)))
    if len(known) != len(poses):
        raise ValueError(f"viewpoints: {len(poses)} poses, but {len(known)} names")
    twice = duplicates(known)
    if twice:
        raise ValueError(f"view {', '.join(twice)}: named more than once")
    for name, pose in zip(known, poses, strict=True):
        for what, value in zip(("qw", "qx", "qy", "qz", "x", "y", "z"), pose, strict=True):
            if not np.isfinite(value):
                raise ValueError(f"view {name}: {what} is {value}")
            if abs(value) > FARTHEST:
                raise ValueError(
                    f"view {name}: {what} is {value:.6g} m, more than {FARTHEST:.0f} m from the "
                    "base: millimetres given as metres?"
                )
    if joints is None:
        return Viewpoints(SE3(jnp.asarray(poses)), known)
    readings = np.asarray(joints, dtype=float)
    if readings.ndim != 2 or len(readings) != len(known):
        raise ValueError(
            f"joints: expected a row for each of {len(known)} views, found shape {readings.shape}"
        )
    for name, row in zip(known, readings, strict=True):
        if not np.isfinite(row).all():
            k = int(np.flatnonzero(~np.isfinite(row))[0])
            raise ValueError(f"view {name}: joint {1 + k} is {row[k]}")
    return Viewpoints(SE3(jnp.asarray(poses)), known, readings)


def _rows(views: Viewpoints, codec: PoseCodec) -> Float[np.ndarray, "views columns"]:
    """Poses as a maker has them, in the maker's units."""
    return np.array(codec.encode(views.base_from_tool, *codec.units))


def _units(codec: PoseCodec) -> dict[str, str]:
    return {"length": codec.units[0], "angle": codec.units[1], **_JOINT_UNITS}


def _key(codec: PoseCodec) -> str:
    """What a pose is called in JSON."""
    return "xyzoat" if codec.name == VAL else "pose"


def _as_json(views: Viewpoints, codec: PoseCodec) -> str:
    entries = [
        {"name": name, _key(codec): row, **({} if joints is None else {"joints": joints})}
        for name, row, joints in zip(
            views.names,
            _rows(views, codec).tolist(),
            [None] * len(views.names) if views.joints is None else views.joints.tolist(),
            strict=True,
        )
    ]
    content = {
        "smartview_viewpoints": FORMAT_VERSION,
        "format": codec.name,
        "columns": list(codec.columns),
        "units": _units(codec),
        "viewpoints": entries,
    }
    return json.dumps(content, indent=1) + "\n"


def _from_csv(path: Path) -> Viewpoints:
    rows = read_table(path, ("view",))
    formats = sorted({row.get("format", VAL) for row in rows})
    if len(formats) > 1:
        raise ValueError(f"{path}: format: expected one for all views, found {', '.join(formats)}")
    try:
        codec = pose_codec(formats[0] if formats else VAL)
    except ValueError as error:
        raise ValueError(f"{path}: format: {error}") from error
    columns = pose_columns(codec)
    rows = read_table(path, ("view", *columns))
    names = [row["view"] for row in rows]
    poses = np.array([numbers(path, row, columns, row["view"], False) for row in rows])
    named = [name for name in (rows[0] if rows else ()) if name.startswith("joint_")]
    joints = np.array([numbers(path, row, named, row["view"], False) for row in rows])
    return _read(path, codec, poses.reshape(-1, len(columns)), names, joints if named else None)


def _from_json(path: Path) -> Viewpoints:
    from ..schemas.imported import VIEWPOINTS
    from ..schemas.reading import checked

    content = checked(read_yaml(path), VIEWPOINTS, path)
    codec, entries = pose_codec(content.format), content.viewpoints
    if content.units != _units(codec):
        raise ValueError(f"{path}: units: expected {_units(codec)}, found {content.units}")
    if content.columns not in (None, list(codec.columns)):
        raise ValueError(
            f"{path}: columns: expected {list(codec.columns)}, found {content.columns}"
        )
    key = _key(codec)
    rows = [getattr(entry, key) for entry in entries]
    for entry, row in zip(entries, rows, strict=True):
        if row is None or len(row) != len(codec.columns):
            raise ValueError(
                f"{path}: view {entry.name}: {key}: expected {len(codec.columns)} numbers "
                f"({', '.join(codec.columns)}), as the format {codec.name} has them"
            )
    joints = [entry.joints for entry in entries if entry.joints is not None]
    if joints and {len(row) for row in joints} != {len(joints[0])}:
        raise ValueError(f"{path}: joints: expected equally many in every view")
    names = [entry.name for entry in entries]
    poses = np.array(rows).reshape(-1, len(codec.columns))
    return _read(path, codec, poses, names, np.array(joints) if joints else None)


def _read(
    path: Path,
    codec: PoseCodec,
    rows: np.ndarray,
    names: Sequence[str],
    joints: np.ndarray | None,
) -> Viewpoints:
    if not names:
        raise ValueError(f"{path}: no viewpoints")
    try:
        poses = codec.decode(rows, *codec.units, labels=names)
        return _checked(poses, names, joints)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
