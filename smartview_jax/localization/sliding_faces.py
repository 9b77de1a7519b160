"""Move a face of an object model along its normal: a solid of another size with all its angles.

The vertices of the face slide along the edges that lead to it, so that all other faces stay in
their planes; where that is not possible, the whole object is stretched along the normal.
"""

import numpy as np
from jaxtyping import Float

from ..modeling import ObjectModel, SeenViews, pixel_jacobians

STEP_PX = 3.0
"""Largest movement of a vertex in a picture from one tried place of a face to the next, px.

Edges are found within `EXPLAINED_DISTANCE` on both sides.
"""

MIN_MOVED_PX = 8.0
"""Smallest movement of a face that is elsewhere, px, in the picture where it moves most.

Nearer, its edges would be explained by the same points as at its place in the model.
"""

FARTHEST = 0.6
"""Largest distance by which a face is moved, over the extent of the object."""

SHORTEST = 0.15
"""Part of its length that every edge keeps where a face is moved."""

MIN_SLOPE = 0.2
"""Smallest cosine between a face's normal and an edge along which its vertex slides."""

THINNEST = 0.02
"""Smallest height of a face that is moved, from the object's lowest point, over its extent."""

MAX_PLACES = 240
"""Largest number of places at which a face is tried, the nearest ones, a limit of time."""


def movements_of_face(model: ObjectModel, face: int) -> Float[np.ndarray, "V 3"]:
    """Return how far each vertex moves where a face moves by 1 m along its outward normal.

    The vertices of the face slide along the edges that lead to it, one to each. Where several edges
    or none lead to a vertex, or one runs nearly along the face, the whole object is stretched: each
    vertex moves in proportion to its height above the lowest one. Nothing moves where the face is
    not above it, as of a sheet.
    """
    border, normal = model.faces[face].indices, model.plane(face).normal
    movements = np.zeros_like(model.vertices)
    for vertex in border:
        ends = model.edges[(model.edges == vertex).any(axis=1)]
        leading = sorted(set(ends.ravel().tolist()) - set(border))
        if len(leading) != 1:
            return _stretched(model, face)
        along = model.vertices[vertex] - model.vertices[leading[0]]
        slope = float(along @ normal)
        if abs(slope) < MIN_SLOPE * float(np.linalg.norm(along)):
            return _stretched(model, face)
        movements[vertex] = along / slope
    return movements


def _stretched(model: ObjectModel, face: int) -> Float[np.ndarray, "V 3"]:
    """Return how far each vertex moves where the object is stretched along a face's normal."""
    normal = model.plane(face).normal
    heights = model.vertices @ normal
    own = heights[model.faces[face].indices].mean() - heights.min()
    if own < THINNEST * model.extent:
        return np.zeros_like(model.vertices)
    return (heights - heights.min())[:, None] / own * normal


def face_places(
    model: ObjectModel,
    movements: Float[np.ndarray, "V 3"],
    pose: Float[np.ndarray, "4 4"],
    views: SeenViews,
) -> Float[np.ndarray, "places"]:
    """Return the distances at which a face is tried, m, the nearest first; none if it stays."""
    px = _px_per_metre(model, movements, pose, views)
    if px == 0.0:
        return np.zeros(0)
    # No edge becomes shorter than a part of itself: length + t rate >= `SHORTEST` length.
    a, b = model.edges.T
    along = model.vertices[b] - model.vertices[a]
    rates = ((movements[b] - movements[a]) * along).sum(axis=1) / (along**2).sum(axis=1)
    farthest = FARTHEST * model.extent
    outwards, inwards = (
        float(((1.0 - SHORTEST) / own[own > 0.0]).min(initial=farthest)) for own in (-rates, rates)
    )
    step = STEP_PX / px
    steps = np.arange(-int(inwards / step), int(outwards / step) + 1)
    steps = steps[np.abs(steps) * STEP_PX >= MIN_MOVED_PX]
    return step * steps[np.argsort(np.abs(steps), kind="stable")][:MAX_PLACES]


def _px_per_metre(
    model: ObjectModel,
    movements: Float[np.ndarray, "V 3"],
    pose: Float[np.ndarray, "4 4"],
    views: SeenViews,
) -> float:
    """Return the largest movement of a vertex in any picture where a face moves by 1 m, px."""
    R, t = pose[:3, :3], pose[:3, 3]
    by_point = pixel_jacobians(views, model.vertices @ R.T + t).by_point
    moved = np.einsum("vpij,pj->vpi", by_point, movements @ R.T)
    return float(np.linalg.norm(moved, axis=2).max(initial=0.0))
