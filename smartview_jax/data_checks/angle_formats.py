"""Describe a rotation by three numbers in the formats of robot makers, and by the other triple.

Two triples of angles (or two rotation vectors) describe the same rotation; a controller reports one
of them.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..geometry import EULER_CONVENTIONS, VAL_M0

Rotations = Float[np.ndarray, "views 3 3"]
"""Rotation matrices, one per view."""


class RotationFormat(NamedTuple):
    """A format that describes a rotation by three numbers.

    Attributes:
        name: of the pose format.
        description: its name, with the names of equal formats.
        from_matrices: function from rotation matrices to numbers, `(views, 3)`, rad.
        to_matrices: its inverse.
        second_angle_range: range of the second angle as controllers report it, rad; None for a
            vector.
    """

    name: str
    description: str
    from_matrices: Callable[[Rotations], np.ndarray]
    to_matrices: Callable[[np.ndarray], Rotations]
    second_angle_range: tuple[float, float] | None


def _euler_format(name: str, description: str, convention: str) -> RotationFormat:
    """Return a format of angles in one of `EULER_CONVENTIONS`."""
    euler = EULER_CONVENTIONS[convention]
    same_outer_axes = euler.axes[0] == euler.axes[2]
    return RotationFormat(
        name,
        description,
        euler.from_matrices,
        euler.to_matrices,
        (0.0, np.pi) if same_outer_axes else (-0.5 * np.pi, 0.5 * np.pi),
    )


_VAL_ANGLE_SIGNS = np.array([1.0, 1.0, -1.0])
"""Signs of O, A, T in the Euler angles of `R M0^T`, with `R = Rz(O) Rx(A) M0 Rz(T)` (Eq. 18).

Since `M0 Rz(T) = Ry(-T) M0`, also `R M0^T = Rz(O) Rx(A) Ry(-T)`: Euler angles with one sign
reversed.
"""

_ZXY = EULER_CONVENTIONS["euler_ZXY_moving"]

KUKA = _euler_format("kuka_abc", "kuka_abc (yaw_pitch_roll)", "euler_ZYX_moving")
"""KUKA's angles, the yaw, pitch, roll of Eq. 16."""

FANUC = _euler_format("fanuc_wpr", "fanuc_wpr", "euler_XYZ_fixed")
"""Fanuc's angles: KUKA's in reverse order."""

FORMATS = (
    KUKA,
    FANUC,
    _euler_format("kawasaki_oat", "kawasaki_oat", "euler_ZYZ_moving"),
    RotationFormat(
        "val_oat",
        "val_oat",
        lambda R: _VAL_ANGLE_SIGNS * _ZXY.from_matrices(R @ VAL_M0.T),
        lambda x: _ZXY.to_matrices(_VAL_ANGLE_SIGNS * x) @ VAL_M0,
        (-0.5 * np.pi, 0.5 * np.pi),
    ),
    RotationFormat(
        "ur",
        "ur (rotation_vector)",
        lambda R: Rotation.from_matrix(R).as_rotvec(),
        lambda x: Rotation.from_rotvec(x).as_matrix(),
        None,
    ),
    _euler_format("staubli_val3", "staubli_val3", "euler_XYZ_moving"),
)
"""The formats in which poses are read; other makers have the conventions of one of these."""

UNUSUAL_FORMATS = tuple(
    _euler_format(name, name, name)
    for name in EULER_CONVENTIONS
    if name not in ("euler_ZYX_moving", "euler_XYZ_fixed", "euler_ZYZ_moving", "euler_XYZ_moving")
)
"""The other conventions of three angles, in which a file may be written without its reader's
knowledge."""


def numbers_in_true_range(
    rotations: Rotations,
    read_format: RotationFormat,
    true_format: RotationFormat,
    prefer_alternative: bool,
) -> np.ndarray:
    """Return the numbers that were read, in the form that the true format produces.

    Two triples of numbers describe the same rotation in the format `read_format`; the one within
    the ranges of the format `true_format` is returned. If both or neither are, the principal one is
    returned, or the other one with `prefer_alternative`.
    """
    principal = read_format.from_matrices(rotations)
    if read_format.second_angle_range is None:
        length = np.maximum(np.linalg.norm(principal, axis=1, keepdims=True), 1e-12)
        # A rotation by |v| about v is also one by |v| - 2 pi.
        alternative = principal * (1.0 - 2.0 * np.pi / length)
    else:
        # Euler angles (a, b, c) describe the same rotation as (a + pi, pi - b, c + pi), and with
        # equal outer axes (ZYZ) the same as (a + pi, -b, c + pi).
        second_angle = (
            -principal[:, 1]
            if read_format.second_angle_range[0] == 0.0
            else np.pi - principal[:, 1]
        )
        alternative = np.stack(
            [principal[:, 0] + np.pi, second_angle, principal[:, 2] + np.pi], axis=1
        )
        alternative = (alternative + np.pi) % (2.0 * np.pi) - np.pi
    if prefer_alternative:
        principal, alternative = alternative, principal
    return np.where(
        _is_in_range(principal, true_format) | ~_is_in_range(alternative, true_format),
        principal,
        alternative,
    )


def _is_in_range(numbers: np.ndarray, true_format: RotationFormat) -> np.ndarray:
    """Return whether a controller with this format would report these numbers, `(views, 1)`."""
    if true_format.second_angle_range is None:
        return np.linalg.norm(numbers, axis=1, keepdims=True) <= np.pi + 1e-9
    low, high = true_format.second_angle_range
    return ((numbers[:, 1:2] >= low - 1e-9) & (numbers[:, 1:2] <= high + 1e-9)) & (
        np.abs(numbers).max(axis=1, keepdims=True) <= np.pi + 1e-9
    )
