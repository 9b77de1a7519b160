"""Tell whether two objects at given poses would occupy the same space.

A solid is a union of convex parts: a convex model is one part, any other is cut along the planes of
its faces until no face passes through a part. Two solids overlap as deep as the diameter of the
largest ball that fits into a part of each, which a linear program finds (Chebyshev centre).
"""

import functools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from ..geometry import host_transformed
from ..modeling import Face, ObjectModel, face_plane, open_edges, winding_number
from .edges import HIDING_MARGIN, is_round

EXACT_MARGIN = 1e-4
"""Distance of an exact model's vertices from the planes of their faces, over its extent, that is
rounding; for a measured model it is `HIDING_MARGIN`."""

MAX_CUT_FACES = 100
"""Largest number of faces of a model that is cut into parts, which takes up to some seconds.

The convex hull stands for other solids, and for round ones. It is larger, so that an object in a
hollow of such a solid counts as its rival.
"""


SAME_PLACE = 0.5
"""Distance between the middles of two objects, over the smaller extent, below which they are near.

A flat object has no volume that could overlap: it is in one place with what is near."""

MAX_TOLERANCE = 0.5
"""Largest tolerated overlap of two solids, over the thickness of the thinner one: two equal poses
overlap whatever their uncertainty."""

TOLERATED_SIGMAS = 3.0
"""Number of standard deviations that are tolerated: of the poses, where two solids overlap, and of
a model's tolerance, where its faces seem moved."""


class ConvexPart(NamedTuple):
    """The points x of a model with `normals @ x <= offsets`.

    Attributes:
        normals, offsets: outward unit normals, and distances of the planes from the origin, m.
        corners: m.
        middle, radius: of the largest ball inside, m.
    """

    normals: Float[np.ndarray, "planes 3"]
    offsets: Float[np.ndarray, "planes"]
    corners: Float[np.ndarray, "corners 3"]
    middle: Float[np.ndarray, "3"]
    radius: float

    def at(self, pose: Float[np.ndarray, "4 4"]) -> "ConvexPart":
        """Return the part in the world."""
        normals, t = self.normals @ pose[:3, :3].T, pose[:3, 3]
        return self._replace(
            normals=normals,
            offsets=self.offsets + normals @ t,
            corners=host_transformed(pose, self.corners),
            middle=host_transformed(pose, self.middle),
        )

    def depth_of(self, other: "ConvexPart") -> float:
        """Return how deep another part reaches into this one, along the face where it is least."""
        outside = other.corners @ self.normals.T - self.offsets
        return float(-outside.min(axis=0).max())

    def room_at(self, point: Float[np.ndarray, "3"]) -> float:
        """Return the radius of the largest ball about a point inside, m; negative outside."""
        return float((self.offsets - self.normals @ point).min())


@functools.lru_cache(maxsize=256)
def convex_parts(model: ObjectModel) -> tuple[ConvexPart, ...]:
    """Return the convex parts of a model; none for a flat one.

    The convex hull stands for a model whose faces do not enclose a volume.
    """
    try:
        hull = ConvexHull(model.vertices).equations
    except QhullError:
        return ()
    # A face of several triangles is one plane.
    whole = np.unique(hull.round(9), axis=0)
    tolerance = _margin(model)
    planes = [_plane(model, face) for face in model.faces]
    is_convex = all((model.vertices @ p[:3] + p[3] <= tolerance).all() for p in planes)
    can_be_cut = 3 < len(model.faces) <= MAX_CUT_FACES and not len(open_edges(model.faces))
    # Each facet of a round wall would be a cut of its own.
    can_be_cut = can_be_cut and not is_round(model)
    if is_convex or not can_be_cut:
        cells = [whole]
    else:
        inner = list(zip(model.faces, planes, strict=True))
        surface = model.vertices[np.concatenate([face.fan for face in model.faces])]
        cells = [
            c for c in _cells(model, whole, inner) if winding_number(surface, _ball(c)[0]) > 0.5
        ]
        # All parts of a measured model may be thinner than its errors.
        cells = cells or [whole]
    return tuple(_part(cell) for cell in cells)


def in_one_place(
    model: ObjectModel,
    pose: Float[np.ndarray, "4 4"],
    other: ObjectModel,
    other_pose: Float[np.ndarray, "4 4"],
    tolerance: float = 0.0,
) -> bool:
    """Return whether two objects would occupy the same space.

    Args:
        model, other: of the objects.
        pose, other_pose: their world_from_object.
        tolerance: overlap that errors of the poses explain, m; see `overlap_tolerance`.
    """
    thinner = min(thickness(m) for m in (model, other))
    if thinner <= 0.0:
        return middles_are_near(model, pose, other, other_pose)
    # Touching objects overlap by the errors of their vertices.
    allowed = tolerance + HIDING_MARGIN * (model.extent + other.extent)
    depth = min(allowed, MAX_TOLERANCE * thinner)
    return overlap_deeper(model, pose, other, other_pose, depth)


