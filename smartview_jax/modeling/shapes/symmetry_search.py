"""Find the rotations that map an object onto itself, whatever polygons stand for its round parts.

A mesh draws a round rim as a polygon: a hexagonal nut whose hole has 32 sides is still 6-fold. So
corners must meet corners, but a vertex of a rim only has to meet the rim, as near as its chords
are to the circle.
"""

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ...geometry import host_nearest_rotation
from .faces import SHARP_ANGLE, Face, face_plane
from .object_model import ObjectModel
from .symmetry import Symmetry

if TYPE_CHECKING:
    from scipy.spatial import KDTree

SYMMETRY_TOLERANCE = 1e-3
"""Largest distance between a rotated vertex and the one it meets, over the object's extent."""

AXIS_ORDER = 16
"""Smallest number of equal turns about an axis that counts as a surface of revolution.

A mesh represents a cylinder as a prism; no object made of few flat faces has so many turns.
"""

TESTED_EDGES = 8
"""Number of rim vertices nearest to a point whose edges are tested for passing through it.

The nearest vertex is an end of that edge, unless another rim is nearer than half a chord.
"""

TESTED_FIRST = 16
"""Number of vertices, spread over all, with which most rotations are rejected.

It changes the time alone, not the result.
"""

TESTED_AT_ONCE = 1024
"""Number of rotations that are tested at once with a few points of rims."""

MEASURED_AT_ONCE = 2**20
"""Number of distances between vertices that are computed at once."""


def find_symmetry(model: ObjectModel, tolerance: float | None = None) -> Symmetry:
    """Return the symmetry group of a model: of its corners, edges, faces and round rims.

    Vertices on smooth surfaces, at which no edge of the wireframe ends, do not count.

    Args:
        model: with at least three vertices that are not on one line.
        tolerance: largest distance between a rotated vertex and the one it meets, m; by default
            `SYMMETRY_TOLERANCE` of the extent, or three times the vertices' standard deviation.

    Raises:
        ValueError: the vertices are on one line, about which every rotation would be a symmetry.
    """
    if tolerance is None:
        sigma = 0.0 if model.vertex_sigma is None else float(np.median(model.vertex_sigma))
        tolerance = max(SYMMETRY_TOLERANCE * model.extent, 3.0 * sigma)
    outline = _Outline.of(model, tolerance)
    points = outline.corners if outline.corners_span else outline.rims.points
    pair = _widest_pair(points)
    candidates = _candidate_rotations(points, pair, tolerance)
    candidates = candidates[outline.may_be_mapped(candidates, tolerance)]
    # The identity comes first.
    accepted = np.zeros((len(candidates) + 1, 3, 3))
    accepted[0], count = np.eye(3), 1
    for rotation in candidates:
        # A rotation is new if it moves one of the pair elsewhere than every accepted one.
        moved = (accepted[:count] - rotation) @ points[pair].T
        if (np.abs(moved).max(axis=(1, 2)) < tolerance).any():
            continue
        fitted = outline.symmetry_near(rotation, tolerance)
        if fitted is not None:
            accepted[count] = fitted
            count += 1
    symmetry = Symmetry(accepted[:count].copy(), outline.centre)
    axes = symmetry.axes
    is_round = bool(axes) and axes[0].fold >= AXIS_ORDER
    return dataclasses.replace(symmetry, axis=axes[0].direction) if is_round else symmetry


def shape_sigma(model: ObjectModel) -> float:
    """Return the standard deviation of an object's edges from its model, m.

    It combines the model's tolerance with the deviation of its vertices from the symmetry that it
    states: a symmetric object does not have them exactly where the model has. Errors of measured
    vertices are in their covariance, and do not count here.
    """
    from scipy.spatial import KDTree

    symmetry = model.symmetry
    if symmetry is None or symmetry.order == 1 or not model.is_exact:
        return model.tolerance
    corners = model.vertices[_are_corners(model, list(rim_vertices(model)))] - symmetry.centre
    if not len(corners):
        return model.tolerance
    gaps, _ = KDTree(corners).query(corners @ symmetry.rotations[1:].swapaxes(1, 2))
    # A gap is the difference of two vertices, each with errors along three axes.
    return float(np.sqrt(model.tolerance**2 + np.square(gaps).mean() / 6.0))


