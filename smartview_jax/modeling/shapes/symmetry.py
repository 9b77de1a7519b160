"""Find the rotations that map an object model onto itself.

A symmetric object has several poses that no picture can distinguish, and several equivalent
grasps. The group is computed from the geometry; whether it is intended, for example despite a label
on one side, is for a person to confirm.
"""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from ...geometry import host_nearest_rotation

if TYPE_CHECKING:
    from .object_model import ObjectModel

SYMMETRY_TOLERANCE = 1e-3
"""Largest distance between a rotated vertex and the one it meets, over the object's extent."""

AXIS_ORDER = 16
"""Smallest number of equal turns about an axis that counts as a surface of revolution.

A mesh represents a cylinder as a prism; no object made of few flat faces has so many turns.
"""


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

    def is_along(self, direction: Float[np.ndarray, "3"]) -> bool:
        """Return whether a unit vector is along this axis, either way."""
        return bool(np.linalg.norm(np.cross(self.direction, direction)) < _SAME_DIRECTION)


@dataclasses.dataclass(frozen=True, eq=False)
class Symmetry:
    """The rotations that map an object onto itself.

    Attributes:
        rotations: a finite group, with the identity first; rotation matrices in the object's frame.
        centre: the common fixed point, in the object's frame, m.
        axis: unit vector of the axis of a surface of revolution, about which every rotation maps
            the object onto itself; None if there is no such axis.
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
        vectors = Rotation.from_matrix(self.rotations).as_rotvec()
        angles = np.linalg.norm(vectors, axis=1)
        axes: list[SymmetryAxis] = []
        for vector, angle in zip(vectors, angles, strict=True):
            direction = vector / max(angle, 1e-30)
            # The identity has no axis, and each axis has several turns.
            if angle < _SAME_DIRECTION or any(axis.is_along(direction) for axis in axes):
                continue
            about = np.linalg.norm(np.cross(vectors, direction), axis=1) < _SAME_DIRECTION
            # An axis has two unit vectors; take the one with a positive last non-zero component.
            sign = np.sign(direction[np.flatnonzero(np.abs(direction) > 1e-6)[-1]])
            # Including the identity, which is a turn about any axis.
            axes.append(SymmetryAxis(sign * direction, int(about.sum())))
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
        transforms = np.tile(np.eye(4), (self.order, 1, 1))
        transforms[:, :3, :3] = self.rotations
        transforms[:, :3, 3] = self.centre - self.rotations @ self.centre
        return transforms


def find_symmetry(model: "ObjectModel", tolerance: float | None = None) -> Symmetry:
    """Return the symmetry group of a model's vertices, edges and faces.

    Args:
        model: with at least three vertices that are not on one line.
        tolerance: largest distance between a rotated vertex and the one it meets, m; by default
            `SYMMETRY_TOLERANCE` of the extent, or three times the vertices' standard deviation.

    Raises:
        ValueError: the vertices are on one line, about which every rotation would be a symmetry.
    """
    points = model.vertices
    if tolerance is None:
        sigma = 0.0 if model.vertex_sigma is None else float(np.median(model.vertex_sigma))
        tolerance = max(SYMMETRY_TOLERANCE * float(np.ptp(points, axis=0).max()), 3.0 * sigma)
    centre = points.mean(axis=0)
    centred = points - centre
    # The second singular value measures the extent across the longest direction.
    singular_values = np.linalg.svd(centred, compute_uv=False)
    if len(points) < 3 or singular_values[1] < tolerance:
        raise ValueError("the symmetry of vertices on one line is not finite; add more vertices")
    tree = KDTree(centred)
    accepted: list[np.ndarray] = [np.eye(3)]
    for rotation in _candidate_rotations(centred, tolerance):
        distances, nearest = tree.query(centred @ rotation.T)
        targets = np.asarray(nearest, int)
        # A rotation is new if it moves some vertex elsewhere than every accepted one.
        known = any(np.abs(centred @ (rotation - other).T).max() < tolerance for other in accepted)
        if not known and np.max(distances) <= tolerance and _keeps_structure(model, targets):
            # Fitted to all vertices, which is more accurate than from the two vertices.
            accepted.append(_aligning_rotation(centred, centred[targets]))
    rotations = np.stack(accepted)
    return Symmetry(rotations, centre, _revolution_axis(rotations))


def _candidate_rotations(
    centred: Float[np.ndarray, "V 3"], tolerance: float
) -> list[Float[np.ndarray, "3 3"]]:
    """Return the rotations that move a pair of vertices to another pair of the same shape."""
    # Two vertices that are not on one line with the centre determine a rotation.
    radii = np.linalg.norm(centred, axis=1)
    # The farthest vertex, and the one that spans the largest triangle with it and the centre,
    # determine the rotation most accurately.
    first = int(np.argmax(radii))
    areas = np.linalg.norm(np.cross(centred[first], centred), axis=1)
    second = int(np.argmax(areas))
    distance = np.linalg.norm(centred[first] - centred[second])
    candidates = []
    for a in np.flatnonzero(np.abs(radii - radii[first]) <= 2.0 * tolerance):
        apart = np.linalg.norm(centred - centred[a], axis=1)
        fits = (np.abs(apart - distance) <= 2.0 * tolerance) & (
            np.abs(radii - radii[second]) <= 2.0 * tolerance
        )
        for b in np.flatnonzero(fits):
            candidates.append(_aligning_rotation(centred[[first, second]], centred[[a, b]]))
    return candidates


def _aligning_rotation(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "3 3"]:
    """Return the rotation that best aligns points with others (Kabsch)."""
    # sum |R s - t|^2 is smallest for the rotation nearest to T^T S.
    return host_nearest_rotation(target.T @ source)


def _keeps_structure(model: "ObjectModel", targets: Int[np.ndarray, "V"]) -> bool:
    """Return whether a permutation of the vertices maps edges to edges and faces to faces."""
    # With a large tolerance two vertices may meet the same one.
    if len(set(targets.tolist())) != len(targets):
        return False
    edges = {frozenset(edge) for edge in model.edges.tolist()}
    moved_edges = {frozenset(edge) for edge in targets[model.edges].tolist()}
    faces = {frozenset(face.indices) for face in model.faces}
    moved_faces = {frozenset(targets[face.indices].tolist()) for face in model.faces}
    return edges == moved_edges and faces == moved_faces


def _revolution_axis(rotations: Float[np.ndarray, "K 3 3"]) -> Float[np.ndarray, "3"] | None:
    """Return the axis with at least `AXIS_ORDER` turns, or None."""
    vectors = Rotation.from_matrix(rotations).as_rotvec()
    angles = np.linalg.norm(vectors, axis=1)
    for vector, angle in zip(vectors, angles, strict=True):
        if angle < 1e-6:
            continue
        axis = vector / angle
        turns = np.linalg.norm(np.cross(vectors, axis), axis=1) < 1e-3
        if turns.sum() >= AXIS_ORDER:
            return axis
    return None


def _coordinates(direction: Float[np.ndarray, "3"]) -> str:
    """Return a direction with few digits, without negative zeros."""
    return "(" + ", ".join(f"{x:g}" for x in direction.round(2) + 0.0) + ")"
