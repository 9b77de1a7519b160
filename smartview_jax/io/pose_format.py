"""Find the format and the units of a table of poses, from its header or from a description.

Tables that `smartview viewpoint --out` writes name both in the header, as in

    view,format,x_mm,y_mm,z_mm,a_deg,b_deg,c_deg

so that `poses: {file: views.csv}` suffices. Any other table has the columns of its codec without
units, and the description states codec, units and direction.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..argument_checks import errors_at
from ..geometry import (
    ANGLE_UNITS,
    LENGTH_UNITS,
    POSE_CODECS,
    PoseCodec,
    as_se3,
    host_matrices,
    pose_codec,
)

FORMAT_COLUMN = "format"
"""The column that names the pose format, the same in every row."""

COMMANDED_DIRECTION = "base_from_tool"
"""The direction of poses in a file of commands."""

_STATED = ("codec", "length_unit", "angle_unit", "direction")


class PoseFormat(NamedTuple):
    """A pose format and the units of a table.

    Attributes:
        length_unit: a key of `LENGTH_UNITS`.
        angle_unit: a key of `ANGLE_UNITS`.
        columns: names of the table's columns, in the codec's order.
        direction: `"base_from_tool"`, or `"tool_from_base"` for inverse poses.
    """

    codec: PoseCodec
    length_unit: str
    angle_unit: str
    columns: tuple[str, ...]
    direction: str = COMMANDED_DIRECTION

    @property
    def units(self) -> tuple[str, str]:
        """The units of length and of angle."""
        return self.length_unit, self.angle_unit


def pose_columns(codec: PoseCodec, units: tuple[str, str] | None = None) -> tuple[str, ...]:
    """Return the names of a pose format's columns with units, by default the manufacturer's."""
    length, angle = units or codec.units
    # Numbers without a unit, such as a quaternion's, keep their bare names.
    return tuple(
        f"{name}_{length}".lower()
        if k in codec.length_columns
        else f"{name}_{angle}".lower()
        if k in codec.angle_columns
        else name
        for k, name in enumerate(codec.columns)
    )


def codec_of_rows(path: Path, rows: Sequence[Mapping[str, str]]) -> PoseCodec | None:
    """Return the codec that the column `format` names, or None where there is no such column."""
    names = sorted({row[FORMAT_COLUMN] for row in rows if FORMAT_COLUMN in row})
    if len(names) > 1:
        raise ValueError(f"{path}: format: expected one for all views, found {', '.join(names)}")
    with errors_at(f"{path}: format"):
        return pose_codec(names[0]) if names else None


def table_format(
    path: Path,
    rows: Sequence[Mapping[str, str]],
    stated: Mapping[str, Any],
    entry: str = "poses",
) -> PoseFormat:
    """Return the format of a table, from its header and from a description's entry.

    The entry may lack `codec`, `length_unit`, `angle_unit` or `direction` if the header has them.
    """
    # The column `format` decides first, then the units in the header, then the description.
    named = codec_of_rows(path, rows)
    fitting = header_formats(tuple(rows[0]), named)
    if not fitting:
        return _stated_format(path, stated, entry)
    if named is None:
        # Without a column `format` the table may hold inverse poses.
        direction = stated.get("direction") or COMMANDED_DIRECTION
        fitting = [form._replace(direction=direction) for form in fitting]
    agreeing = [form for form in fitting if _contradiction(form, stated) is None]
    if not agreeing:
        raise ValueError(f"{path}: {_contradiction(fitting[0], stated)}")
    # VAL and Kawasaki both call their angles O, A, T, but with different conventions.
    if any(_decode_differently(agreeing[0], other) for other in agreeing[1:]):
        raise ValueError(
            f"{path}: the columns {', '.join(agreeing[0].columns)} fit "
            f"{' and '.join(form.codec.name for form in agreeing)}: add a column "
            f"'{FORMAT_COLUMN}', or state {entry}.codec in the description"
        )
    return agreeing[0]


def header_formats(header: Sequence[str], named: PoseCodec | None = None) -> list[PoseFormat]:
    """Return the formats, or the named one, whose columns with their units are all in a header."""
    formats: dict[tuple[str, tuple[str, ...]], PoseFormat] = {}
    for codec in POSE_CODECS.values() if named is None else (named,):
        for length in LENGTH_UNITS:
            for angle in ANGLE_UNITS:
                columns = pose_columns(codec, (length, angle))
                if set(columns) <= set(header):
                    # A format without angles fits with either unit of angle.
                    form = PoseFormat(codec, length, angle, columns)
                    formats.setdefault((codec.name, columns), form)
    return list(formats.values())


def stated_format(read_format: PoseFormat, stated: Mapping[str, Any], path: Path) -> PoseFormat:
    """Return the format of a file that states it; raise if a description contradicts it."""
    problem = _contradiction(read_format, stated)
    if problem is not None:
        raise ValueError(f"{path}: {problem}")
    return read_format


def decoded_poses(
    path: Path, form: PoseFormat, rows: Float[np.ndarray, "poses columns"], labels: Sequence[str]
) -> SE3:
    """Return `base_from_tool` of the rows of a table, which may hold inverse poses."""
    with errors_at(path):
        poses = form.codec.decode(rows, *form.units, labels=labels)
    if form.direction != COMMANDED_DIRECTION:
        poses = as_se3(np.linalg.inv(host_matrices(poses)))
    return poses


def _decode_differently(first: PoseFormat, second: PoseFormat) -> bool:
    """Return whether the same numbers in a table are different poses in two formats."""
    if not (first.codec.angle_columns and second.codec.angle_columns):
        return True
    # Arbitrary numbers at which no two conventions coincide.
    numbers = {name: 0.1 * k for k, name in enumerate(sorted(first.columns), start=1)}
    poses = [
        host_matrices(
            form.codec.decode(np.array([[numbers[c] for c in form.columns]]), *form.units)
        )
        for form in (first, second)
    ]
    return not np.allclose(*poses, rtol=0.0, atol=1e-9)


def _contradiction(read_format: PoseFormat, stated: Mapping[str, Any]) -> str | None:
    """Return the contradiction between a description and a file's own format, or None."""
    values = (
        read_format.codec.name,
        read_format.length_unit,
        read_format.angle_unit,
        read_format.direction,
    )
    for key, value in zip(_STATED, values, strict=True):
        # The unit of angle is irrelevant to quaternions.
        if key == "angle_unit" and not read_format.codec.angle_columns:
            continue
        if stated.get(key) not in (None, value):
            return f"{key} is {value} in the file but {stated[key]} in the description"
    return None


def _stated_format(path: Path, stated: Mapping[str, Any], entry: str) -> PoseFormat:
    """Return the format that a description states without help of the header."""
    missing = [key for key in _STATED if stated.get(key) is None]
    if missing:
        raise ValueError(
            f"entry {' and '.join(repr(f'{entry}.{key}') for key in missing)} is missing, and the "
            f"header of {path} does not state it; a table that needs no entry has columns such as "
            f"view,{FORMAT_COLUMN},{','.join(pose_columns(pose_codec('kuka_abc')))}"
        )
    # The columns have the codec's own names here, without units.
    codec = pose_codec(stated["codec"])
    return PoseFormat(
        codec, stated["length_unit"], stated["angle_unit"], codec.columns, stated["direction"]
    )
