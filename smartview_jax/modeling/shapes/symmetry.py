"""Hold the rotations that map an object onto itself, and name them.

A symmetric object has several poses that no picture can distinguish, and several equivalent
grasps. The group is computed from the geometry; whether it is intended, for example despite a label
on one side, is for a person to confirm.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from ...geometry import host_poses

_SAME_DIRECTION = 1e-3
"""Angle of a turn, or between two axes, below which it counts as zero, rad."""


@dataclasses.dataclass(frozen=True, eq=False)
class SymmetryAxis:
    """An axis about which equal turns map an object onto itself.

    Attributes:
        direction: unit vector in the object's frame.
        fold: number of turns about it, with the identity: 4 are quarter turns.
    """

    direction: Float[np.ndarray, "3"]
    fold: int


@dataclasses.dataclass(frozen=True, eq=False)
class Symmetry:
    """The rotations that map an object onto itself.

    Attributes:
        rotations: a finite group, with the identity first; rotation matrices in the object's frame.
        centre: the common fixed point, in the object's frame, m.
        axis: unit vector of the axis of a surface of revolution, about which every rotation maps
            the object onto itself; None if there is no such axis.
        confirmed: whether a person has confirmed it.
    """

    rotations: Float[np.ndarray, "K 3 3"]
    centre: Float[np.ndarray, "3"]
    axis: Float[np.ndarray, "3"] | None = None
    confirmed: bool = False

    @property
    def order(self) -> int:
        """The number of rotations, with the identity."""
        return len(self.rotations)

    @property
    def axes(self) -> tuple["SymmetryAxis", ...]:
        """The axes of the turns, those with the most turns first."""
        from scipy.spatial.transform import Rotation

        vectors = Rotation.from_matrix(self.rotations).as_rotvec()
        angles = np.linalg.norm(vectors, axis=1)
        axes: list[SymmetryAxis] = []
        # The identity has no axis, and each axis has several turns.
        remaining = angles >= _SAME_DIRECTION
        while remaining.any():
            first = int(np.argmax(remaining))
            direction = vectors[first] / angles[first]
            across = np.linalg.norm(np.cross(vectors, direction), axis=1)
            remaining &= across >= _SAME_DIRECTION * angles
            # An axis has two unit vectors; take the one with a positive last non-zero component.
            sign = np.sign(direction[np.flatnonzero(np.abs(direction) > 1e-6)[-1]])
            # Including the identity, which is a turn about any axis.
            axes.append(SymmetryAxis(sign * direction, int((across < _SAME_DIRECTION).sum())))
        return tuple(sorted(axes, key=lambda axis: -axis.fold))

    @property
    def words(self) -> str:
        """The turns in words, such as "4-fold about (0, 0, 1); 2-fold about 4 axes"."""
        if self.axis is not None:
            return f"round about {_coordinates(self.axis)}"
        folds = [axis.fold for axis in self.axes]
        parts = []
        for fold in dict.fromkeys(folds):
            same = [axis for axis in self.axes if axis.fold == fold]
            # A single axis is named; several are counted.
            where = _coordinates(same[0].direction) if len(same) == 1 else f"{len(same)} axes"
            parts.append(f"{fold}-fold about {where}")
        return "; ".join(parts) or "no turn maps it onto itself"

    @property
    def object_from_object(self) -> Float[np.ndarray, "K 4 4"]:
        """The rotations about the centre as 4x4 transforms of the object's frame."""
        # x -> R (x - c) + c
        return host_poses(self.rotations, self.centre - self.rotations @ self.centre)


def _coordinates(direction: Float[np.ndarray, "3"]) -> str:
    """Return a direction with few digits, without negative zeros."""
    return "(" + ", ".join(f"{x:g}" for x in direction.round(2) + 0.0) + ")"