class _Rims(NamedTuple):
    """The vertices of a model's round rims, each between two edges that hardly bend.

    Attributes:
        points: positions, m, from the centre.
        neighbours: the other ends of the two edges, m, from the centre.
        sagitta: largest distance between an edge and the arc that it stands for, m.
        tree: for the nearest of the points; None without any.
    """

    points: Float[np.ndarray, "R 3"]
    neighbours: Float[np.ndarray, "R 2 3"]
    sagitta: Float[np.ndarray, "R"]
    tree: "KDTree | None"

    def are_met_by(
        self, moved: Float[np.ndarray, "n 3"], tolerance: float
    ) -> Bool[np.ndarray, "n"]:
        """Return which points are on a rim, up to the sagitta of its edge."""
        if self.tree is None:
            return np.zeros(len(moved), bool)
        near = self.tree.query(moved, min(TESTED_EDGES, len(self.points)))[1]
        near = np.reshape(near, (len(moved), -1))
        start = self.points[near][:, :, None]
        along = self.neighbours[near] - start
        offset = moved[:, None, None] - start
        place = np.sum(offset * along, axis=-1) / np.sum(along**2, axis=-1)
        foot = np.clip(place, 0.0, 1.0)[..., None] * along
        distance = np.linalg.norm(offset - foot, axis=-1).min(axis=2)
        return (distance <= tolerance + self.sagitta[near]).any(axis=1)


class _Outline(NamedTuple):
    """The parts of a model that a symmetry maps onto itself, with positions from the centre.

    Attributes:
        centre: the fixed point of all symmetries, m.
        corners: vertices that must meet each other, m.
        tree: for the nearest corner of a point; None without corners.
        corners_span: whether they determine a rotation.
        rims: the round edges.
        edges: pairs of corners that an edge joins.
        faces: flat faces whose whole border is in the wireframe.
    """

    centre: Float[np.ndarray, "3"]
    corners: Float[np.ndarray, "C 3"]
    tree: "KDTree | None"
    corners_span: bool
    rims: _Rims
    edges: frozenset[frozenset[int]]
    faces: tuple["_FlatFace", ...]

    @classmethod
    def of(cls, model: ObjectModel, tolerance: float) -> "_Outline":
        """Return the outline of a model."""
        from scipy.spatial import KDTree

        rims = rim_vertices(model)
        is_corner = _are_corners(model, list(rims))
        corners, round_points = model.vertices[is_corner], model.vertices[list(rims)]
        neighbours = model.vertices[np.array(list(rims.values()), int).reshape(-1, 2)]
        before, after = np.moveaxis(neighbours - round_points[:, None], 1, 0)
        lengths = np.linalg.norm(before, axis=1) + np.linalg.norm(after, axis=1)
        centre, corners_span = _mean(corners), _span(corners, tolerance)
        if not corners_span and len(rims):
            # Of the rims themselves: the number of their vertices depends on the mesh.
            centre = lengths @ round_points / lengths.sum()
        if not (corners_span or _span(round_points, tolerance)):
            raise ValueError(
                "the symmetry of vertices on one line is not finite; add more vertices"
            )
        # An arc with chord l that turns by b is up to l/2 tan(b/4) away from it.
        sagitta = 0.25 * lengths * np.tan(0.25 * _bends(before, after))
        number = np.cumsum(is_corner) - 1
        joined = model.edges[is_corner[model.edges].all(axis=1)]
        edges = frozenset(frozenset(pair) for pair in number[joined].tolist())
        faces = tuple(
            _FlatFace.of(model, face, centre, is_corner, number) for face in _sharp_faces(model)
        )
        round_tree, tree = (
            KDTree(points - centre) if len(points) else None for points in (round_points, corners)
        )
        rim_points = _Rims(round_points - centre, neighbours - centre, sagitta, round_tree)
        return cls(centre, corners - centre, tree, corners_span, rim_points, edges, faces)

    def may_be_mapped(
        self, rotations: Float[np.ndarray, "n 3 3"], tolerance: float
    ) -> Bool[np.ndarray, "n"]:
        """Return which rotations map a few corners and points of rims onto others."""
        possible = np.ones(len(rotations), bool)
        if self.tree is not None:
            moved = _spread(self.corners) @ rotations.swapaxes(1, 2)
            possible &= (self.tree.query(moved)[0] <= tolerance).all(axis=1)
        kept = np.flatnonzero(possible)
        # In lots, since each point is compared with both edges of its nearest points.
        for lot in np.split(kept, range(TESTED_AT_ONCE, len(kept), TESTED_AT_ONCE)):
            moved = _spread(self.rims.points) @ rotations[lot].swapaxes(1, 2)
            met = self.rims.are_met_by(moved.reshape(-1, 3), tolerance)
            possible[lot] = met.reshape(moved.shape[:2]).all(axis=1)
        return possible

    def symmetry_near(
        self, rotation: Float[np.ndarray, "3 3"], tolerance: float
    ) -> Float[np.ndarray, "3 3"] | None:
        """Return the symmetry near a rotation; None if there is none."""
        targets = np.zeros(0, int)
        if self.tree is not None:
            distances, nearest = self.tree.query(self.corners @ rotation.T)
            if np.max(distances) > tolerance:
                return None
            targets = np.asarray(nearest, int)
            # With a large tolerance two vertices may meet the same one.
            if len(set(targets.tolist())) != len(targets):
                return None
        if not self.rims.are_met_by(self.rims.points @ rotation.T, tolerance).all():
            return None
        if {frozenset(targets[list(pair)].tolist()) for pair in self.edges} != self.edges:
            return None
        slack = tolerance + self.rims.sagitta.max(initial=0.0)
        if not self.has_faces_at(rotation, targets, slack):
            return None
        # Fitted to all corners, which is more accurate than from two vertices.
        return (
            _aligning_rotation(self.corners, self.corners[targets])
            if self.corners_span
            else rotation
        )

    def has_faces_at(
        self,
        rotation: Float[np.ndarray, "3 3"],
        targets: Int[np.ndarray, "C"],
        slack: float,
    ) -> bool:
        """Return whether a rotation maps each face onto one, up to a distance."""
        by_corners: dict[frozenset[int], list[_FlatFace]] = {}
        for face in self.faces:
            by_corners.setdefault(face.corners, []).append(face)
        for face in self.faces:
            corners = frozenset(targets[list(face.corners)].tolist())
            candidates = by_corners.get(corners, [])
            if len(corners) > 2 and len(candidates) == 1:
                # Its corners say where it is, but not which side is outside.
                is_met = bool(rotation @ face.normal @ candidates[0].normal > 0.0)
            else:
                moved = face.moved(rotation, targets)
                is_met = any(moved.equals(other, slack) for other in candidates)
            if not is_met:
                return False
        return True