def middles_are_near(
    model: ObjectModel,
    pose: Float[np.ndarray, "4 4"],
    other: ObjectModel,
    other_pose: Float[np.ndarray, "4 4"],
) -> bool:
    """Return whether the middles of two objects are nearer than half of the smaller extent."""
    middles = [
        host_transformed(p, m.vertices.mean(axis=0))
        for m, p in ((model, pose), (other, other_pose))
    ]
    smaller = min(m.extent for m in (model, other))
    return bool(np.linalg.norm(middles[0] - middles[1]) < SAME_PLACE * smaller)


def overlap_tolerance(*sigmas: float) -> float:
    """Return the overlap of objects that standard deviations of their surfaces explain, m."""
    return TOLERATED_SIGMAS * float(np.linalg.norm(sigmas))


def overlap_deeper(
    model: ObjectModel,
    pose: Float[np.ndarray, "4 4"],
    other: ObjectModel,
    other_pose: Float[np.ndarray, "4 4"],
    depth: float,
) -> bool:
    """Return whether a ball of a diameter, m, fits into both solids at once."""
    parts, other_parts = (
        [part.at(p) for part in convex_parts(m)] for m, p in ((model, pose), (other, other_pose))
    )
    for a in parts:
        for b in other_parts:
            # No ball inside both is larger than the parts, or than one reaches into the other.
            if min(2.0 * a.radius, 2.0 * b.radius, a.depth_of(b), b.depth_of(a)) <= depth:
                continue
            # Where they nearly coincide, a ball between their middles is large enough.
            between = 0.5 * (a.middle + b.middle)
            if 2.0 * min(a.room_at(between), b.room_at(between)) > depth:
                return True
            planes = [np.column_stack([part.normals, -part.offsets]) for part in (a, b)]
            if 2.0 * _ball(np.concatenate(planes))[1] > depth:
                return True
    return False


def thickness(model: ObjectModel) -> float:
    """Return the diameter of the largest ball inside a convex part, m; zero for a flat model."""
    return 2.0 * max((part.radius for part in convex_parts(model)), default=0.0)


def _margin(model: ObjectModel) -> float:
    """Return the distance of vertices from their faces' planes that counts as zero, m."""
    return (EXACT_MARGIN if model.is_exact else HIDING_MARGIN) * model.extent


def _plane(model: ObjectModel, face: Face) -> Float[np.ndarray, "4"]:
    """Return the outward unit normal n of a face and d, with n . x + d = 0 on its plane."""
    plane = face_plane(model.vertices, face)
    return np.append(plane.normal, -plane.normal @ plane.origin)


def _part(planes: Float[np.ndarray, "planes 4"]) -> ConvexPart:
    """Return the part within planes."""
    middle, radius = _ball(planes)
    corners = HalfspaceIntersection(planes, middle).intersections
    return ConvexPart(planes[:, :3], -planes[:, 3], corners, middle, radius)


def _cells(
    model: ObjectModel,
    planes: Float[np.ndarray, "planes 4"],
    faces: list[tuple[Face, Float[np.ndarray, "4"]]],
) -> Iterator[Float[np.ndarray, "planes 4"]]:
    """Yield the planes of the cells into which faces cut a cell; no face passes through them."""
    tolerance = _margin(model)
    for k, (face, plane) in enumerate(faces):
        if not _passes_through(model.vertices[list(face.loop)], planes, tolerance):
            continue
        for side in (plane, -plane):
            cell = np.vstack([planes, side])
            if _ball(cell)[1] > tolerance:
                yield from _cells(model, cell, faces[k + 1 :])
        return
    yield planes


def _passes_through(
    corners: Float[np.ndarray, "corners 3"],
    planes: Float[np.ndarray, "planes 4"],
    tolerance: float,
) -> bool:
    """Return whether the convex hull of a face has points inside a cell."""
    # x = sum w_k c_k with w_k >= 0 and sum w_k = 1; the largest distance r from all planes.
    distances = planes[:, :3] @ corners.T + planes[:, 3:]
    program = linprog(
        np.append(np.zeros(len(corners)), -1.0),
        np.column_stack([distances, np.ones(len(planes))]),
        np.zeros(len(planes)),
        np.append(np.ones(len(corners)), 0.0)[None],
        np.ones(1),
        bounds=[*[(0.0, None)] * len(corners), (None, None)],
    )
    return bool(program.status == 0 and program.x[-1] > tolerance)


def _ball(planes: Float[np.ndarray, "planes 4"]) -> tuple[Float[np.ndarray, "3"], float]:
    """Return the middle and the radius of the largest ball within planes, zero if there is none."""
    # The largest r with n . x + d + r <= 0 for all planes.
    program = linprog(
        np.array([0.0, 0.0, 0.0, -1.0]),
        np.column_stack([planes[:, :3], np.ones(len(planes))]),
        -planes[:, 3],
        bounds=[(None, None)] * 3 + [(0.0, None)],
    )
    return (program.x[:3], float(program.x[3])) if program.status == 0 else (np.zeros(3), 0.0)
