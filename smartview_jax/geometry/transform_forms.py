"""Write a rigid transform: for people, in the forms of other programs, and as plain numbers."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..export_text import roll_pitch_yaw
from ..runtime.array_namespace import to_device
from .host import host_logarithms, host_transforms
from .pose_codecs import pose_codec

DECIMALS = 9
"""Digits after the point: a nanometre, less than any calibration is known to."""

_SHOWN = ("matrix", "quaternion_xyzw", "quaternion_wxyz")
"""Pose formats that repeat a form that is written for every robot."""


class TransformForm(NamedTuple):
    """A transform in one form.

    Attributes:
        label: name of the form, with the order of its numbers and their units.
        text: the numbers; a matrix has one line for each row.
    """

    label: str
    text: str


def transform_forms(
    matrix: Float[np.ndarray, "4 4"], pose_format: str | None = None
) -> list[TransformForm]:
    """Return a transform as matrix, quaternion, ROS's angles, and in the robot's own format.

    Args:
        matrix: the transform, m.
        pose_format: the robot's format, a key of `POSE_CODECS`; None if it is not known.
    """
    transform = host_transforms(matrix)
    w, x, y, z = np.asarray(transform.wxyz_xyz)[:4]
    forms = [
        TransformForm("matrix, m", _matrix_text(matrix)),
        TransformForm("translation x, y, z, m", _numbers_text(matrix[:3, 3])),
        TransformForm("quaternion x, y, z, w", _numbers_text([x, y, z, w])),
        TransformForm(
            "roll, pitch, yaw of ROS and URDF (fixed axes x, y, z), rad",
            _numbers_text(roll_pitch_yaw(matrix[:3, :3])),
        ),
    ]
    if pose_format is not None and pose_format not in _SHOWN:
        codec = pose_codec(pose_format)
        length, angle = codec.units
        units = dict.fromkeys(codec.length_columns, length)
        units |= dict.fromkeys(codec.angle_columns, angle)
        names = [f"{name} {units.get(k, '')}".strip() for k, name in enumerate(codec.columns)]
        numbers = codec.encode(transform, *codec.units)
        forms.append(TransformForm(f"{pose_format}: {', '.join(names)}", _numbers_text(numbers)))
    return forms


def _numbers_text(numbers: "np.ndarray | list[float] | tuple[float, ...]") -> str:
    """Return numbers as all vectors are printed."""
    # Adding zero to a rounded number makes a negative zero positive.
    return vector_text([round(float(number), DECIMALS) + 0.0 for number in numbers], DECIMALS)


def _matrix_text(matrix: Float[np.ndarray, "4 4"]) -> str:
    """Return a matrix with one row on each line, as Python, JSON and YAML read it."""
    width = DECIMALS + 3
    rows = [
        ", ".join(f"{round(float(x), DECIMALS) + 0.0:{width}.{DECIMALS}f}" for x in row)
        for row in matrix
    ]
    return "[" + ",\n ".join(f"[{row}]" for row in rows) + "]"


def transform_text(matrix: Float[np.ndarray, "4 4"]) -> str:
    """Return the translation (mm) and the rotation vector (degrees) of a transform."""
    translation = vector_text(1e3 * matrix[:3, 3], 2)
    rotation = vector_text(np.rad2deg(host_logarithms(matrix)[3:]), 3)
    return f"{translation} mm, rotated by {rotation} deg"


def vector_text(numbers: Iterable[float], decimals: int) -> str:
    """Return a vector as `(x, y, z)`, the form of all vectors that are printed.

    Args:
        numbers: its components.
        decimals: digits after the point.
    """
    return f"({', '.join(f'{number:.{decimals}f}' for number in numbers)})"


def transform_to_dict(transform: SE3) -> dict[str, list[float]]:
    """Return the translation (m) and the unit quaternion (real part first) of a transform."""
    numbers = np.asarray(transform.wxyz_xyz).tolist()
    return {"translation": numbers[4:], "quaternion_wxyz": numbers[:4]}


def transform_from_dict(name: str, content: dict[str, Any]) -> SE3:
    """Return the transform that a mapping describes, the inverse of `transform_to_dict`.

    Args:
        name: name of the transform, for messages.
        content: `translation` and `quaternion_wxyz`.

    Raises:
        ValueError: not a rigid transform; the message has the transform's name.
        KeyError: an entry is missing.
    """
    translation = np.asarray(content["translation"], dtype=float)
    quaternion = np.asarray(content["quaternion_wxyz"], dtype=float)
    if translation.shape != (3,) or quaternion.shape != (4,):
        raise ValueError(f"{name}: expected 3 and 4 numbers")
    if not (np.isfinite(translation).all() and abs(np.linalg.norm(quaternion) - 1.0) < 1e-6):
        raise ValueError(f"{name}: not a finite translation and a unit quaternion")
    return SE3(to_device(np.concatenate([quaternion, translation])))