class _FlatFace(NamedTuple):
    """A flat face as a symmetry has to map it.

    Attributes:
        corners: numbers of the corners on its border.
        normal: outward.
        middle: of its border, m, from the centre.
        size: length of its border, m.
    """

    corners: frozenset[int]
    normal: Float[np.ndarray, "3"]
    middle: Float[np.ndarray, "3"]
    size: float

    @classmethod
    def of(
        cls,
        model: ObjectModel,
        face: Face,
        centre: Float[np.ndarray, "3"],
        is_corner: Bool[np.ndarray, "V"],
        number: Int[np.ndarray, "V"],
    ) -> "_FlatFace":
        """Return a face of a model, given which vertices are corners, and their numbers."""
        sides = model.vertices[np.array(face.directed_edges)] - centre
        lengths = np.linalg.norm(sides[:, 1] - sides[:, 0], axis=1)
        middle = lengths @ sides.mean(axis=1) / lengths.sum()
        corners = frozenset(int(number[v]) for v in face.indices if is_corner[v])
        return cls(corners, face_plane(model.vertices, face).normal, middle, float(lengths.sum()))

    def moved(
        self, rotation: Float[np.ndarray, "3 3"], targets: Int[np.ndarray, "C"]
    ) -> "_FlatFace":
        """Return the face after a rotation that maps each corner to its target."""
        return self._replace(
            corners=frozenset(targets[list(self.corners)].tolist()),
            normal=rotation @ self.normal,
            middle=rotation @ self.middle,
        )

    def equals(self, other: "_FlatFace", slack: float) -> bool:
        """Return whether two faces are the same, up to a distance."""
        return bool(
            self.corners == other.corners
            and np.linalg.norm(self.middle - other.middle) <= slack
            and np.linalg.norm(self.normal - other.normal) * self.size <= 2.0 * np.pi * slack
        )


