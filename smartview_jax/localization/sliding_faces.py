"""Move a face of an object model along its normal: a solid of other dimensions, equal in angles.

The vertices of the face slide along the edges that lead to it, so that all other faces stay in
their planes; where this is not possible, the whole object is stretched along the normal.
"""

import numpy as np
from jaxtyping import Float

from ..modeling import ObjectModel, SeenViews, pixel_jacobians

STEP_PX = 3.0
"""Largest movement of a vertex in a picture from one trial distance to the next, px.

Edges are found within `EXPLAINED_DISTANCE` on both sides.
"""

MIN_MOVED_PX = 8.0
"""Smallest movement of a moved face, px, in the picture where it moves most.

With less, its edges would be explained by the same points as at its place in the model.
"""

FARTHEST = 0.6
"""Largest distance by which a face is moved, over the object's extent."""

SHORTEST = 0.15
"""Share of its length that every edge keeps when a face is moved."""

MIN_SLOPE = 0.2
"""Smallest cosine between a face's normal and an edge along which a vertex slides."""

THINNEST = 0.02
"""Smallest height of a moved face above the object's lowest point, over the object's extent."""

MAX_PLACES = 240
"""Largest number of distances at which a face is tried, the nearest ones, to limit the time."""


def movements_of_face(model: ObjectModel, face: int) -> Float[np.ndarray, "V 3"]:
    """Return how far each vertex moves when a face moves by 1 m along its outward normal.

    The vertices of the face slide along the edges that lead to it, if exactly one leads to each.
    Otherwise, or where such an edge runs nearly along the face, the whole object is stretched: each
    vertex moves in proportion to its height above the lowest one. Nothing moves if the face itself
    is lowest, as in a sheet.
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
    """Return how far each vertex moves when the object is stretched along a face's normal."""
    normal = model.plane(face).normal
    heights = model.vertices @ normal
    height = heights[model.faces[face].indices].mean() - heights.min()
    if height < THINNEST * model.extent:
        return np.zeros_like(model.vertices)
    return (heights - heights.min())[:, None] / height * normal


def face_places(
    model: ObjectModel,
    movements: Float[np.ndarray, "V 3"],
    pose: Float[np.ndarray, "4 4"],
    views: SeenViews,
) -> Float[np.ndarray, "places"]:
    """Return the distances at which a face is tried, m, the nearest first; may be empty."""
    px = _px_per_metre(model, movements, pose, views)
    if px == 0.0:
        return np.zeros(0)
    # Every edge keeps a share of its length: length + t rate >= `SHORTEST` length.
    a, b = model.edges.T
    along = model.vertices[b] - model.vertices[a]
    rates = ((movements[b] - movements[a]) * along).sum(axis=1) / (along**2).sum(axis=1)
    farthest = FARTHEST * model.extent
    outwards, inwards = (
        float(((1.0 - SHORTEST) / rate[rate > 0.0]).min(initial=farthest))
        for rate in (-rates, rates)
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
    """Return the largest movement of a vertex in any picture when a face moves by 1 m, px."""
    R, t = pose[:3, :3], pose[:3, 3]
    by_point = pixel_jacobians(views, model.vertices @ R.T + t).by_point
    moved = np.einsum("vpij,pj->vpi", by_point, movements @ R.T)
    return float(np.linalg.norm(moved, axis=2).max(initial=0.0))
