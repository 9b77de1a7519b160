"""Define the file entries of an arm's Denavit-Hartenberg parameters and of rigid transforms."""

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from .entry import (
    Angle,
    Coordinate,
    Entry,
    Expected,
    FiniteNumber,
    Flag,
    Translation,
    UnitQuaternion,
)

_JointCount = Field(min_length=1, max_length=20)
_Lengths = Annotated[
    list[Coordinate], _JointCount, Expected("a length in m for each of 1 to 20 joints")
]
_Angles = Annotated[
    list[Angle], _JointCount, Expected("an angle in rad for each of 1 to 20 joints")
]
_JointLimits = Annotated[
    list[FiniteNumber | None],
    Field(min_length=2, max_length=2),
    Expected("the smallest and the largest reading of a joint, rad or m, or null"),
]


class TransformEntry(Entry):
    """A rigid transform: metres, and a unit quaternion with its real part first."""

    translation: Translation
    quaternion_wxyz: UnitQuaternion

    @model_validator(mode="after")
    def _check_unit_quaternion(self) -> "TransformEntry":
        # A unit quaternion has w^2 + x^2 + y^2 + z^2 = 1; the tolerance allows for rounded digits.
        length = math.hypot(*self.quaternion_wxyz)
        if abs(length - 1.0) > 1e-6:
            raise ValueError(f"quaternion_wxyz: expected length 1, found {length:.8g}")
        return self


class ArmEntry(Entry):
    """A serial arm, one number per joint in every row; see `robots.SerialArm`."""

    convention: Literal["standard", "modified"]
    theta: _Angles
    d: _Lengths
    a: _Lengths
    alpha: _Angles
    prismatic: list[Flag] | None = None
    limits: list[_JointLimits] | None = None
    flange_from_tool: TransformEntry | None = None
    base_from_first: TransformEntry | None = None

    @model_validator(mode="after")
    def _check_row_lengths(self) -> "ArmEntry":
        # Without `prismatic` or `limits` no joint is prismatic, or has limits.
        names = ("theta", "d", "a", "alpha", "prismatic", "limits")
        sizes = {name: len(row) for name in names if (row := getattr(self, name)) is not None}
        if len(set(sizes.values())) > 1:
            raise ValueError(f"expected a number for each joint in every row, found {sizes}")
        return self