def rim_vertices(model: ObjectModel) -> dict[int, list[int]]:
    """Return the vertices of round rims, in their order, with the two neighbours of each.

    At such a vertex exactly two edges of the wireframe meet, with a bend below `SHARP_ANGLE`.
    """
    neighbours: dict[int, list[int]] = {}
    for a, b in model.edges.tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    rims = {}
    for vertex in sorted(neighbours):
        if len(neighbours[vertex]) == 2:
            before, after = (model.vertices[k] - model.vertices[vertex] for k in neighbours[vertex])
            if _bends(before, after) < SHARP_ANGLE:
                rims[vertex] = neighbours[vertex]
    return rims


def _are_corners(model: ObjectModel, rims: list[int]) -> Bool[np.ndarray, "V"]:
    """Return which vertices a symmetry maps onto each other.

    They are neither on one of the rims nor inside a smooth or flat surface.
    """
    vertices = np.arange(len(model.vertices))
    # Without a wireframe nothing tells smooth surfaces from flat faces.
    on_edge = np.isin(vertices, model.edges) | (len(model.edges) == 0)
    is_loose = ~np.isin(vertices, [v for face in model.faces for v in face.indices])
    return ~np.isin(vertices, rims) & (on_edge | is_loose)


def _bends(
    before: Float[np.ndarray, "*n 3"], after: Float[np.ndarray, "*n 3"]
) -> Float[np.ndarray, "*n"]:
    """Return the angle, rad, by which a line turns at a point with vectors to its neighbours."""
    sine = np.linalg.norm(np.cross(before, after), axis=-1)
    return np.pi - np.arctan2(sine, np.sum(before * after, axis=-1))


def _sharp_faces(model: ObjectModel) -> list[Face]:
    """Return the faces whose whole border is in the wireframe; all of them if it has no edges."""
    edges = {frozenset(pair) for pair in model.edges.tolist()}
    return [
        face
        for face in model.faces
        if not edges or all(frozenset(side) in edges for side in face.directed_edges)
    ]


def _mean(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """Return the mean of points; the origin if there are none."""
    return points.mean(axis=0) if len(points) else np.zeros(3)


def _span(points: Float[np.ndarray, "n 3"], tolerance: float) -> bool:
    """Return whether there are three points that are not on one line."""
    # The second singular value measures the extent across the longest direction.
    values = np.linalg.svd(points - _mean(points), compute_uv=False)
    return len(points) > 2 and bool(values[1] >= tolerance)


def _spread(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "few 3"]:
    """Return a few of the points; neighbours along a rim tell hardly more than one of them."""
    return points[:: max(1, len(points) // TESTED_FIRST)][:TESTED_FIRST]


def _widest_pair(centred: Float[np.ndarray, "V 3"]) -> list[int]:
    """Return the two vertices that determine a rotation most accurately.

    They are the farthest one, and the one that spans the largest triangle with it and the centre.
    """
    first = int(np.argmax(np.linalg.norm(centred, axis=1)))
    areas = np.linalg.norm(np.cross(centred[first], centred), axis=1)
    return [first, int(np.argmax(areas))]


def _candidate_rotations(
    centred: Float[np.ndarray, "V 3"], pair: list[int], tolerance: float
) -> Float[np.ndarray, "n 3 3"]:
    """Return the rotations that move a pair of vertices to another pair of the same shape."""
    from scipy.spatial.distance import cdist

    first, second = pair
    radii = np.linalg.norm(centred, axis=1)
    distance = np.linalg.norm(centred[first] - centred[second])
    starts = np.flatnonzero(np.abs(radii - radii[first]) <= 2.0 * tolerance)
    ends = np.flatnonzero(np.abs(radii - radii[second]) <= 2.0 * tolerance)
    pairs = []
    # In lots: the rims of a fine mesh have thousands of vertices, and their pairs are millions.
    for lot in np.array_split(starts, 1 + len(starts) * len(ends) // MEASURED_AT_ONCE):
        apart = cdist(centred[lot], centred[ends])
        a, b = np.nonzero(np.abs(apart - distance) <= 2.0 * tolerance)
        pairs.append(np.column_stack([lot[a], ends[b]]))
    return _aligning_rotation(centred[pair], centred[np.concatenate(pairs)])


def _aligning_rotation(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "*batch n 3"]
) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the rotation that best aligns points with others (Kabsch)."""
    # sum |R s - t|^2 is smallest for the rotation nearest to T^T S.
    return host_nearest_rotation(target.swapaxes(-1, -2) @ source)
